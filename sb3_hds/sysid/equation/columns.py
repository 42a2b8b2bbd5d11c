"""What each candidate would add to the equation of motion: columns, linear in their sizes."""

import copy
import dataclasses
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property, partial
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sb3_hds.core import (
    ActionEffect,
    Effect,
    JointEffect,
    JointMoment,
    Params,
    Ranges,
    SensorEffect,
    State,
    Twin,
)
from sb3_hds.core.numerics.compilation import QUICKEST_COMPILATION
from sb3_hds.effects import SensorDelay
from sb3_hds.effects.joint import DryFriction
from sb3_hds.sysid.equation.motion import Motion
from sb3_hds.sysid.equation.terms import Terms, effective_inertia, forces, portions, terms
from sb3_hds.sysid.estimation.hypotheses import PARAMETER, Candidate, Hypotheses, encoders

# Finite differences by a parameter or a sensor, in shares of its scale.
_STEP = 1e-3
# Columns below this share of the typical force change nothing.
_NOTHING = 1e-9
# Samples by which a sensor may be late, between which its column interpolates.
_LATE = (0, 1, 2, 3, 4)
# Places of a normal distribution, in standard deviations, and their weights (Gauss-Hermite).
_PLACES, _WEIGHTS = np.array([0.0, -np.sqrt(3.0), np.sqrt(3.0)]), np.array([4.0, 1.0, 1.0]) / 6.0

#: by effect, its parameter and the force per unit of it at a velocity
CLOSED_FORMS: dict[str, tuple[str, Callable[[np.ndarray], np.ndarray]]] = {
    "viscous_friction": ("b", np.negative),
    "coulomb_friction": ("tau_c", lambda v: -np.sign(v)),
    "constant_force": ("tau_0", np.ones_like),
}

Rule = Literal["linear", "chain", "blend", "switch"]


@dataclasses.dataclass(frozen=True)
class Item:
    """
    A candidate with what is not linear in it at fixed values, or between two.

    :param candidate: which
    :param columns: indices
    :param fixed: of each column, the coefficient that is no choice; None: it is estimated
    :param rule: how coefficients become sizes
    :param settings: values of its parameters, by short name, at which the columns were taken
    :param names: short name of the parameter of each column
    """

    candidate: Candidate
    columns: tuple[int, ...]
    fixed: tuple[float | None, ...]
    rule: Rule
    settings: tuple[Mapping[str, float], ...]
    names: tuple[str, ...]

    @property
    def key(self) -> str:
        return self.candidate.key

    @cached_property
    def free(self) -> tuple[int, ...]:
        """Columns whose coefficients are estimated."""
        return tuple(c for c, f in zip(self.columns, self.fixed, strict=True) if f is None)

    def sizes(
        self, effect: Effect | None, coefficients: Sequence[float] | np.ndarray
    ) -> dict[str, float]:
        """
        :param effect: the candidate's; None for a parameter
        :param coefficients: of the free columns
        :return: values of the candidate's parameters by short name; of a parameter, its change
        """
        if self.rule == "chain":
            (name,), (low, high) = self.names[-1:], self.settings
            share = float(coefficients[0])
            return {name: low[name] + share * (high[name] - low[name])}
        if self.rule == "blend":
            assert effect is not None
            return effect.blend((coefficients[0], coefficients[1]), self.settings)  # type: ignore[arg-type]
        if self.rule == "switch":
            return dict(self.settings[0])
        found = dict(self.settings[0]) if self.settings else {}
        for name, value in zip(self.names, coefficients, strict=True):
            null = effect.parameters[name].null if effect is not None else 0.0
            found[name] = null + float(value)
        return found


class Column(NamedTuple):
    """
    :param joint: at which it acts; None: at all, and ``values`` has a column for each
    :param values: force at each interval, shape ``(n,)`` or ``(n, dof)`` [N m] or [N]
    """

    joint: int | None
    values: np.ndarray

    def at(self, joint: int) -> np.ndarray | None:
        """:return: force at one joint; None if there is none"""
        if self.joint is None:
            return self.values[:, joint]
        return self.values if self.joint == joint else None


@dataclasses.dataclass
class Equation:
    """
    The equation of motion along all recordings, one row for each interval.

    :param missing: force that the nominal model lacks, shape ``(n, dof)`` [N m] or [N]
    :param columns: what candidates would add
    :param items: candidates, several with different settings
    :param recording: that each row is from, shape ``(n,)``
    :param q: smoothed positions where an interval begins, shape ``(n, dof)``
    :param v: smoothed velocities there
    :param load: force that the nominal model transmits: inertia, gravity, shape ``(n, dof)``
    :param actuator: force of the actuators, shape ``(n, dof)``
    :param mass: mass matrix, shape ``(n, dof, dof)``
    :param effective: inertia that a constant force meets over an interval, likewise
    :param slopes: of the mass matrix by inertial parameters, by key of the candidate
    :param drives: by which share of the actuators' force that changes with a unit of a parameter,
        at each joint, likewise
    :param motion: what they come from
    """

    missing: np.ndarray
    columns: list[Column]
    items: list[Item]
    recording: np.ndarray
    q: np.ndarray
    v: np.ndarray
    load: np.ndarray
    actuator: np.ndarray
    mass: np.ndarray
    effective: np.ndarray
    slopes: dict[str, np.ndarray]
    drives: dict[str, np.ndarray]
    motion: Motion


class _Rows(NamedTuple):
    """All recordings, one after the other: where intervals begin and end."""

    q: np.ndarray
    v: np.ndarray
    a: np.ndarray
    change: np.ndarray  # of the smoothed velocity
    measured: np.ndarray  # of the measured velocity
    actions: np.ndarray
    recording: np.ndarray
    next_q: np.ndarray
    next_v: np.ndarray


def equation(hypotheses: Hypotheses, motion: Motion, quick: bool = False) -> Equation:
    """
    :param hypotheses: candidates, and the twin as it is believed, at the interval of the motion
    :param motion: of the joints
    :param quick: forces of ``CLOSED_FORMS`` only, which run no program, beside the bare mass matrix
    """
    twin, rows = hypotheses.believed, _rows(motion)
    params = twin.params
    found = _terms(twin, params, rows)
    given = (rows.q, rows.v, rows.actions)
    effective = found.mass if quick else effective_inertia(twin, params, *given, found)
    force = lambda change: (  # noqa: E731
        np.einsum("nij,nj->ni", effective, change - found.change) / motion.dt
    )
    missing, smooth = force(rows.measured), force(rows.change)
    load = np.einsum("nij,nj->ni", found.mass, rows.a) + found.bias
    made = Equation(
        missing=missing,
        columns=[],
        items=[],
        recording=rows.recording,
        q=rows.q,
        v=rows.v,
        load=load,
        actuator=found.actuator,
        mass=found.mass,
        effective=effective,
        slopes={},
        drives={},
        motion=motion,
    )
    typical = np.sqrt(np.mean(np.concatenate([load, found.actuator]) ** 2)) + 1e-300
    refuted = set() if quick else refuted_by_kinematics(twin, motion)
    inertia = 1.0 / np.diagonal(np.linalg.inv(found.mass), axis1=1, axis2=2)
    nodes = [_nodes(made, rows, found.bias, inertia, j) for j in range(inertia.shape[1])]
    for candidate in hypotheses.candidates:
        effect = hypotheses.effect_of(candidate)
        if candidate.key in refuted:
            continue
        if candidate.slot == PARAMETER:
            _add_parameter(made, hypotheses, candidate, rows, smooth, typical)
        elif quick and candidate.name in CLOSED_FORMS:
            _add_closed_form(made, candidate, nodes[candidate.index])
        elif isinstance(effect, JointEffect) and not jax.tree.leaves(effect.memory(twin)):
            _add_force(made, candidate, effect, nodes[candidate.index], rows)
        elif isinstance(effect, ActionEffect) and candidate.index >= 0:
            _add_command(made, hypotheses, candidate, effect, rows)
        elif isinstance(effect, SensorEffect):
            _add_sensor(made, hypotheses, candidate, effect, rows, smooth)
    _add_common(made, hypotheses)
    for name in (hypotheses.names[i] for i in hypotheses.nuisances):
        own = Candidate(f"parameter.{name}", PARAMETER, name, -1, (name,), "")
        _add_parameter(made, hypotheses, own, rows, smooth, typical)
    return made


def refuted_by_kinematics(twin: Twin, motion: Motion) -> set[str]:
    """
    :return: keys of candidates that concern one of two channels, where the velocity is the
        derivative of the position: neither has a scale, a sign or a delay of its own
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


def _rows(motion: Motion) -> _Rows:
    parts = [
        (
            r.q[:-1],
            r.v[:-1],
            0.5 * (r.a[1:] + r.a[:-1]),
            np.diff(r.v, axis=0),
            np.diff(r.raw, axis=0),
            r.actions,
            np.full(len(r.actions), i),
            r.q[1:],
            r.v[1:],
        )
        for i, r in enumerate(motion.recordings)
    ]
    return _Rows(*map(np.concatenate, zip(*parts, strict=True)))


def _terms(twin: Twin, params: Params, rows: _Rows) -> Terms:
    """Recording by recording where the twin remembers, else all at once."""
    return terms(twin, params, rows.q, rows.v, rows.actions)


def _put(made: Equation, joint: int | None, values: np.ndarray) -> int:
    made.columns.append(Column(joint, values))
    return len(made.columns) - 1


# ------------------------------------------------------------------------------ the twin's own
def _add_parameter(
    made: Equation,
    hypotheses: Hypotheses,
    candidate: Candidate,
    rows: _Rows,
    smooth: np.ndarray,
    typical: float,
) -> None:
    """Minus the derivative of the missing force, by a difference."""
    twin, (name,) = hypotheses.believed, candidate.parameters
    parameter, value = twin.parameters[name], twin.values[name]
    step = _STEP * parameter.scale
    step = -step if value + step > parameter.upper else step
    there = _terms(twin, {**twin.params, name: value + step}, rows)
    effective = made.effective + there.mass - made.mass
    moved = np.einsum("nij,nj->ni", effective, rows.change - there.change) / made.motion.dt
    column = -(moved - smooth) / step
    if not np.isfinite(column).all() or _rms(column) * parameter.scale < _NOTHING * typical:
        return
    index = _put(made, None, column)
    made.items.append(Item(candidate, (index,), (None,), "linear", (), (name,)))
    slope = (there.mass - made.mass) / step
    if np.abs(slope).max() > 0.0:
        made.slopes[candidate.key] = slope
    drive = np.sum((there.actuator - made.actuator) * made.actuator, axis=0) / step
    power = np.sum(made.actuator**2, axis=0)
    drive = np.divide(drive, power, out=np.zeros_like(drive), where=power > 0.0)
    if np.abs(drive).max() > 0.0:
        made.drives[candidate.key] = drive


# ------------------------------------------------------------------------------ forces at joints
def _add_force(
    made: Equation,
    candidate: Candidate,
    effect: JointEffect,
    nodes: Mapping[str, np.ndarray],
    rows: _Rows,
) -> None:
    j, motion = candidate.index, made.motion
    ranges = _ranges(made, rows, j, None)
    settings = effect.grid(ranges)
    names = tuple(effect.parameters)
    nulls = {name: p.null for name, p in effect.parameters.items()}
    given = settings or ({},)
    values = np.array([[{**nulls, **at}[name] for name in names] for at in given])
    slopes = _force_slopes(effect.at(0), values, nodes, motion.dt)
    if settings and effect.blended:
        # By pairs: the slope by the first parameter at two values of the blended one.
        for first in range(0, len(settings) - 1, 2):
            pair = [_put(made, j, slopes[first + k, 0]) for k in (0, 1)]
            own = (settings[first], settings[first + 1])
            made.items.append(
                Item(candidate, tuple(pair), (None, None), "blend", own, (names[0], names[0]))
            )
        return
    for at, by_name in zip(given, slopes, strict=True):
        useful = [
            i for i, name in enumerate(names) if name not in at and np.abs(by_name[i]).max() > 0.0
        ]
        if useful:
            columns = tuple(_put(made, j, by_name[i]) for i in useful)
            own = (at,) if at else ()
            made.items.append(
                Item(
                    candidate,
                    columns,
                    (None,) * len(columns),
                    "linear",
                    own,
                    tuple(names[i] for i in useful),
                )
            )


def _add_closed_form(made: Equation, candidate: Candidate, nodes: Mapping[str, np.ndarray]) -> None:
    name, by_speed = CLOSED_FORMS[candidate.name]
    values = np.sum(nodes["weights"] * by_speed(nodes["v"]), axis=(1, 2))
    column = _put(made, candidate.index, values)
    made.items.append(Item(candidate, (column,), (None,), "linear", (), (name,)))


def _nodes(
    made: Equation, rows: _Rows, bias: np.ndarray, inertia: np.ndarray, joint: int
) -> dict[str, np.ndarray]:
    """
    Where forces are evaluated: at three places of each interval (Simpson's rule, within what the
    twin's integrator sees of it), each at three velocities (the sign of one is not known exactly).
    """
    motion, dt = made.motion, made.motion.dt
    places, shares = motion.seen * np.array([0.0, 0.5, 1.0]), np.array([1.0, 4.0, 1.0]) / 6.0
    if motion.seen == 0.0:
        places, shares = np.array([0.0]), np.array([1.0])
    q, v, next_q, next_v = (x[:, joint, None] for x in (rows.q, rows.v, rows.next_q, rows.next_v))
    # A cubic through both ends, of velocities a line.
    s = places
    position = (2 * s**3 - 3 * s**2 + 1) * q + dt * (s**3 - 2 * s**2 + s) * v
    position = position + (3 * s**2 - 2 * s**3) * next_q + dt * (s**3 - s**2) * next_v
    speed = (v * (1 - s) + next_v * s)[..., None] + motion.error_v[joint] * _PLACES
    return {
        "q": np.broadcast_to(position[..., None], speed.shape),
        "v": speed,
        "actuator": made.load[:, joint],
        "load": bias[:, joint],
        "inertia": inertia[:, joint],
        "weights": shares[:, None] * _WEIGHTS,
    }


def _force_slopes(
    effect: JointEffect, settings: np.ndarray, nodes: Mapping[str, np.ndarray], h: float
) -> np.ndarray:
    """:return: derivative of the mean force by each parameter, ``(settings, parameters, n)``"""
    weights, found = nodes["weights"], []
    effect, standstill = _for_any_joint(effect)
    rows = {name: x for name, x in nodes.items() if name != "weights"}
    with jax.enable_x64(True):
        for index, n in portions(len(rows["load"])):
            given = {name: jnp.asarray(x[index], jnp.float64) for name, x in rows.items()}
            slopes = [_slopes_of(effect, standstill, each, given, weights, h) for each in settings]
            found.append(np.stack(slopes)[..., :n])
    return np.concatenate(found, -1)


def _for_any_joint(effect: JointEffect) -> tuple[JointEffect, float]:
    """One program serves all joints: what differs between them is told apart from the effect."""
    if not isinstance(effect, DryFriction):
        return effect, 0.0
    return _standing_still_at(effect, 1.0), effect.standstill


def _standing_still_at(effect: DryFriction, speed: Any) -> DryFriction:
    changed = copy.copy(effect)
    changed.standstill = speed
    return changed


@partial(jax.jit, static_argnums=0, compiler_options=QUICKEST_COMPILATION)
def _slopes_of(
    effect: JointEffect,
    standstill: Array,
    values: Array,
    nodes: dict[str, Array],
    weights: Array,
    h: float,
) -> Array:
    names = tuple(effect.parameters)
    if isinstance(effect, DryFriction):
        effect = _standing_still_at(effect, standstill)

    def mean(values: Array, q: Array, v: Array, actuator: Array, load: Array, inertia: Array):
        params = dict(zip(names, values, strict=True))
        one = lambda q, v: effect.torque(  # noqa: E731
            JointMoment(q, v, actuator, load, inertia, h), (), params
        )
        return jnp.sum(weights * jax.vmap(jax.vmap(one))(q, v))

    along = lambda way: jax.jvp(  # noqa: E731
        lambda x: jax.vmap(partial(mean, x))(
            nodes["q"], nodes["v"], nodes["actuator"], nodes["load"], nodes["inertia"]
        ),
        (values,),
        (way,),
    )[1]
    return jax.vmap(along)(jnp.eye(len(names), dtype=values.dtype))


# ------------------------------------------------------------------------------ commands
def _add_command(
    made: Equation,
    hypotheses: Hypotheses,
    candidate: Candidate,
    effect: ActionEffect,
    rows: _Rows,
) -> None:
    twin, i, dt = hypotheses.believed, candidate.index, made.motion.dt
    if not rows.actions.size or not np.ptp(rows.actions[:, i]) > 0.0:
        return
    ranges = _ranges(made, rows, None, i)
    settings, names = effect.grid(ranges), tuple(effect.parameters)
    nulls = {name: p.null for name, p in effect.parameters.items()}
    if effect.chained and len(settings) < 2:
        return
    if not effect.chained:
        steps = [_STEP * effect.parameters[name].scale for name in names]
        given = [{**nulls, name: nulls[name] + s} for name, s in zip(names, steps, strict=True)]
    else:
        given = [{**nulls, **at} for at in settings]
    commands = _commanded(effect, given, rows, i, twin, dt)
    before = forces(twin, twin.params, rows.q, rows.v, rows.actions[None])[0]
    after = forces(twin, twin.params, rows.q, rows.v, commands)
    changes = after - before
    if not effect.chained:
        columns, useful = [], []
        for name, step, change in zip(names, steps, changes, strict=True):
            if np.abs(change).max() > 0.0:
                columns.append(_put_acting(made, change / step))
                useful.append(name)
        if columns:
            made.items.append(
                Item(candidate, tuple(columns), (None,) * len(columns), "linear", (), tuple(useful))
            )
        return
    for k in range(len(settings) - 1):
        whole = _put_acting(made, changes[k])
        part = _put_acting(made, changes[k + 1] - changes[k])
        made.items.append(
            Item(
                candidate,
                (whole, part),
                (1.0, None),
                "chain",
                (settings[k], settings[k + 1]),
                (effect.chained, effect.chained),
            )
        )


def _add_common(made: Equation, hypotheses: Hypotheses) -> None:
    """What all actuators share, such as a bus that is late: sums of the columns of each."""
    for candidate in (c for c in hypotheses.candidates if c.slot == "actuator" and c.index < 0):
        own = [item for item in made.items if item.candidate.name == candidate.name]
        by_settings: dict[str, list[Item]] = {}
        for item in own:
            by_settings.setdefault(repr(item.settings), []).append(item)
        places = len({item.candidate.index for item in own})
        for items in by_settings.values():
            if len(items) < places or places < 2:
                continue
            first = items[0]
            columns = []
            for k in range(len(first.columns)):
                total = np.zeros_like(made.missing)
                for item in items:
                    column = made.columns[item.columns[k]]
                    own_joint = slice(None) if column.joint is None else column.joint
                    total[:, own_joint] += column.values
                columns.append(_put(made, None, total))
            made.items.append(
                dataclasses.replace(first, candidate=candidate, columns=tuple(columns))
            )


def _put_acting(made: Equation, values: np.ndarray) -> int:
    """A column at the one joint at which it acts, if it is one."""
    acting = np.flatnonzero(np.abs(values).max(0) > 0.0)
    return (
        _put(made, int(acting[0]), values[:, acting[0]])
        if len(acting) == 1
        else _put(made, None, values)
    )


def _commanded(
    effect: ActionEffect,
    settings: Sequence[Mapping[str, float]],
    rows: _Rows,
    index: int,
    twin: Twin,
    dt: float,
) -> np.ndarray:
    """:return: commands as they arrive under each setting, shape ``(settings, n, n_act)``"""
    found = np.repeat(rows.actions[None], len(settings), 0).astype(float)
    names = tuple(effect.parameters)
    values = np.array([[at[name] for name in names] for at in settings])
    at_interval = twin.at_interval(dt, 1) if twin.dt != dt else twin
    with jax.enable_x64(True):
        memory = jax.tree.map(
            lambda leaf: jnp.asarray(leaf, jnp.float64), effect.memory(at_interval)
        )
        for r in np.unique(rows.recording):
            own = rows.recording == r
            commands = jnp.asarray(rows.actions[own, index], jnp.float64)
            found[:, own, index] = np.asarray(
                _arrived(effect.at(0), jnp.asarray(values), commands, memory, dt)
            )
    return found


@partial(jax.jit, static_argnums=(0, 4), compiler_options=QUICKEST_COMPILATION)
def _arrived(effect: ActionEffect, values: Array, commands: Array, memory: Any, h: float) -> Array:
    names = tuple(effect.parameters)

    def under(setting: Array) -> Array:
        params = dict(zip(names, setting, strict=True))

        def advance(memory: Any, command: Array) -> tuple[Any, Array]:
            arrived, after = effect.act(command, memory, h, params)
            return after, arrived

        return jax.lax.scan(advance, memory, commands)[1]

    return jax.vmap(under)(values)


# ------------------------------------------------------------------------------ sensors
def _add_sensor(
    made: Equation,
    hypotheses: Hypotheses,
    candidate: Candidate,
    effect: SensorEffect,
    rows: _Rows,
    smooth: np.ndarray,
) -> None:
    """Minus the change of the missing force when the channel is read as the effect says."""
    twin, channels = hypotheses.believed, (candidate.index,)
    if candidate.slot == "joint":
        channels = encoders(twin)[candidate.index].channels
    if isinstance(effect, SensorDelay):
        return
    (name, parameter), *others = effect.parameters.items()
    if others or parameter.upper - parameter.lower == 1.0:
        return  # a switch is no matter of degree
    spread = np.std(_observed(twin, rows.q, rows.v)[:, channels[0]])
    step = _STEP * (spread if parameter.unit == "channel unit" else 1.0)
    if not step > 0.0:
        return

    def read(q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return _reread(twin, effect.at(0), channels, q, v, float(parameter.null + step))

    q, v = read(rows.q, rows.v)
    _, next_v = read(rows.next_q, rows.next_v)
    there = _terms(twin, twin.params, rows._replace(q=q, v=v))
    effective = made.effective + there.mass - made.mass
    moved = np.einsum("nij,nj->ni", effective, next_v - v - there.change) / made.motion.dt
    column = -(moved - smooth) / step
    if np.isfinite(column).all() and np.abs(column).max() > 0.0:
        index = _put(made, None, column)
        made.items.append(Item(candidate, (index,), (None,), "linear", (), (name,)))


def _observed(twin: Twin, q: np.ndarray, v: np.ndarray) -> np.ndarray:
    with jax.enable_x64(True):
        return np.asarray(_observations(twin, jnp.asarray(q), jnp.asarray(v)))


@partial(jax.jit, static_argnums=0, compiler_options=QUICKEST_COMPILATION)
def _observations(twin: Twin, q: Array, v: Array) -> Array:
    memory = twin.infer(jnp.zeros(len(twin.channels), q.dtype), twin.params).memory
    return jax.vmap(lambda q, v: twin.observe(State(q, v, memory), twin.params))(q, v)


def _reread(
    twin: Twin,
    effect: SensorEffect,
    channels: tuple[int, ...],
    q: np.ndarray,
    v: np.ndarray,
    value: float,
) -> tuple[np.ndarray, np.ndarray]:
    """What joints did if a channel reports what the effect makes of it."""
    with jax.enable_x64(True):
        found = _inverted(twin, effect, channels, jnp.asarray(q), jnp.asarray(v), value)
        new_q, new_v = map(np.asarray, found)
    if not new_v.any():
        new_v = v  # no velocity is observed: its scale is that of the position
        (name,) = effect.parameters
        if name == "scale":
            new_v = v / value
    turns = 2.0 * np.pi * np.round((q - new_q) / (2.0 * np.pi))
    rotary = np.array([joint.unit == "rad" for joint in twin.joints])
    return new_q + np.where(rotary, turns, 0.0), new_v


@partial(jax.jit, static_argnums=(0, 1, 2), compiler_options=QUICKEST_COMPILATION)
def _inverted(
    twin: Twin, effect: SensorEffect, channels: tuple[int, ...], q: Array, v: Array, value: float
) -> tuple[Array, Array]:
    (name,) = effect.parameters
    memory = twin.infer(jnp.zeros(len(twin.channels), q.dtype), twin.params).memory

    def one(q: Array, v: Array) -> tuple[Array, Array]:
        obs = twin.observe(State(q, v, memory), twin.params)
        for i in channels:
            obs = obs.at[i].set(effect.invert(obs[i], {name: value}))
        state = twin.infer(obs, twin.params)
        return state.q, state.v

    return jax.vmap(one)(q, v)


def _ranges(made: Equation, rows: _Rows, joint: int | None, actuator: int | None) -> Ranges:
    motion, command = made.motion, np.zeros(1)
    if actuator is not None:
        command = rows.actions[:, actuator]
    own = slice(None) if joint is None else slice(joint, joint + 1)
    return Ranges(
        excursion=float(np.max(motion.excursion[own])),
        speed=float(np.max(motion.speed[own])),
        command=float(np.sqrt(np.mean(command**2))),
        largest=float(np.abs(command).max()),
        dt=motion.dt,
        period=float(np.min(motion.period[own])),
        turn=motion.turn[joint] if joint is not None else np.inf,
    )


def _rms(x: Float[np.ndarray, "..."]) -> float:
    return float(np.sqrt(np.mean(x**2)))
