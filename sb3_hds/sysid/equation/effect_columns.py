"""Columns of effects: forces at joints, delayed or distorted commands, sensor errors."""

import copy
import dataclasses
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array

from sb3_hds.core import ActionEffect, JointEffect, JointMoment, SensorEffect, State, Twin
from sb3_hds.core.numerics.compilation import QUICKEST_COMPILATION
from sb3_hds.effects import SensorDelay
from sb3_hds.effects.joint import DryFriction
from sb3_hds.sysid.equation.regression import (
    STEP,
    Equation,
    Item,
    put,
    put_acting,
    ranges_of,
    residual_force,
)
from sb3_hds.sysid.equation.terms import forces, memory_of, portions, terms
from sb3_hds.sysid.estimation.candidates import Candidate
from sb3_hds.sysid.motion.joints import encoders

# Nodes for a normal distribution, in standard deviations, and their weights (Gauss-Hermite).
_PLACES, _WEIGHTS = np.array([0.0, -np.sqrt(3.0), np.sqrt(3.0)]), np.array([4.0, 1.0, 1.0]) / 6.0
# Nodes in an interval from 0 to 1, of equal weight (Gauss-Legendre).
_GAUSS = 0.5 + np.array([-0.5, 0.5]) / np.sqrt(3.0)
# Least braking in an interval: Lambert's W has a branch point at zero.
_NO_BRAKE = 1e-6

#: by effect, its parameter and the force per unit of it at a velocity
CLOSED_FORMS: dict[str, tuple[str, Callable[[np.ndarray], np.ndarray]]] = {
    "viscous_friction": ("b", np.negative),
    "coulomb_friction": ("tau_c", lambda v: -np.sign(v)),
    "constant_force": ("tau_0", np.ones_like),
}


# ------------------------------------------------------------------------------ forces at joints
def add_force(
    made: Equation,
    candidate: Candidate,
    effect: JointEffect,
    nodes: Mapping[str, np.ndarray],
) -> None:
    """Columns of a force at a joint: its derivatives by its parameters, at fixed settings."""
    j, motion = candidate.index, made.motion
    settings = effect.grid(ranges_of(made, j, None))
    names = tuple(effect.parameters)
    nulls = {name: p.null for name, p in effect.parameters.items()}
    given = settings or ({},)
    values = np.array([[{**nulls, **at}[name] for name in names] for at in given])
    slopes = _force_slopes(effect.at(0), values, nodes, motion.dt)
    if settings and effect.blended:
        # By pairs: the slope by the first parameter at two values of the blended one.
        for first in range(0, len(settings) - 1, 2):
            pair = [put(made, j, slopes[first + k, 0]) for k in (0, 1)]
            own = (settings[first], settings[first + 1])
            made.items.append(Item(candidate, tuple(pair), names[:1] * 2, "blend", own))
        return
    for at, by_name in zip(given, slopes, strict=True):
        useful = [
            i for i, name in enumerate(names) if name not in at and np.abs(by_name[i]).max() > 0.0
        ]
        if useful:
            columns = tuple(put(made, j, by_name[i]) for i in useful)
            own = tuple(names[i] for i in useful)
            made.items.append(Item(candidate, columns, own, settings=(at,) if at else ()))


def add_closed_form(made: Equation, candidate: Candidate, nodes: Mapping[str, np.ndarray]) -> None:
    """The column of a force in :data:`CLOSED_FORMS`."""
    name, by_speed = CLOSED_FORMS[candidate.name]
    values = np.sum(nodes["weights"] * by_speed(nodes["v"]), axis=(1, 2))
    column = put(made, candidate.index, values)
    made.items.append(Item(candidate, (column,), (name,)))


def nodes_of(made: Equation, inertia: np.ndarray, joint: int) -> dict[str, np.ndarray]:
    """
    Quadrature nodes of each interval, over the part that the twin's integrator evaluates: two
    points (Gauss-Legendre) before and after the velocity changes its sign, so that the mean of dry
    friction is exact; each at three velocities (Gauss-Hermite), for the uncertainty of that
    instant. Where the model brakes the motion, a force counts more the later it acts.
    """
    motion, rows, dt = made.motion, made.rows, made.motion.dt
    ends = rows.q, rows.v, rows.next_q, rows.next_v
    q, v, next_q, next_v = (x[:, joint, None, None] for x in ends)
    first = v + motion.error_v[joint] * _PLACES
    change = motion.seen * (next_v - v)
    turns = first * (first + change) < 0.0
    before = np.where(turns, -first / np.where(turns, change, 1.0), 0.5)
    half = _GAUSS[:, None]
    inside = np.concatenate([before * half, before + (1.0 - before) * half], axis=1)
    shares = np.concatenate([before, before, 1.0 - before, 1.0 - before], axis=1)
    shares = shares * impulse_weights(made.terms.mass, made.effective_inertia, joint, inside)
    s = motion.seen * inside
    # A cubic through both ends, of velocities a line.
    position = (2 * s**3 - 3 * s**2 + 1) * q + dt * (s**3 - 2 * s**2 + s) * v
    position = position + (3 * s**2 - 2 * s**3) * next_q + dt * (s**3 - s**2) * next_v
    return {
        "q": position,
        "v": first + change * inside,
        "weights": 0.5 * shares * _WEIGHTS,
        "actuator": made.load[:, joint],
        "load": made.terms.bias[:, joint],
        "inertia": inertia[:, joint],
    }


def impulse_weights(
    mass: np.ndarray, effective: np.ndarray, joint: int, places: np.ndarray
) -> np.ndarray:
    r"""
    With a braking rate :math:`r`, :math:`e^{-r (h - s)}` remains of the impulse of a force at the
    time :math:`s` of an interval :math:`h`, and a constant force acts on the mass times
    :math:`x / (1 - e^{-x})`, :math:`x = r h`.

    :param mass: mass matrices, shape ``(n, dof, dof)``
    :param effective: effective inertias over the interval, shape ``(n, dof, dof)``
    :param places: in the interval, from 0 to 1, shape ``(n, ...)``
    :return: weight of a force there, relative to a constant force
    """
    met = np.diagonal(np.linalg.inv(mass) @ effective, axis1=1, axis2=2)[:, joint]
    more = np.maximum(met, 1.0 + _NO_BRAKE)
    x = more + np.real(scipy.special.lambertw(-more * np.exp(-more)))
    x = x.reshape(-1, *(1,) * (places.ndim - 1))
    return np.exp(-x * (1.0 - places)) * x / -np.expm1(-x)


def _force_slopes(
    effect: JointEffect, settings: np.ndarray, nodes: Mapping[str, np.ndarray], h: float
) -> np.ndarray:
    """:return: derivative of the mean force by each parameter, ``(settings, parameters, n)``"""
    found = []
    # One program serves all joints: the speed in which they differ is its argument.
    standstill = 0.0
    if isinstance(effect, DryFriction):
        effect, standstill = _standing_still_at(effect, 1.0), effect.standstill
    with jax.enable_x64(True):
        for index, n in portions(len(nodes["load"])):
            given = {name: jnp.asarray(x[index], jnp.float64) for name, x in nodes.items()}
            slopes = [_slopes_of(effect, standstill, each, given, h) for each in settings]
            found.append(np.stack(slopes)[..., :n])
    return np.concatenate(found, -1)


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
    h: float,
) -> Array:
    names = tuple(effect.parameters)
    if isinstance(effect, DryFriction):
        effect = _standing_still_at(effect, standstill)

    def mean(values: Array, row: dict[str, Array]) -> Array:
        params = dict(zip(names, values, strict=True))
        one = lambda q, v: effect.torque(  # noqa: E731
            JointMoment(q, v, row["actuator"], row["load"], row["inertia"], h), (), params
        )
        return jnp.sum(row["weights"] * jax.vmap(jax.vmap(one))(row["q"], row["v"]))

    along = lambda way: jax.jvp(  # noqa: E731
        lambda x: jax.vmap(partial(mean, x))(nodes), (values,), (way,)
    )[1]
    return jax.vmap(along)(jnp.eye(len(names), dtype=values.dtype))


# ------------------------------------------------------------------------------ commands
def add_command(made: Equation, candidate: Candidate, effect: ActionEffect) -> None:
    """Columns of delayed or distorted commands: changes of the actuators' force."""
    twin, rows, i = made.twin, made.rows, candidate.index
    if not rows.actions.size or not np.ptp(rows.actions[:, i]) > 0.0:
        return
    settings = effect.grid(ranges_of(made, None, i))
    nulls = {name: p.null for name, p in effect.parameters.items()}
    if effect.interpolated and len(settings) < 2:
        return
    steps = {name: STEP * p.scale for name, p in effect.parameters.items()}
    given = [{**nulls, **at} for at in settings]
    if not effect.interpolated:
        given = [{**nulls, name: nulls[name] + step} for name, step in steps.items()]
    commands = _commanded(made, effect, given, i)
    before = forces(twin, twin.params, rows.q, rows.v, rows.actions[None])[0]
    after = forces(twin, twin.params, rows.q, rows.v, commands)
    changes = after - before
    if not effect.interpolated:
        columns = {
            name: put_acting(made, change / step)
            for (name, step), change in zip(steps.items(), changes, strict=True)
            if np.abs(change).max() > 0.0
        }
        if columns:
            made.items.append(Item(candidate, (*columns.values(),), (*columns,)))
        return
    for k in range(len(settings) - 1):
        whole = put_acting(made, changes[k])
        part = put_acting(made, changes[k + 1] - changes[k])
        own = (effect.interpolated, effect.interpolated)
        made.items.append(Item(candidate, (whole, part), own, "chain", settings[k : k + 2]))


def add_common(made: Equation, candidates: Sequence[Candidate]) -> None:
    """Effects that all actuators share, such as a bus delay: sums of the columns of each one."""
    for candidate in (c for c in candidates if c.slot == "actuator" and c.index < 0):
        own = [item for item in made.items if item.candidate.name == candidate.name]
        by_settings: dict[str, list[Item]] = {}
        for item in own:
            by_settings.setdefault(repr(item.settings), []).append(item)
        places = len({item.candidate.index for item in own})
        for items in by_settings.values():
            if len(items) < places or places < 2:
                continue
            columns = []
            for same in zip(*(item.columns for item in items), strict=True):
                total = np.zeros_like(made.residual)
                for column in (made.columns[c] for c in same):
                    total[:, slice(None) if column.joint is None else column.joint] += column.values
                columns.append(put(made, None, total))
            shared = dataclasses.replace(items[0], candidate=candidate, columns=tuple(columns))
            made.items.append(shared)


def _commanded(
    made: Equation, effect: ActionEffect, settings: Sequence[Mapping[str, float]], index: int
) -> np.ndarray:
    """:return: commands as they arrive under each setting, shape ``(settings, n, n_act)``"""
    twin, rows, dt = made.twin, made.rows, made.motion.dt
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
def add_sensor(made: Equation, candidate: Candidate, effect: SensorEffect) -> None:
    """Minus the change of the residual force if the channel is corrected for the effect."""
    twin, rows, channels = made.twin, made.rows, (candidate.index,)
    if candidate.slot == "joint":
        channels = encoders(twin)[candidate.index].channels
    if isinstance(effect, SensorDelay):
        return
    (name, parameter), *others = effect.parameters.items()
    if others or parameter.upper - parameter.lower == 1.0:
        return  # a switch has no size
    with jax.enable_x64(True):
        observed = np.asarray(_observations(twin, jnp.asarray(rows.q), jnp.asarray(rows.v)))
    std = np.std(observed[:, channels[0]])
    step = STEP * (std if parameter.unit == "channel unit" else 1.0)
    if not step > 0.0:
        return

    def read(q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return _reread(twin, effect.at(0), channels, q, v, float(parameter.null + step))

    q, v = read(rows.q, rows.v)
    _, next_v = read(rows.next_q, rows.next_v)
    there = terms(twin, twin.params, q, v, rows.actions)
    inertia = made.effective_inertia + there.mass - made.terms.mass
    after = residual_force(inertia, next_v - v - there.change, made.motion.dt)
    column = -(after - made.smooth) / step
    if np.isfinite(column).all() and np.abs(column).max() > 0.0:
        index = put(made, None, column)
        made.items.append(Item(candidate, (index,), (name,)))


@partial(jax.jit, static_argnums=0, compiler_options=QUICKEST_COMPILATION)
def _observations(twin: Twin, q: Array, v: Array) -> Array:
    memory = memory_of(twin, twin.params, q.dtype)
    return jax.vmap(lambda q, v: twin.observe(State(q, v, memory), twin.params))(q, v)


def _reread(
    twin: Twin,
    effect: SensorEffect,
    channels: tuple[int, ...],
    q: np.ndarray,
    v: np.ndarray,
    value: float,
) -> tuple[np.ndarray, np.ndarray]:
    """:return: motion of the joints if a channel is corrected for the effect"""
    with jax.enable_x64(True):
        found = _inverted(twin, effect, channels, jnp.asarray(q), jnp.asarray(v), value)
        new_q, new_v = map(np.asarray, found)
    if not new_v.any():  # no velocity is observed: its scale is that of the position
        new_v = v / value if "scale" in effect.parameters else v
    turns = 2.0 * np.pi * np.round((q - new_q) / (2.0 * np.pi))
    rotary = np.array([joint.unit == "rad" for joint in twin.joints])
    return new_q + np.where(rotary, turns, 0.0), new_v


@partial(jax.jit, static_argnums=(0, 1, 2), compiler_options=QUICKEST_COMPILATION)
def _inverted(
    twin: Twin, effect: SensorEffect, channels: tuple[int, ...], q: Array, v: Array, value: float
) -> tuple[Array, Array]:
    (name,) = effect.parameters
    memory = memory_of(twin, twin.params, q.dtype)

    def one(q: Array, v: Array) -> tuple[Array, Array]:
        obs = twin.observe(State(q, v, memory), twin.params)
        for i in channels:
            obs = obs.at[i].set(effect.invert(obs[i], {name: value}))
        state = twin.infer(obs, twin.params)
        return state.q, state.v

    return jax.vmap(one)(q, v)
