"""Twins that are given by their equation of motion."""

import abc
import math
from functools import lru_cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sb3_hds.core.effect import Moment
from sb3_hds.core.effect_chain import NO_EFFECTS, EffectChain
from sb3_hds.core.numerics.compilation import QUICKEST_COMPILATION
from sb3_hds.core.numerics.integrators import Integrator, semi_implicit_euler
from sb3_hds.core.numerics.linear import solve_spd
from sb3_hds.core.twin import State, Twin
from sb3_hds.core.types import Action, Coordinates, Force, MassMatrix, Params, Position, Velocity

# Turns of a rotary joint at which its load is asked for: at one of them gravity pulls hard.
_TURNS = (0.0, 0.5 * math.pi, math.pi, -0.5 * math.pi)


class AnalyticTwin(Twin):
    r"""
    A mechanical system written down as

    .. math:: M(q)\,\dot v + c(q, v) = \tau(q, v, u) + \tau_\text{effects}

    A subclass gives :math:`\tau` (:meth:`actuate`), :math:`M` (:meth:`mass_matrix`) and :math:`c`
    (:meth:`bias`: gravity, Coriolis, centrifugal and the twin's own damping), and names the
    integrator that its environment uses. Effects are evaluated wherever the equation of motion is,
    but for those that are held over a sub-step: they are evaluated in its middle.
    """

    integrator: Integrator = staticmethod(semi_implicit_euler)

    @abc.abstractmethod
    def actuate(self, state: State, action: Action, params: Params) -> Force:
        """:return: force of the actuators, clipped as the environment does, shape ``(dof,)``"""

    @abc.abstractmethod
    def mass_matrix(self, q: Position, params: Params) -> MassMatrix:
        """:return: symmetric positive definite, shape ``(dof, dof)``"""

    @abc.abstractmethod
    def bias(self, q: Position, v: Velocity, params: Params) -> Force:
        """:return: the force that would keep the system from accelerating, shape ``(dof,)``"""

    def displace(self, q: Position, way: Velocity) -> Position:
        """:return: the position after a velocity times a time; override for quaternions"""
        return q + way

    def accelerate(self, state: State, command: Action, added: Force, params: Params) -> Velocity:
        """
        :param command: what reaches the actuators
        :param added: generalised force of the effects, shape ``(dof,)``
        :return: the acceleration; override where the equation of motion is solved another way
        """
        force = self.actuate(state, command, params) + added
        load = self.bias(state.q, state.v, params)
        return solve_spd(self.mass_matrix(state.q, params), force - load)

    def structure(self) -> tuple[Any, ...]:
        return (*super().structure(), self.integrator)

    def limit_velocity(self, v: Velocity) -> Velocity:
        """Override where the environment clips velocities."""
        return v

    def limit(self, q: Position, v: Velocity) -> tuple[Position, Velocity]:
        """Override where the environment clips or wraps the state after each sub-step."""
        return q, v

    def typical_forces(self) -> tuple[float, ...]:
        return _typical_forces(self)

    def step(
        self, state: State, action: Action, params: Params, effects: EffectChain = NO_EFFECTS
    ) -> State:
        h = self.dt / self.substeps

        def substep(state: State, _: None) -> tuple[State, None]:
            command, memory = effects.act(action, state.memory, h)

            def moment(q: Position, v: Velocity, *, whole: bool = False) -> Moment:
                actuator = self.actuate(State(q, v, state.memory), command, params)
                bias = lambda: self.bias(q, v, params)  # noqa: E731
                mass_matrix = lambda: self.mass_matrix(q, params)  # noqa: E731
                own = (bias(), mass_matrix()) if whole else effects.load(bias, mass_matrix)
                return Moment(self.coordinates(q), v, actuator, *own, h)

            still = jnp.zeros_like(state.v)
            held, middle = still, None
            if effects.has_forces:
                held, middle = effects.held(moment, state.q, state.v, memory, h, self.displace)

            def acceleration(q: Position, v: Velocity) -> Velocity:
                added = effects.force(moment(q, v), memory) if effects.has_forces else still
                return self.accelerate(State(q, v, state.memory), command, held + added, params)

            # Integrators of one's own need not know of quaternions.
            curved = type(self).displace is not AnalyticTwin.displace
            own = {"displace": self.displace} if curved else {}
            q, v = self.integrator(acceleration, state.q, state.v, h, self.limit_velocity, **own)
            q, v = self.limit(q, v)
            if middle is None:
                return State(q, v, memory), None
            # With the new velocity: an elastic memory then keeps energy, as the twin itself does.
            return State(q, v, effects.advance(middle, moment(q, v), memory)), None

        if self.substeps == 1:
            return substep(state, None)[0]
        return jax.lax.scan(substep, state, None, length=self.substeps)[0]


@lru_cache(maxsize=64)
def _typical_forces(twin: AnalyticTwin) -> tuple[float, ...]:
    """Largest force of actuators and gravity at each joint, with parameters at their nulls."""
    params = {name: jnp.asarray(parameter.null) for name, parameter in twin.parameters.items()}
    rotary = np.array([joint.unit == "rad" for joint in twin.joints], float)
    turned = np.concatenate(
        [np.outer(_TURNS, rotary), *(np.outer(_TURNS, r) for r in np.diag(rotary))]
    )
    limits = [max(abs(actuator.low), abs(actuator.high)) for actuator in twin.actuators]
    largest = jnp.array([limit if math.isfinite(limit) else 0.0 for limit in limits])

    @partial(jax.jit, compiler_options=QUICKEST_COMPILATION)
    def forces(key: jax.Array, turned: jax.Array) -> jax.Array:
        start = twin.initial(key, params)
        standing = start._replace(v=jnp.zeros_like(start.v))

        def at(turn: Coordinates) -> Force:
            state = standing._replace(q=twin.displace(start.q, turn))
            driven = twin.actuate(state, largest, params)
            return jnp.abs(driven) + jnp.abs(twin.bias(state.q, state.v, params))

        return jax.vmap(at)(turned).max(0)

    found = np.asarray(forces(jax.random.PRNGKey(0), jnp.asarray(turned)))
    return tuple(float(force) if np.isfinite(force) else 0.0 for force in found)
