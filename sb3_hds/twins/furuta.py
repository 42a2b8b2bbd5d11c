"""Furuta's pendulum: an arm that turns in the plane and carries a pendulum."""

import math

import jax.numpy as jnp

from sb3_hds.core import (
    Action,
    Actuator,
    Force,
    Joint,
    MassMatrix,
    Parameter,
    Params,
    Position,
    State,
    Velocity,
)
from sb3_hds.twins.rig import Rig


class Furuta(Rig):
    r"""
    A motor turns a horizontal arm; at its end a pendulum swings across it. Angles are zero where
    the pendulum hangs.

    .. math::
        \big(J_1 + m l_1^2 + J \sin^2\alpha\big)\,\ddot\theta + m l_1 a \cos\alpha\,\ddot\alpha
        + J \sin 2\alpha\,\dot\theta\dot\alpha - m l_1 a \sin\alpha\,\dot\alpha^2 &= u \\
        m l_1 a \cos\alpha\,\ddot\theta + J\,\ddot\alpha
        - \tfrac12 J \sin 2\alpha\,\dot\theta^2 + m g a \sin\alpha &= 0

    with the arm's moment of inertia :math:`J_1` about its axis, the pendulum's :math:`J = I + m
    a^2` about its hinge, and viscous friction at both joints.

    Source: Cazzolato and Prime, *On the dynamics of the Furuta pendulum*, Journal of Control
    Science and Engineering, 2011, for a slender pendulum.
    """

    name = "Furuta"
    joints = (Joint("arm", "rad"), Joint("pendulum", "rad"))
    actuators = (Actuator("motor", "N m", -math.inf, math.inf),)
    parameters = {
        "gravity": Parameter(null=9.81, scale=0.5, unit="m/s2", lower=0.0),
        "arm_inertia": Parameter(null=6e-4, scale=1e-4, unit="kg m2", lower=1e-9),
        "arm_length": Parameter(null=0.085, scale=0.01, unit="m", lower=1e-6),
        "mass": Parameter(null=0.024, scale=0.003, unit="kg", lower=1e-6),
        "com": Parameter(null=0.065, scale=0.01, unit="m", lower=1e-6),
        "inertia": Parameter(null=3.3e-5, scale=5e-6, unit="kg m2", lower=0.0),
        "arm_damping": Parameter(null=0.0, scale=5e-4, unit="N m s/rad", lower=0.0),
        "pendulum_damping": Parameter(null=0.0, scale=5e-5, unit="N m s/rad", lower=0.0),
    }
    native_effects = {
        ("viscous_friction", 0): {"b": "arm_damping"},
        ("viscous_friction", 1): {"b": "pendulum_damping"},
    }

    def actuate(self, state: State, action: Action, params: Params) -> Force:
        return jnp.stack([action[0], jnp.zeros_like(action[0])])

    def mass_matrix(self, q: Position, params: Params) -> MassMatrix:
        mass, arm, a = params["mass"], params["arm_length"], params["com"]
        hinge = params["inertia"] + mass * a**2
        across = mass * arm * a * jnp.cos(q[1])
        turning = params["arm_inertia"] + mass * arm**2 + hinge * jnp.sin(q[1]) ** 2
        return jnp.stack([turning, across, across, hinge + 0.0 * across]).reshape(2, 2)

    def bias(self, q: Position, v: Velocity, params: Params) -> Force:
        mass, arm, a = params["mass"], params["arm_length"], params["com"]
        turn = (params["inertia"] + mass * a**2) * jnp.sin(2.0 * q[1])
        sine = jnp.sin(q[1])
        return jnp.stack(
            [
                turn * v[0] * v[1]
                - mass * arm * a * sine * v[1] ** 2
                + params["arm_damping"] * v[0],
                -0.5 * turn * v[0] ** 2
                + mass * params["gravity"] * a * sine
                + params["pendulum_damping"] * v[1],
            ]
        )
