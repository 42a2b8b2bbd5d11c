"""Twins defined by an equation of motion."""

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

# Rotations of a hinge at which its load is evaluated: at one of them gravity pulls hard [rad].
_ROTATIONS = (0.0, 0.5 * math.pi, math.pi, -0.5 * math.pi)


class AnalyticTwin(Twin):
    r"""
    A mechanical system with the equation of motion

    .. math:: M(q)\,\dot v + c(q, v) = \tau(q, v, u) + \tau_\text{effects}

    A subclass implements :math:`\tau` (:meth:`actuate`), :math:`M` (:meth:`mass_matrix`) and
    :math:`c` (:meth:`bias`: gravity, Coriolis and centrifugal forces, and the twin's own damping),
    and declares the integrator that its environment uses. Effects are evaluated at every stage of
    the integrator, except held ones: those are evaluated once, in the middle of a sub-step.
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

    def displace(self, q: Position, displacement: Velocity) -> Position:
        """
        :param displacement: a velocity times a time
        :return: the position after it; override for quaternions
        """
        return q + displacement

    def accelerate(self, state: State, command: Action, added: Force, params: Params) -> Velocity:
        """
        :param command: what reaches the actuators
        :param added: generalised force of the effects, shape ``(dof,)``
        :return: the acceleration; override to solve the equation of motion in another way
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

            def moment(q: Position, v: Velocity, *, with_load: bool = False) -> Moment:
                actuator = self.actuate(State(q, v, state.memory), command, params)
                bias = lambda: self.bias(q, v, params)  # noqa: E731
                mass_matrix = lambda: self.mass_matrix(q, params)  # noqa: E731
                terms = (bias(), mass_matrix()) if with_load else effects.load(bias, mass_matrix)
                return Moment(self.coordinates(q), v, actuator, *terms, h)

            zero = jnp.zeros_like(state.v)
            held, middle = zero, None
            if effects.has_forces:
                held, middle = effects.held(moment, state.q, state.v, memory, h, self.displace)

            def acceleration(q: Position, v: Velocity) -> Velocity:
                added = effects.force(moment(q, v), memory) if effects.has_forces else zero
                return self.accelerate(State(q, v, state.memory), command, held + added, params)

            # A user's integrator may lack the argument: only twins with quaternions need it.
            overridden = type(self).displace is not AnalyticTwin.displace
            own = {"displace": self.displace} if overridden else {}
            q, v = self.integrator(acceleration, state.q, state.v, h, self.limit_velocity, **own)
            q, v = self.limit(q, v)
            if middle is None:
                return State(q, v, memory), None
            # With the new velocity, so that elastic memories conserve energy as the twin does.
            return State(q, v, effects.advance(middle, moment(q, v), memory)), None

        if self.substeps == 1:
            return substep(state, None)[0]
        return jax.lax.scan(substep, state, None, length=self.substeps)[0]


@lru_cache(maxsize=64)
def _typical_forces(twin: AnalyticTwin) -> tuple[float, ...]:
    """Largest force of actuators and gravity at each joint, at the nominal parameters."""
    params = {name: jnp.asarray(parameter.null) for name, parameter in twin.parameters.items()}
    rotary = np.array([joint.unit == "rad" for joint in twin.joints], float)
    # All hinges together, then each alone.
    rotations = np.concatenate([np.outer(_ROTATIONS, r) for r in (rotary, *np.diag(rotary))])
    limits = [max(abs(actuator.low), abs(actuator.high)) for actuator in twin.actuators]
    largest = jnp.array([limit if math.isfinite(limit) else 0.0 for limit in limits])

    @partial(jax.jit, compiler_options=QUICKEST_COMPILATION)
    def forces(key: jax.Array, rotations: jax.Array) -> jax.Array:
        start = twin.initial(key, params)
        at_rest = start._replace(v=jnp.zeros_like(start.v))

        def force_at(rotation: Coordinates) -> Force:
            state = at_rest._replace(q=twin.displace(start.q, rotation))
            driven = twin.actuate(state, largest, params)
            return jnp.abs(driven) + jnp.abs(twin.bias(state.q, state.v, params))

        return jax.vmap(force_at)(rotations).max(0)

    found = np.asarray(forces(jax.random.PRNGKey(0), jnp.asarray(rotations)))
    return tuple(float(force) if np.isfinite(force) else 0.0 for force in found)
