"""From candidates and measured motion to the regression problem in which sets are selected."""

from collections.abc import Sequence

import jax
import numpy as np

from sb3_hds.core import ActionEffect, JointEffect, SensorEffect, Twin
from sb3_hds.sysid.equation.effect_columns import (
    CLOSED_FORMS,
    add_closed_form,
    add_command,
    add_common,
    add_force,
    add_sensor,
    nodes_of,
)
from sb3_hds.sysid.equation.plausibility import plausibility, rarity_of
from sb3_hds.sysid.equation.problem import Problem
from sb3_hds.sysid.equation.regression import STEP, Equation, Item, Rows, put, residual_force
from sb3_hds.sysid.equation.regressors import LATE
from sb3_hds.sysid.equation.terms import effective_inertia, terms
from sb3_hds.sysid.equation.weak_form import grams
from sb3_hds.sysid.estimation.candidates import PARAMETER, Candidate
from sb3_hds.sysid.estimation.hypotheses import Hypotheses
from sb3_hds.sysid.motion.joints import encoders
from sb3_hds.sysid.motion.motion import Motion

# Columns below this share of the typical force are dropped.
_NOTHING = 1e-9
# Least delay, in intervals: shorter ones have no more effect than the motion between two samples.
_LEAST_LATE = 0.03
# A spring may rest outside of the range of motion by this share of it: farther away, it is an
# offset.
_BEYOND = 0.5
# Masses and lengths may be off by these factors.
_LEAST_OF_IT, _MOST_OF_IT = 0.1, 5.0
# Angles may be off by this much [rad]: columns are derivatives.
_MOST_TURNED = 1.0
# Least noise of a velocity, in shares of the fastest joint's speed.
_QUIETEST = 1e-6


def assemble(hypotheses: Hypotheses, motion: Motion, quick: bool = False) -> Equation:
    """
    :param hypotheses: candidates, and the nominal model, at the interval of the motion
    :param motion: of the joints
    :param quick: only the forces of ``CLOSED_FORMS``, which need no compilation, with the mass
        matrix as effective inertia
    """
    twin, rows = hypotheses.nominal, rows_of(motion)
    given = (twin, twin.params, rows.q, rows.v, rows.actions)
    found = terms(*given)
    inertia = found.mass if quick else effective_inertia(*given, found)
    made = Equation(
        twin=twin,
        motion=motion,
        rows=rows,
        terms=found,
        effective_inertia=inertia,
        load=np.einsum("nij,nj->ni", found.mass, rows.a) + found.bias,
        residual=residual_force(inertia, rows.measured - found.change, motion.dt),
        smooth=residual_force(inertia, rows.change - found.change, motion.dt),
    )
    refuted = set() if quick else refuted_by_kinematics(twin, motion)
    of_joint = 1.0 / np.diagonal(np.linalg.inv(found.mass), axis1=1, axis2=2)
    nodes = [nodes_of(made, of_joint, j) for j in range(of_joint.shape[1])]
    for candidate in hypotheses.candidates:
        effect = hypotheses.effect_of(candidate)
        if candidate.key in refuted:
            continue
        if candidate.slot == PARAMETER:
            _add_parameter(made, candidate)
        elif quick and candidate.name in CLOSED_FORMS:
            add_closed_form(made, candidate, nodes[candidate.index])
        elif isinstance(effect, JointEffect) and not jax.tree.leaves(effect.memory(twin)):
            add_force(made, candidate, effect, nodes[candidate.index])
        elif isinstance(effect, ActionEffect) and candidate.index >= 0:
            add_command(made, candidate, effect)
        elif isinstance(effect, SensorEffect):
            add_sensor(made, candidate, effect)
    add_common(made, hypotheses.candidates)
    for name in (hypotheses.names[i] for i in hypotheses.nuisances):
        _add_parameter(made, Candidate(f"parameter.{name}", PARAMETER, name, -1, (name,), ""))
    return made


def refuted_by_kinematics(twin: Twin, motion: Motion) -> set[str]:
    """
    :return: keys of candidates at a single channel of an encoder whose velocity is the derivative
        of its position: neither has a scale, a sign or a delay of its own
    """
    found = set()
    for j, encoder in encoders(twin).items():
        if encoder.velocity is None or not motion.agrees[j]:
            continue
        for i in encoder.channels:
            name = twin.channels[i].name
            found |= {f"{kind}.{name}" for kind in ("sensor_scale", "sensor_delay", "sign_flip")}
        found.add(f"sensor_bias.{twin.channels[encoder.velocity].name}")
    return found


def rows_of(motion: Motion) -> Rows:
    """:return: all intervals of all recordings"""
    parts = [
        (
            r.q[:-1],
            r.v[:-1],
            0.5 * (r.a[1:] + r.a[:-1]),
            np.diff(r.v, axis=0),
            np.diff(r.measured_v, axis=0),
            r.actions,
            np.full(len(r.actions), i),
            r.q[1:],
            r.v[1:],
        )
        for i, r in enumerate(motion.recordings)
    ]
    return Rows(*map(np.concatenate, zip(*parts, strict=True)))


def _add_parameter(made: Equation, candidate: Candidate) -> None:
    """Minus the derivative of the residual force, by a finite difference."""
    twin, rows, now, (name,) = made.twin, made.rows, made.terms, candidate.parameters
    parameter, value = twin.parameters[name], twin.values[name]
    step = STEP * parameter.scale
    step = -step if value + step > parameter.upper else step
    there = terms(twin, {**twin.params, name: value + step}, rows.q, rows.v, rows.actions)
    inertia = made.effective_inertia + there.mass - now.mass

    def column_of(change: np.ndarray, before: np.ndarray) -> np.ndarray:
        after = residual_force(inertia, change - there.change, made.motion.dt)
        return -(after - before) / step

    column = column_of(rows.change, made.smooth)
    typical = np.sqrt(np.mean(np.concatenate([made.load, now.actuator]) ** 2)) + 1e-300
    size = np.sqrt(np.mean(column**2)) * parameter.scale
    if not np.isfinite(column).all() or size < _NOTHING * typical:
        return
    index = put(made, None, column)
    made.items.append(Item(candidate, (index,), (name,)))
    slope = (there.mass - now.mass) / step
    if np.abs(slope).max() > 0.0:
        made.slopes[candidate.key] = slope
        made.noisy[index] = put(made, None, column_of(rows.measured, made.residual))
    drive = np.sum((there.actuator - now.actuator) * now.actuator, axis=0) / step
    power = np.sum(now.actuator**2, axis=0)
    drive = np.divide(drive, power, out=np.zeros_like(drive), where=power > 0.0)
    if np.abs(drive).max() > 0.0:
        made.drives[candidate.key] = drive


def normal_problem(hypotheses: Hypotheses, equation: Equation) -> Problem:
    """:return: its normal equations, with bounds, prices and prior odds of all items"""
    items, n = tuple(equation.items), len(equation.columns)
    lower, upper, prior = np.full(n, -np.inf), np.full(n, np.inf), np.zeros(n + 1)
    always = []
    for number, item in enumerate(items):
        if item.candidate.slot == PARAMETER and item.candidate.index < 0:
            always.append(number)
        for c, name in zip(item.columns, item.names, strict=True):
            if item.rule == "chain":
                lower[c], upper[c] = 0.0, 1.0
            elif item.rule == "linear":
                lower[c], upper[c] = _bounds(hypotheses, item, name)
    for number in always:
        (column,), name = items[number].columns, items[number].candidate.place
        prior[column] = hypotheses.prior[hypotheses.names.index(name)] ** -2.0
    dof = equation.residual.shape[1]
    shares = np.zeros((dof, n))
    for c, column in enumerate(equation.columns):
        own = slice(None) if column.joint is None else column.joint
        shares[own, c] = np.sqrt(np.mean(column.values**2, axis=0))
    force = np.sqrt(np.mean(equation.terms.actuator**2, axis=0))
    force = np.maximum(force, np.sqrt(np.mean(equation.load**2, axis=0))) + 1e-300
    n_rows = len(equation.effective_inertia)
    some = np.linspace(0, n_rows - 1, min(32, n_rows)).astype(int)
    return Problem(
        items=items,
        grams=grams(equation),
        lower=lower,
        upper=upper,
        prior=prior,
        force=force,
        shares=shares,
        passes=_passing(hypotheses, equation, items),
        mass=equation.terms.mass[some],
        effective_inertia=equation.effective_inertia[some],
        noise=np.maximum(equation.motion.noise_v, _QUIETEST * equation.motion.speed.max()),
        noisy=equation.noisy,
        slopes={key: slope[some] for key, slope in equation.slopes.items()},
        drives=equation.drives,
        rests=_rests(equation, items),
        least=_least_late(equation, items),
        always=tuple(always),
        rarity=tuple(rarity_of(item.candidate, hypotheses.nominal) for item in items),
    )


def _rests(equation: Equation, items: Sequence[Item]) -> dict[int, tuple[float, float]]:
    """By item of a spring, shares of both columns between which it rests near the motion."""
    found = {}
    for number, item in enumerate(items):
        if item.candidate.name != "stiffness" or item.rule != "blend":
            continue
        q = equation.rows.q[:, item.candidate.index]
        beyond = _BEYOND * float(np.ptp(q))
        first, second = (at["q0"] for at in item.settings)
        ends = (float(q.min()) - beyond, float(q.max()) + beyond)
        low, high = ((end - first) / (second - first) for end in ends)
        found[number] = (low, high)
    return found


def _least_late(equation: Equation, items: Sequence[Item]) -> dict[int, float]:
    found = {}
    for number, item in enumerate(items):
        if item.candidate.name in LATE:
            low, high = (at[name] for at, name in zip(item.settings, item.names, strict=True))
            found[number] = max((_LEAST_LATE * equation.motion.dt - low) / (high - low), 0.0)
    return found


def _bounds(h: Hypotheses, item: Item, name: str) -> tuple[float, float]:
    """Bounds of a change from the null, by physics and by what machines have."""
    known = plausibility(item.candidate.name)
    if item.candidate.slot == PARAMETER:
        place = item.candidate.place
        i = h.names.index(place)
        value, low, high = h.nominal.values[place], h.lower[i], h.upper[i]
        if item.candidate.index >= 0 and low > 0.0:
            low, high = max(low, _LEAST_OF_IT * value), min(high, _MOST_OF_IT * value)
        if h.nominal.parameters[place].unit == "rad":
            low, high = max(low, value - _MOST_TURNED), min(high, value + _MOST_TURNED)
        return low - value, high - value
    full = next(p for p in item.candidate.parameters if p.rpartition(".")[2] == name)
    i = h.names.index(full)
    low, high = h.lower[i] - h.null[i], h.upper[i] - h.null[i]
    return max(low, known.lower if known.lower != 0.0 else low), min(high, known.upper)


def _passing(h: Hypotheses, equation: Equation, items: Sequence[Item]) -> dict[int, float]:
    found = {}
    commands = np.concatenate([r.actions for r in equation.motion.recordings])
    for number, item in enumerate(items):
        if item.candidate.name not in ("saturation", "dead_zone"):
            continue
        effect = h.effect_of(item.candidate)
        assert isinstance(effect, ActionEffect)
        low, high = (at[effect.interpolated] for at in item.settings)
        size = np.abs(commands[:, item.candidate.index])
        middle = 0.5 * (low + high)
        passing = size < middle if item.candidate.name == "saturation" else size > 0.5 * middle
        found[number] = float(np.mean(passing))
    return found
