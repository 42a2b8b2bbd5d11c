"""MuJoCo's engine as a twin."""

import abc
import functools
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Float

from sb3_hds.core import NO_EFFECTS, EffectChain, Moment, State
from sb3_hds.core.types import (
    Action,
    Force,
    MassMatrix,
    Memory,
    Params,
    Position,
    Velocity,
)
from sb3_hds.twins.mujoco.engine.host import Function, on_host
from sb3_hds.twins.mujoco.engine.simulator import Reading, Simulator
from sb3_hds.twins.mujoco.engine.values import Values
from sb3_hds.twins.mujoco.library import mujoco
from sb3_hds.twins.mujoco.model_twin import QuaternionTwin
from sb3_hds.twins.mujoco.rigid_body.quaternions import turning

# Key of a state's memory under which readings of the engine are.
_READ = "read"


class Source(abc.ABC):
    """Where a model comes from: hashable, so that equal twins share one simulator."""

    @abc.abstractmethod
    def load(self) -> Any:
        """:return: the compiled model, an ``MjModel``"""


class EngineTwin(QuaternionTwin):
    r"""
    Abstract: MuJoCo's C engine, with contacts, limits and tendons, as a twin.

    A batch of control intervals is one call of the engine, in as many threads as there are
    processors; so is a batch of Jacobians, by one-sided finite differences of 1e-6
    (``mjd_transitionFD`` but for RK4), for forward and reverse mode alike. There is no second
    derivative.

    - Every interval begins without a warm start of the constraint solver, so that a state
      determines the next one. An environment goes on from its last solution; both agree up to the
      tolerance of its solver.
    - Derivatives are those of soft contacts. Where a contact begins, they see at best its onset.
    - Readings of the engine (:meth:`readings`) are no part of the tangent space: they do not
      influence the next step, and their derivatives are zero.
    - Force effects are held over a step of the engine, at whose beginning they are evaluated, and
      treat the mass matrix and the forces of gravity and inertia as constants in derivatives.
    - ``calibrate`` and ``diagnose`` refuse it: they would take hours.

    A subclass declares signals and parameters (``values.declared``), and implements
    :meth:`source`.
    """

    differentiability = "differences"

    @abc.abstractmethod
    def source(self) -> Source:
        """:return: where the nominal model comes from"""

    def readings(self) -> Mapping[str, tuple[Reading, int]]:
        """
        :return: by name, what to read from ``MjData`` after an interval, and its length; see
            :meth:`reading`. The functions must be hashable and the same for equal twins.
        """
        return {}

    @property
    def model(self) -> Any:
        """The nominal model, an ``MjModel``; its values are those of ``parameters``' nulls."""
        return _model(self.source())

    @property
    def quaternions(self) -> tuple[tuple[int, int], ...]:
        return _quaternions(self.source())

    @property
    def reference(self) -> Float[np.ndarray, " n_q"]:
        return self.model.qpos0

    def structure(self) -> tuple[Any, ...]:
        return (*super().structure(), self.source())

    def typical_forces(self) -> tuple[float, ...]:
        """The largest force of the actuators on each joint, at the reference position."""
        return _typical_forces(self.source())

    # --- steps

    def step(
        self, state: State, action: Action, params: Params, effects: EffectChain = NO_EFFECTS
    ) -> State:
        row = _Row(state.q, state.v, action, jnp.zeros_like(state.v), self._values(state, params))
        if effects.is_empty:
            return self._after(self._interval(self.substeps), row, state.memory)
        h = self.dt / self.substeps
        last = self._interval(1)

        def substep(state: State, _: None) -> tuple[State, None]:
            command, memory = effects.act(action, state.memory, h)
            if not effects.has_forces:
                moved = row._replace(q=state.q, v=state.v, action=command)
                return self._after(last, moved, memory), None
            here = row._replace(q=state.q, v=state.v, action=command)
            matrix, load, actuator = self._terms(here)

            def moment(q: Position, v: Velocity, *, with_load: bool = False) -> Moment:
                terms = (load, matrix) if with_load else effects.load(lambda: load, lambda: matrix)
                return Moment(self.coordinates(q), v, actuator, *terms, h)

            held, middle = effects.held(moment, state.q, state.v, memory, h, self.displace)
            force = held + effects.force(moment(state.q, state.v), memory)
            after = self._after(last, here._replace(force=force), memory)
            memory = effects.advance(middle, moment(after.q, after.v), after.memory)
            return after._replace(memory=memory), None

        return jax.lax.scan(substep, state, None, length=self.substeps)[0]

    def _after(self, interval: "_Interval", row: "_Row", memory: dict[str, Memory]) -> State:
        q, v, read = interval(row)
        return State(q, v, memory | {_READ: read} if self.readings() else memory)

    def _values(self, state: State, params: Params) -> Float[Array, " parameters"]:
        values = [jnp.asarray(params[name], state.q.dtype) for name in self.parameters]
        return jnp.stack(values) if values else jnp.zeros(0, state.q.dtype)

    def _interval(self, n_steps: int) -> "_Interval":
        scales = tuple(parameter.scale for parameter in self.parameters.values())
        key = (self.source(), tuple(self.parameters), scales, self.dt / self.substeps, n_steps)
        return _interval(*key, tuple(self.readings().values()))

    def _terms(self, row: "_Row") -> tuple[MassMatrix, Force, Force]:
        """Mass matrix, load and actuator force, without derivatives."""
        n = len(row.v)
        found = _without_derivative(self._interval(1).terms, n * n + 2 * n, row)
        return found[: n * n].reshape(n, n), found[n * n : n * n + n], found[n * n + n :]

    # --- readings

    def reading(self, state: State, name: str) -> Float[Array, " n"]:
        """:return: what the engine read after the interval that led to a state"""
        at = 0
        for other, (_, size) in self.readings().items():
            if other == name:
                return state.memory[_READ][at : at + size]
            at += size
        raise KeyError(name)

    def look(self, state: State) -> State:
        """:return: a state that was not simulated, with what the engine reads there at once"""
        values = self._values(state, dict(self.values))
        still = jnp.zeros(len(self.actuators), state.q.dtype)
        row = _Row(state.q, state.v, still, jnp.zeros_like(state.v), values)
        interval = self._interval(self.substeps)
        size = interval.simulator.layout.n_readings
        read = _without_derivative(interval.look, size, row)
        return state._replace(memory=state.memory | {_READ: read})

    def with_readings(self, state: State, **readings: Array) -> State:
        """:return: the state with its readings, all of them, set"""
        read = jnp.concatenate([readings[name] for name in self.readings()])
        return state._replace(memory=state.memory | {_READ: read.astype(state.q.dtype)})

    def kept(self, state: State) -> dict[str, Memory]:
        """:return: the memory without readings"""
        return {name: memory for name, memory in state.memory.items() if name != _READ}


class _Row(NamedTuple):
    """What the engine needs for an interval."""

    q: Position
    v: Velocity
    action: Action
    force: Force
    values: Float[Array, " parameters"]

    def flat(self) -> Float[Array, " n"]:
        return jnp.concatenate([part.astype(self.q.dtype) for part in self])


class _Interval(NamedTuple):
    """
    An interval of constant commands, with its derivative.

    :param simulator: that computes it
    :param call: a row to position, velocity and readings
    :param terms: of the simulator; the same object for all programs
    :param look: likewise
    """

    simulator: Simulator
    call: Callable[[_Row], tuple[Position, Velocity, Memory]]
    terms: Function
    look: Function

    def __call__(self, row: _Row) -> tuple[Position, Velocity, Memory]:
        return self.call(row)


@functools.lru_cache(maxsize=16)
def _model(source: Source) -> Any:
    return source.load()


@functools.lru_cache(maxsize=16)
def _quaternions(source: Source) -> tuple[tuple[int, int], ...]:
    """Index of each quaternion in positions, and how much lower it is in velocities."""
    model, mj = _model(source), mujoco()
    found = []
    for j in range(model.njnt):
        at = int(model.jnt_qposadr[j])
        if model.jnt_type[j] == mj.mjtJoint.mjJNT_FREE:
            found.append((at + 3, len(found)))
        elif model.jnt_type[j] == mj.mjtJoint.mjJNT_BALL:
            found.append((at, len(found)))
    return tuple(found)


@functools.lru_cache(maxsize=16)
def _typical_forces(source: Source) -> tuple[float, ...]:
    model, mj = _model(source), mujoco()
    data = mj.MjData(model)
    low, high = model.actuator_ctrlrange.T
    limited = model.actuator_ctrllimited.astype(bool)
    largest = np.zeros(model.nv)
    mj.mj_forward(model, data)
    idle = data.qfrc_actuator.copy()
    for i in np.flatnonzero(limited):
        data.ctrl[:] = 0.0
        data.ctrl[i] = max(abs(low[i]), abs(high[i]))
        mj.mj_forward(model, data)
        largest += np.abs(data.qfrc_actuator - idle)
    return tuple(largest.tolist())


@functools.lru_cache(maxsize=32)
def _interval(
    source: Source,
    names: tuple[str, ...],
    scales: tuple[float, ...],
    timestep: float,
    n_steps: int,
    readings: tuple[tuple[Reading, int], ...],
) -> _Interval:
    """One simulator for all equal twins, so that they share compiled programs."""
    model = _model(source)
    simulator = Simulator(
        Values(model, names),
        np.array(scales),
        timestep,
        n_steps,
        [reading for reading, _ in readings],
        sum(size for _, size in readings),
    )
    layout, quaternions = simulator.layout, _quaternions(source)
    nq, nv = layout.nq, layout.nv
    # Bound once: a program is compiled once for each object.
    ahead, linear, linear_more = simulator.advance, simulator.linearise, simulator.linearise_more

    def parts(found: Array) -> tuple[Position, Velocity, Memory]:
        return found[:nq], found[nq : nq + nv], found[nq + nv : layout.n_out]

    @jax.custom_jvp
    def call(*row: Array) -> tuple[Position, Velocity, Memory]:
        return parts(on_host(ahead, layout.n_out, _Row(*row).flat()))

    def derivative(at: Any, changes: Any) -> Any:
        row, change = _Row(*at), _Row(*changes)
        more = not all(isinstance(c, SymbolicZero) for c in (change.force, change.values))
        n_columns = layout.n_columns(more)
        function = linear_more if more else linear
        found = on_host(function, layout.n_out + 2 * nv * n_columns, row.flat())
        jacobian = found[layout.n_out :].reshape(2 * nv, n_columns)
        change = _Row(*(_dense(c) for c in change))
        turn = _to_tangent(row.q, change.q, quaternions)
        along = [turn, change.v, change.action]
        along += [change.force, change.values] if more else []
        moved = jacobian @ jnp.concatenate([part.astype(row.q.dtype) for part in along])
        q, v, read = parts(found)
        return (q, v, read), (
            _from_tangent(q, moved[:nv], quaternions),
            moved[nv:],
            jnp.zeros_like(read),
        )

    call.defjvp(derivative, symbolic_zeros=True)
    return _Interval(simulator, lambda row: call(*row), simulator.terms, simulator.look)


def _without_derivative(function: Function, size: int, row: _Row) -> Array:
    call = jax.custom_jvp(lambda flat: on_host(function, size, flat))
    call.defjvp(lambda at, _: (found := call(*at), jnp.zeros_like(found)))
    return call(jax.lax.stop_gradient(row.flat()))


def _dense(change: Any) -> Array:
    if isinstance(change, SymbolicZero):
        like: Any = change.aval
        return jnp.zeros(like.shape, like.dtype)
    return change


def _to_tangent(q: Position, change: Position, quaternions: Any) -> Velocity:
    """A change of the numbers of a position as displacements and rotations in the body's frame."""
    parts, at = [], 0
    for start, _ in quaternions:
        parts.append(change[at:start])
        parts.append(turning(q[start : start + 4], change[start : start + 4]))
        at = start + 4
    return jnp.concatenate([*parts, change[at:]])


def _from_tangent(q: Position, moved: Velocity, quaternions: Any) -> Position:
    """The inverse of :func:`_to_tangent` at unit quaternions."""
    parts, at = [], 0
    for start, shift in quaternions:
        parts.append(moved[at - shift : start - shift])
        (w, x, y, z), turn = q[start : start + 4], moved[start - shift : start - shift + 3]
        half = 0.5 * jnp.array([[-x, -y, -z], [w, -z, y], [z, w, -x], [-y, x, w]]) @ turn
        parts.append(half)
        at = start + 4
    return jnp.concatenate([*parts, moved[at - len(quaternions) :]])
