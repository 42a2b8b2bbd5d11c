"""Twins given by their equation of motion."""

import abc

import jax

from sb3_hds.core.effect import NO_EFFECTS, EffectChain, Moment
from sb3_hds.core.integrators import Integrator, semi_implicit_euler
from sb3_hds.core.linear import solve_spd
from sb3_hds.core.twin import State, Twin
from sb3_hds.core.types import Action, Force, MassMatrix, Params, Position, Velocity


class AnalyticTwin(Twin):
    r"""
    A mechanical system written down as

    .. math:: M(q)\,\dot v + c(q, v) = \tau(q, v, u) + \tau_\text{effects}

    A subclass gives :math:`\tau` (:meth:`actuate`), :math:`M` (:meth:`mass_matrix`) and :math:`c`
    (:meth:`bias`: gravity, Coriolis, centrifugal and the twin's own damping), and names the
    integrator that its environment uses. Effects are evaluated wherever the equation of motion is,
    but for those that are held over a sub-step.
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

    def limit_velocity(self, v: Velocity) -> Velocity:
        """Where the environment clips speeds."""
        return v

    def limit(self, q: Position, v: Velocity) -> tuple[Position, Velocity]:
        """Where the environment clips or wraps the state, after each sub-step."""
        return q, v

    def step(
        self, state: State, action: Action, params: Params, effects: EffectChain = NO_EFFECTS
    ) -> State:
        h = self.dt / self.substeps

        def substep(state: State, _: None) -> tuple[State, None]:
            command, memory = effects.act(action, state.memory, h)

            def moment(q: Position, v: Velocity) -> Moment:
                actuator = self.actuate(State(q, v, state.memory), command, params)
                return Moment(
                    q, v, actuator, self.bias(q, v, params), self.mass_matrix(q, params), h
                )

            start = moment(state.q, state.v)
            held = effects.force(start, memory, held=True)

            def acceleration(q: Position, v: Velocity) -> Velocity:
                now = moment(q, v)
                added = held + effects.force(now, memory, held=False)
                return solve_spd(now.mass_matrix, now.actuator + added - now.load)

            q, v = self.integrator(acceleration, state.q, state.v, h, self.limit_velocity)
            q, v = self.limit(q, v)
            # With the new velocity: an elastic memory then keeps energy, as the twin itself does.
            return State(q, v, effects.advance(start, moment(q, v), memory)), None

        if self.substeps == 1:
            return substep(state, None)[0]
        return jax.lax.scan(substep, state, None, length=self.substeps)[0]
