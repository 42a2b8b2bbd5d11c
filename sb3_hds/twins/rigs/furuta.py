"""Furuta's pendulum: a pendulum on an arm that rotates in the horizontal plane."""

import math
from typing import Any

import jax.numpy as jnp

from sb3_hds.core import Actuator, Joint, Parameter, State
from sb3_hds.core.types import Action, Force, MassMatrix, Params, Position, Scalar, Velocity
from sb3_hds.twins.rigs.rig import TILT, Rig


class Furuta(Rig):
    r"""
    A motor rotates a horizontal arm, and a pendulum at its end swings across it. The pendulum hangs
    at zero.

    .. math::
        \big(J_1 + m l_1^2 + J \sin^2\alpha\big)\,\ddot\theta + m l_1 a \cos\alpha\,\ddot\alpha
        + J \sin 2\alpha\,\dot\theta\dot\alpha - m l_1 a \sin\alpha\,\dot\alpha^2 &= u \\
        m l_1 a \cos\alpha\,\ddot\theta + J\,\ddot\alpha
        - \tfrac12 J \sin 2\alpha\,\dot\theta^2 + m g a \sin\alpha &= 0

    with the arm's moment of inertia :math:`J_1` about its axis, the pendulum's :math:`J = I + m
    a^2` about its hinge, and viscous friction at both joints. A payload :math:`m_p` at a distance
    :math:`l` along the pendulum adds to its mass, to :math:`m a` by :math:`m_p l` and to :math:`J`
    by :math:`m_p l^2`.

    If the axis of the arm is not vertical, gravity points along :math:`(\sin\gamma_x,
    \cos\gamma_x \sin\gamma_y, -\cos\gamma_x \cos\gamma_y)` in the frame of the base, in which
    the arm points along x at zero. The arm itself is assumed balanced about its axis.

    Source: Cazzolato and Prime, *On the dynamics of the Furuta pendulum*, Journal of Control
    Science and Engineering, 2011, for a slender pendulum.

    :param tip: option; distance of the payload from the hinge of the pendulum [m]
    """

    name = "Furuta"
    options = {"tip": 0.13}
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
        "tilt_x": TILT,
        "tilt_y": TILT,
        "tip_payload": Parameter(null=0.0, scale=0.003, unit="kg", lower=0.0),
    }
    native_effects = {
        ("viscous_friction", 0): {"b": "arm_damping"},
        ("viscous_friction", 1): {"b": "pendulum_damping"},
    }

    def actuate(self, state: State, action: Action, params: Params) -> Force:
        return jnp.stack([action[0], jnp.zeros_like(action[0])])

    def mass_matrix(self, q: Position, params: Params) -> MassMatrix:
        mass, moment, hinge = self._pendulum(params)
        arm = params["arm_length"]
        across = moment * arm * jnp.cos(q[1])
        turning = params["arm_inertia"] + mass * arm**2 + hinge * jnp.sin(q[1]) ** 2
        return jnp.stack([turning, across, across, hinge + 0.0 * across]).reshape(2, 2)

    def bias(self, q: Position, v: Velocity, params: Params) -> Force:
        mass, moment, hinge = self._pendulum(params)
        arm = params["arm_length"]
        turn = hinge * jnp.sin(2.0 * q[1])
        sine, cosine = jnp.sin(q[1]), jnp.cos(q[1])
        along, across, down = self._gravity(q[0], params)
        first = turn * v[0] * v[1] - moment * arm * sine * v[1] ** 2 + params["arm_damping"] * v[0]
        first = first - mass * arm * across + moment * sine * along
        second = -0.5 * turn * v[0] ** 2 + params["pendulum_damping"] * v[1]
        return jnp.stack([first, second + moment * (sine * down - cosine * across)])

    def _pendulum(self, params: Params) -> tuple[Any, Any, Any]:
        """Mass [kg], first moment [kg m] and moment of inertia [kg m2] about the hinge."""
        payload, mass, a = params["tip_payload"], params["mass"], params["com"]
        hinge = params["inertia"] + mass * a**2 + payload * self.tip**2
        return mass + payload, mass * a + payload * self.tip, hinge

    @staticmethod
    def _gravity(arm: Scalar, params: Params) -> tuple[Scalar, Scalar, Scalar]:
        """Gravity along the arm, across it (in the direction of rotation), and down [m/s2]."""
        g, sine, cosine = params["gravity"], jnp.sin(params["tilt_x"]), jnp.cos(params["tilt_x"])
        x, y = g * sine, g * cosine * jnp.sin(params["tilt_y"])
        down = g * cosine * jnp.cos(params["tilt_y"])
        return x * jnp.cos(arm) + y * jnp.sin(arm), y * jnp.cos(arm) - x * jnp.sin(arm), down
