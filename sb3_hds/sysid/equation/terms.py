"""The nominal model along measured motion: one step of the twin from every row."""

from collections.abc import Iterator
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sb3_hds.core import AnalyticTwin, Params, State, Twin
from sb3_hds.core.effect_chain import Attached, EffectChain
from sb3_hds.core.numerics.compilation import QUICKEST_COMPILATION
from sb3_hds.core.twin import plant_of
from sb3_hds.effects import ConstantForce

# Rows that are evaluated at a time: programs are compiled for one shape.
_ROWS = 1024
# Size of the probing force, in shares of the typical force at a joint.
_PUSH = 1e-3
# Largest condition number of the response to a force, relative to that of the mass matrix.
_STIFFEST = 1e6


class Terms(NamedTuple):
    """
    The nominal model along one recording, each leaf with a row for each interval.

    :param change: of the velocity over an interval, as the twin steps, shape ``(n, dof)``
    :param mass: mass matrix where the interval begins, shape ``(n, dof, dof)``
    :param actuator: force of the actuators there, shape ``(n, dof)``
    :param bias: force of gravity, Coriolis and centrifugal terms there, shape ``(n, dof)``
    """

    change: np.ndarray
    mass: np.ndarray
    actuator: np.ndarray
    bias: np.ndarray


def terms(
    twin: Twin,
    params: Params,
    q: Float[np.ndarray, "n dof"],
    v: Float[np.ndarray, "n dof"],
    actions: Float[np.ndarray, "n act"],
    recorded: bool = True,
    push: Float[np.ndarray, " dof"] | None = None,
) -> Terms:
    """
    :param twin: whose interval is that of the rows; what it remembers is filled from the first row
    :param params: its parameters
    :param q: positions where intervals begin
    :param v: velocities there
    :param actions: held over each interval
    :param recorded: whether rows follow one another, so that a twin may remember the ones before
    :param push: constant force at each joint besides what the twin has [N m] or [N]; default: none
    """
    parts = []
    with jax.enable_x64(True):
        params = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), dict(params))
        pushed = jnp.asarray(np.zeros(q.shape[1]) if push is None else push, jnp.float64)
        if recorded and _remembers(twin):
            given = (jnp.asarray(x, jnp.float64) for x in (q, v, actions))
            return Terms(*map(np.asarray, _in_sequence(twin, params, pushed, *given)))
        for index, n in portions(len(q)):
            given = (jnp.asarray(x[index], jnp.float64) for x in (q, v, actions))
            found = _in_parallel(twin, params, pushed, *given)
            parts.append([np.asarray(leaf)[:n] for leaf in found])
    return Terms(*map(np.concatenate, zip(*parts, strict=True)))


def effective_inertia(
    twin: Twin,
    params: Params,
    q: Float[np.ndarray, "n dof"],
    v: Float[np.ndarray, "n dof"],
    actions: Float[np.ndarray, "n act"],
    found: Terms,
) -> Float[np.ndarray, "n dof dof"]:
    r"""
    The inertia that a constant force acts on over an interval,

    .. math:: h \left(\frac{\partial\,\Delta v}{\partial f}\right)^{-1}

    It is the mass matrix plus the effect of damping within the interval: several times as much
    where a stiff servo brakes the motion.

    :param found: :func:`terms` of the same rows
    :return: the mass matrix where the twin's step does not respond to forces
    """
    plant = plant_of(twin)
    if not isinstance(plant, AnalyticTwin):
        return found.mass
    sizes = _PUSH * np.array([force or 1.0 for force in plant.typical_forces()])
    response = np.stack(
        [
            (terms(twin, params, q, v, actions, push=size * unit).change - found.change) / size
            for size, unit in zip(sizes, np.eye(len(sizes)), strict=True)
        ],
        -1,
    )
    well = np.asarray(np.isfinite(response).all((1, 2)))
    safe = np.where(well[:, None, None], response, np.eye(len(sizes)))
    well &= np.linalg.cond(safe) < _STIFFEST * np.linalg.cond(found.mass)
    inertia = found.mass.copy()
    inertia[well] = twin.dt * np.linalg.inv(response[well])
    return inertia


def portions(n: int) -> Iterator[tuple[np.ndarray, int]]:
    """:return: indices in portions of equal size, the last one padded, and how many are real"""
    for first in range(0, n, _ROWS):
        yield np.minimum(np.arange(first, first + _ROWS), n - 1), min(_ROWS, n - first)


def forces(
    twin: Twin,
    params: Params,
    q: Float[np.ndarray, "n dof"],
    v: Float[np.ndarray, "n dof"],
    actions: Float[np.ndarray, "m n act"],
) -> Float[np.ndarray, "m n dof"]:
    """:return: force of the actuators under other commands in the same states"""
    plant, parts = plant_of(twin), []
    assert isinstance(plant, AnalyticTwin)
    with jax.enable_x64(True):
        params = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), dict(params))
        for index, n in portions(len(q)):
            state = jnp.asarray(q[index], jnp.float64), jnp.asarray(v[index], jnp.float64)
            found = [
                np.asarray(_actuated(plant, params, *state, jnp.asarray(each[index], jnp.float64)))
                for each in actions
            ]
            parts.append(np.stack(found)[:, :n])
    return np.concatenate(parts, 1)


def _remembers(twin: Twin) -> bool:
    obs = jnp.zeros(len(twin.channels))
    return bool(jax.tree.leaves(jax.eval_shape(lambda: twin.infer(obs, twin.params).memory)))


def _one_step(
    twin: Twin, params: Params, push: Array, state: State, action: Array
) -> tuple[State, tuple]:
    plant = plant_of(twin)
    if not isinstance(plant, AnalyticTwin):
        after, still = twin.step(state, action, params), jnp.zeros_like(state.v)
        return after, (after.v - state.v, jnp.eye(len(still), dtype=still.dtype), still, still)
    pushes = [Attached(f"push.{j}", ConstantForce().at(j), j) for j in range(len(push))]
    sizes = {f"{a.key}.tau_0": push[a.index] for a in pushes}
    pushed = state._replace(memory=state.memory | {a.key: () for a in pushes})
    after = twin.step(pushed, action, params, EffectChain(tuple(pushes), sizes))
    after = after._replace(memory={key: after.memory[key] for key in state.memory})
    mass = plant.mass_matrix(state.q, params)
    actuator, bias = plant.actuate(state, action, params), plant.bias(state.q, state.v, params)
    return after, (after.v - state.v, mass, actuator, bias)


@partial(jax.jit, static_argnums=0, compiler_options=QUICKEST_COMPILATION)
def _in_parallel(
    twin: Twin, params: Params, push: Array, q: Array, v: Array, actions: Array
) -> tuple:
    nothing = memory_of(twin, params, q.dtype)
    one = lambda q, v, u: _one_step(twin, params, push, State(q, v, nothing), u)[1]  # noqa: E731
    return jax.vmap(one)(q, v, actions)


@partial(jax.jit, static_argnums=0, compiler_options=QUICKEST_COMPILATION)
def _in_sequence(
    twin: Twin, params: Params, push: Array, q: Array, v: Array, actions: Array
) -> tuple:
    obs = twin.observe(State(q[0], v[0], memory_of(twin, params, q.dtype)), params)
    first = twin.infer(obs, params).memory

    def advance(memory: dict, row: tuple) -> tuple[dict, tuple]:
        after, found = _one_step(twin, params, push, State(row[0], row[1], memory), row[2])
        return after.memory, found

    return jax.lax.scan(advance, first, (q, v, actions))[1]


def memory_of(twin: Twin, params: Params, dtype: np.dtype) -> dict:
    """:return: what a twin remembers before a recording begins"""
    obs = jnp.zeros(len(twin.channels), dtype)
    return twin.infer(obs, params).memory


@partial(jax.jit, static_argnums=0, compiler_options=QUICKEST_COMPILATION)
def _actuated(plant: AnalyticTwin, params: Params, q: Array, v: Array, actions: Array) -> Array:
    one = lambda q, v, action: plant.actuate(State(q, v, {}), action, params)  # noqa: E731
    return jax.vmap(one)(q, v, actions)
