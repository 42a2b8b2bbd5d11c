"""Design of the next recording, by gradients through the twins."""

import dataclasses
import itertools
import math
import os
from collections.abc import Mapping, Sequence
from numbers import Integral, Real
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import scipy
from jaxtyping import Float
from rich.progress import track

from sb3_hds.core import Trajectories, Twin
from sb3_hds.effects import ConstantForce
from sb3_hds.errors import CalibrationError
from sb3_hds.sysid.belief.answers import (
    Answers,
    bounds_of,
    effect_key,
    effects_of,
    everything_open,
    union,
)
from sb3_hds.sysid.design.excitation import DesignProblem, Excitation
from sb3_hds.sysid.design.limits import BY_JOINT, Limits
from sb3_hds.sysid.design.result import SURE, NextExperiment, Pair
from sb3_hds.sysid.reporting.wording import with_unit

# Starts of the search, its steps, and the learning rate, in units of the coefficients.
_STARTS, _STEPS, _RATE = 6, 120, 0.05
# Largest usage of a limit: the real machine differs from every answer.
_MOST = 0.9
# Limits also hold for parameters this many standard deviations off, along this many of the widest
# directions of each answer's covariance.
_DEVIATIONS, _DIRECTIONS = 2.0, 2
# Odds at which answers count as decided.
_ODDS = 19.0
# Largest number of recordings to decide, and of recordings with another sensor or a load.
_MOST_RECORDINGS, _FEW = 100, 10
# Error of a force sensor and size of a known load, in shares of the largest force; factor by which
# better sensors are better.
_SENSOR, _LOAD, _FINER = 0.02, 0.3, 10.0


def next_experiment(
    answers: Answers,
    limits: Limits | Mapping[str, Any] | str | os.PathLike[str],
    *,
    n: int = 1,
    seconds: float = 10.0,
    start: Any = None,
    seed: int = 0,
    progress: bool = True,
) -> NextExperiment:
    """
    See ``Diagnosis.next_experiment``.

    :param answers: that the data leave open
    :raises CalibrationError: for an impossible number, length, start or seed, or if no commands
        within the limits were found
    :raises ParameterError: for limits that do not fit the machine
    """
    (first, *others) = answers.answers
    if not (others or first.factor):
        # Nothing is wrong or uncertain: design for friction, which may be too small to show.
        answers = dataclasses.replace(answers, answers=(everything_open(first.twin),))
    twin, problem, loads = design_problem(answers, start)
    bounds = Limits.of(limits).at(twin)
    n_steps = _steps(seconds, twin, n, seed)
    with jax.enable_x64(True):
        excitation = Excitation(twin, bounds, n_steps, answers.window)
        found = _found(excitation, problem, n, seed, progress)
        actions = np.asarray(excitation.commands(jnp.asarray(found)))
        evaluation = jax.tree.map(np.asarray, excitation.evaluate(actions, problem))
        pairs = _pairs(answers, evaluation.ratios, n)
        decides = not pairs or bool(pairs[0].needed <= _MOST_RECORDINGS)
        would_tell = ()
        if not decides:
            would_tell = _would_tell(excitation, actions, problem, evaluation.outputs, loads)
    alone = len(answers.answers) == 1
    outputs = evaluation.outputs[..., : len(twin.channels)]
    return NextExperiment(
        commands=Trajectories.from_arrays(
            outputs[0], actions, dt=twin.dt, conditions="designed experiment"
        ),
        answers=tuple(answer.name for answer in answers.answers),
        predicted=outputs,
        channels=tuple((c.name, c.unit) for c in twin.channels),
        actuators=tuple((a.name, a.unit) for a in twin.actuators),
        pairs=pairs,
        information=float(evaluation.gains[0]),
        narrower=_narrower(twin, problem, evaluation.curvature) if alone else {},
        usage=_usage(evaluation.usage, twin),
        decides=decides,
        would_tell=would_tell,
    )


def design_problem(
    answers: Answers, start: Any = None
) -> tuple[Twin, DesignProblem, tuple[int, ...]]:
    """
    :param answers: that the data leave open
    :param start: observation at the start; default: that of the answers
    :return: the twin with everything that any answer has, and a known load at each joint; its
        numbers; and for each joint the index of its load's parameter, -1 without one
    :raises CalibrationError: for an impossible start
    """
    twin, values, factor = union(answers.answers)
    twin, values, factor, loads = _with_loads(twin, values, factor)
    weight = np.concatenate([1.0 / answers.noise, np.zeros(len(twin.joints))])
    begin, corners = _start(start, answers, twin), _corners(twin, values, factor)
    return twin, DesignProblem(values, factor, corners, begin, weight, answers.correlated), loads


def _steps(seconds: float, twin: Twin, n: int, seed: int) -> int:
    if not isinstance(n, Integral) or n < 1:
        raise CalibrationError(f"n must be a whole number of recordings, got {n!r}.")
    if not isinstance(seed, Integral) or seed < 0:
        raise CalibrationError(f"seed must be a whole number of at least 0, got {seed!r}.")
    if not (isinstance(seconds, Real) and math.isfinite(seconds) and seconds >= 8 * twin.dt):
        raise CalibrationError(
            f"seconds must be at least eight intervals of {twin.dt:g} s, got {seconds!r}."
        )
    return round(float(seconds) / twin.dt)


def _start(start: Any, answers: Answers, twin: Twin) -> np.ndarray:
    found = np.asarray(answers.start if start is None else start, float)
    if found.shape != (len(twin.channels),) or not np.isfinite(found).all():
        raise CalibrationError(
            f"start must be an observation, {len(twin.channels)} finite numbers "
            f"({', '.join(c.name for c in twin.channels)}), got {start!r}."
        )
    return found


def _with_loads(
    twin: Twin, values: np.ndarray, factor: np.ndarray
) -> tuple[Twin, np.ndarray, np.ndarray, tuple[int, ...]]:
    """
    Add a constant force at each joint, zero unless a known load is tried.

    :return: the twin with them, its parameter vectors and factors, and their indices
    """
    there = {effect_key(effect) for effect in effects_of(twin)}
    natives = {place for name, place in twin.native_effects if name == ConstantForce.name}
    new = [
        ConstantForce(joint.name)
        for i, joint in enumerate(twin.joints)
        if f"{ConstantForce.name}.{joint.name}" not in there and i not in natives
    ]
    names = tuple(twin.parameters)
    extended = twin.extend(*new) if new else twin
    after = tuple(extended.parameters)
    # The last place is that of zeros, for what is new.
    order = [names.index(name) if name in names else -1 for name in after]
    values = np.pad(values, ((0, 0), (0, 1)))[:, order]
    factor = np.pad(factor, ((0, 0), (0, 1), (0, 0)))[:, order]
    loads = [f"{ConstantForce.name}.{joint.name}.tau_0" for joint in twin.joints]
    return extended, values, factor, tuple(after.index(n) if n in after else -1 for n in loads)


def _corners(twin: Twin, values: np.ndarray, factor: np.ndarray) -> np.ndarray:
    """Parameters at two standard deviations along the widest directions, within their bounds."""
    (low, high), parameters = bounds_of(twin), twin.parameters.values()
    scale = np.array([p.scale for p in parameters])
    found = []
    for value, own in zip(values, factor, strict=True):
        widest = np.argsort(-np.linalg.norm(own / scale[:, None], axis=0))[:_DIRECTIONS]
        for i in widest:
            way = _DEVIATIONS * own[:, i]
            found += [np.clip(value + way, low, high), np.clip(value - way, low, high)]
    return np.array(found) if found else values[:1]


def _found(
    excitation: Excitation, problem: DesignProblem, n: int, seed: int, progress: bool
) -> Float[np.ndarray, "n waves act"]:
    """:return: the best coefficients along the search from all starts, within all limits"""
    rng, n_act = np.random.default_rng(seed), len(excitation.twin.actuators)
    shape = (_STARTS, n, excitation.basis.shape[1], n_act)
    # Lower frequencies move a machine further; starts differ in amplitude.
    falling = 1.0 / np.sqrt(1.0 + excitation.cycles)[:, None]
    strength = np.geomspace(0.1, 1.0, _STARTS)[:, None, None, None]
    now = strength * falling * rng.standard_normal(shape) / np.sqrt(np.sum(falling**2) / 2.0)
    optimizer = optax.adam(optax.cosine_decay_schedule(_RATE, _STEPS))
    state, best, highest = optimizer.init(now), None, -np.inf
    steps = track(range(_STEPS), "designing", transient=True, disable=not progress)
    for _ in steps:
        objective, usage, slopes = map(np.asarray, excitation.ascent(now, problem))
        inside = np.where(np.isfinite(objective) & (usage <= _MOST), objective, -np.inf)
        if inside.max() > highest:
            highest, best = float(inside.max()), np.array(now[int(inside.argmax())])
        slopes = np.nan_to_num(slopes, nan=0.0, posinf=0.0, neginf=0.0)
        norm = np.sqrt(np.sum(slopes**2, (1, 2, 3), keepdims=True))
        step, state = optimizer.update(slopes / np.maximum(norm, 1.0), state, now)
        now = np.asarray(optax.apply_updates(now, step))
    if best is None:
        found = excitation.evaluate(excitation.commands(now[0]), problem)
        usage = _usage(np.asarray(found.usage), excitation.twin)
        worst = max(usage, key=usage.__getitem__)
        raise CalibrationError(
            f"No commands were found that keep all limits under every answer: {worst} is taken to "
            f"{usage[worst]:.0%}. Widen that limit, record for fewer seconds, or begin elsewhere "
            "(start=...)."
        )
    return best


def _pairs(answers: Answers, ratios: np.ndarray, n: int) -> tuple[Pair, ...]:
    names = [answer.name for answer in answers.answers]
    found = [
        _pair(names[a], names[b], float(ratios[a, b]), n)
        for a, b in itertools.permutations(range(len(names)), 2)
    ]
    return tuple(sorted(found, key=lambda pair: pair.ratio))


def _pair(true: str, other: str, strength: float, n: int) -> Pair:
    """
    The logarithm of the likelihood ratio is normal, with mean ``strength / 2`` and variance
    ``strength``.
    """
    strength = max(strength, 1e-12)
    threshold, sure = math.log(_ODDS), float(scipy.stats.norm.ppf(SURE))
    chance = float(scipy.stats.norm.cdf((0.5 * strength - threshold) / math.sqrt(strength)))
    enough = (sure + math.sqrt(sure**2 + 2.0 * threshold)) ** 2
    return Pair(true, other, 0.5 * strength, chance, max(n * enough / strength, 1.0))


def _would_tell(
    excitation: Excitation,
    actions: np.ndarray,
    problem: DesignProblem,
    outputs: np.ndarray,
    loads: Sequence[int],
) -> tuple[str, ...]:
    """What would decide the hardest pair of answers with the same commands, in words."""
    twin, n_obs = excitation.twin, len(excitation.twin.channels)
    largest = np.abs(outputs[..., n_obs:]).max((0, 1, 2))
    trials: list[tuple[str, DesignProblem]] = []
    for j, joint in enumerate(twin.joints):
        if not largest[j] > 0.0:
            continue
        unit = "N" if joint.unit == "m" else "N m"
        error, force = (with_unit(f"{share * largest[j]:.2g}", unit) for share in (_SENSOR, _LOAD))
        weight, values = problem.weight.copy(), problem.values.copy()
        weight[n_obs + j] = 1.0 / (_SENSOR * largest[j])
        words = f"A sensor of the actuator's force at {joint.name}, good to {error},"
        trials.append((words, problem._replace(weight=weight)))
        if loads[j] >= 0:
            values[:, loads[j]] += _LOAD * largest[j]
            words = (
                f"A known load at {joint.name}, a constant force of {force} as of a weight on a "
                "string,"
            )
            trials.append((words, problem._replace(values=values)))
    words = f"Errors {_FINER:.0f} times smaller, of sensors and of the model,"
    trials.append((words, problem._replace(weight=_FINER * problem.weight)))
    found, others = [], ~np.eye(len(problem.values), dtype=bool)
    for words, changed in trials:
        ratios = np.asarray(excitation.evaluate(actions, changed).ratios)
        needed = _pair("", "", float(ratios[others].min()), 1).needed
        if needed <= _FEW:
            often = "" if needed <= 1.0 else f" in {math.ceil(needed)} recordings"
            found.append(f"{words} would tell{often}.")
    return tuple(found) or (
        "Neither a force sensor nor a known load nor ten times better sensors would tell with "
        "these commands: to a policy, the answers may be the same.",
    )


def _narrower(
    twin: Twin, problem: DesignProblem, curvature: np.ndarray
) -> dict[str, tuple[float, float]]:
    """Standard deviations of the only answer's parameters, before and after."""
    factor = problem.factor[0]
    after = factor @ np.linalg.inv(curvature + np.eye(len(curvature))) @ factor.T
    now, then = (np.sqrt(np.maximum(np.diag(c), 0.0)) for c in (factor @ factor.T, after))
    names = tuple(twin.parameters)
    return {n: (float(a), float(b)) for n, a, b in zip(names, now, then, strict=True) if a > 0.0}


def _usage(usage: np.ndarray, twin: Twin) -> dict[str, float]:
    return {
        f"{limit} of {joint.name}": float(usage[i, j])
        for i, limit in enumerate(("position", *BY_JOINT))
        for j, joint in enumerate(twin.joints)
        if usage[i, j] > 0.0
    }
