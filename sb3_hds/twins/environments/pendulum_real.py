"""Twin of ``sb3_hds/PendulumReal-v1``: the pendulum of ``Pendulum-v1`` in continuous time."""

from typing import Any, Self

import jax.numpy as jnp

from sb3_hds.core import Channel, Force, MassMatrix, Parameter, Params, Position, Velocity, rk4
from sb3_hds.twins.environments.pendulum import Pendulum


class PendulumReal(Pendulum):
    r"""
    A rod swung up by a torque at its pivot, integrated accurately.

    .. math::
        \Big(\tfrac{1}{3} m + m_p\Big) l^2 \dot\omega
        = \Big(\tfrac{1}{2} m + m_p\Big) g l \sin\theta - b\,\omega + u

    Task, observations and constants are those of :class:`Pendulum`; the speed has no limit. Four
    Runge-Kutta steps per control interval agree with MuJoCo to 1e-6; the semi-implicit Euler steps
    of :class:`Pendulum` deviate visibly within a second.

    :meth:`from_env` reads the data sheet of ``sb3_hds/PendulumReal-v1``: gravity, mass, length and
    damping. A payload at the tip, dry friction, drag, and effects on commands and measurements are
    hidden from it, and known to ``sb3_hds.envs.true_twin``.
    """

    name = "PendulumReal"
    env_id = "sb3_hds/PendulumReal-v1"
    substeps = 4
    integrator = staticmethod(rk4)
    channels = (
        Channel("cos", "1"),
        Channel("sin", "1"),
        Channel("speed", "rad/s"),
    )
    parameters = {
        **Pendulum.parameters,
        "damping": Parameter(null=0.0, scale=0.05, unit="N m s/rad", lower=0.0),
        "payload": Parameter(null=0.0, scale=0.1, unit="kg", lower=0.0),
    }
    native_effects = {("viscous_friction", 0): {"b": "damping"}}

    @classmethod
    def from_env(cls, env: Any) -> Self:
        env = env.unwrapped
        return cls(
            gravity=env.gravity,
            mass=env.mass,
            length=env.length,
            damping=env.damping,
            dt=env.dt,
        )

    def mass_matrix(self, q: Position, params: Params) -> MassMatrix:
        rod = super().mass_matrix(q, params)
        return rod + params["payload"] * params["length"] ** 2

    def bias(self, q: Position, v: Velocity, params: Params) -> Force:
        payload = params["payload"] * params["gravity"] * params["length"] * jnp.sin(q)
        return super().bias(q, v, params) - payload + params["damping"] * v

    def limit_velocity(self, v: Velocity) -> Velocity:
        return v
