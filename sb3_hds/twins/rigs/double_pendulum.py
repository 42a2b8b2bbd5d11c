"""Two links in a row, one motor or two."""

import math
from typing import Any

import jax.numpy as jnp

from sb3_hds.core import Actuator, Joint, Parameter, State
from sb3_hds.core.types import Action, Force, MassMatrix, Params, Position, Velocity
from sb3_hds.twins.rigs.rig import TILT, Rig

_SHOULDER, _ELBOW = (Actuator(name, "N m", -math.inf, math.inf) for name in ("motor1", "motor2"))
_DRIVEN = {"both": (_SHOULDER, _ELBOW), "first": (_SHOULDER,), "second": (_ELBOW,)}


class DoublePendulum(Rig):
    r"""
    A double pendulum, driven at its first joint (pendubot), its second (acrobot), or both. The
    links hang at zero, and the second angle is relative to the first link.

    .. math::
        M = \begin{pmatrix}
            I_1 + I_2 + m_2 l_1^2 + 2 k \cos q_2 + (n^2 + 1) I_r & I_2 + k \cos q_2 - n I_r \\
            I_2 + k \cos q_2 - n I_r & I_2 + n^2 I_r
        \end{pmatrix}, \qquad k = m_2 l_1 r_2

    with moments of inertia :math:`I_i` about the joints, distances :math:`r_i` from joints to
    centres of mass, and rotors :math:`I_r` behind gears of ratio :math:`n`. Joints have viscous
    friction; dry friction is an effect. A payload :math:`m_p` at a distance :math:`l` along the
    second link adds to its mass, to :math:`m_2 r_2` by :math:`m_p l` and to :math:`I_2` by
    :math:`m_p l^2`; gravity may be tilted in the plane of the links.

    Source: Wiebe et al., *Open source dual-purpose acrobot and pendubot platform*, IEEE Robotics
    and Automation Magazine, 2023, equations of motion.

    :param driven: option; ``"both"``, ``"first"`` or ``"second"``
    :param tip: option; distance of the payload from the second joint [m]
    """

    name = "DoublePendulum"
    options = {"driven": "both", "tip": 0.3}
    choices = {"driven": _DRIVEN}
    driven: str
    joints = (Joint("joint1", "rad"), Joint("joint2", "rad"))
    actuators = (_SHOULDER, _ELBOW)
    parameters = {
        "gravity": Parameter(null=9.81, scale=0.5, unit="m/s2", lower=0.0),
        "mass1": Parameter(null=0.5, scale=0.05, unit="kg", lower=1e-6),
        "mass2": Parameter(null=0.6, scale=0.06, unit="kg", lower=1e-6),
        "length1": Parameter(null=0.3, scale=0.03, unit="m", lower=1e-6),
        "com1": Parameter(null=0.3, scale=0.03, unit="m"),
        "com2": Parameter(null=0.2, scale=0.02, unit="m"),
        "inertia1": Parameter(null=0.05, scale=0.005, unit="kg m2", lower=1e-9),
        "inertia2": Parameter(null=0.025, scale=0.003, unit="kg m2", lower=1e-9),
        "rotor_inertia": Parameter(null=0.0, scale=5e-5, unit="kg m2", lower=0.0),
        "gear_ratio": Parameter(null=6.0, scale=0.5, unit="1", lower=0.0),
        "damping1": Parameter(null=0.0, scale=0.005, unit="N m s/rad", lower=0.0),
        "damping2": Parameter(null=0.0, scale=0.005, unit="N m s/rad", lower=0.0),
        "tilt": TILT,
        "tip_payload": Parameter(null=0.0, scale=0.05, unit="kg", lower=0.0),
    }
    native_effects = {
        ("viscous_friction", 0): {"b": "damping1"},
        ("viscous_friction", 1): {"b": "damping2"},
    }

    def __init__(self, **settings: object) -> None:
        super().__init__(**settings)  # type: ignore[arg-type]
        self.actuators = _DRIVEN[self.driven]

    def actuate(self, state: State, action: Action, params: Params) -> Force:
        if self.driven == "both":
            return action
        zero = jnp.zeros_like(action[0])
        return jnp.stack((action[0], zero) if self.driven == "first" else (zero, action[0]))

    def mass_matrix(self, q: Position, params: Params) -> MassMatrix:
        mass, moment = self._second_link(params)
        both = moment * params["length1"] * jnp.cos(q[1])
        rotor, ratio = params["rotor_inertia"], params["gear_ratio"]
        second = params["inertia2"] + params["tip_payload"] * self.tip**2 + 0.0 * both
        first = params["inertia1"] + second + mass * params["length1"] ** 2 + 2.0 * both
        across = second + both - ratio * rotor
        rows = (first + (ratio**2 + 1.0) * rotor, across, across, second + ratio**2 * rotor)
        return jnp.stack(rows).reshape(2, 2)

    def bias(self, q: Position, v: Velocity, params: Params) -> Force:
        mass, moment = self._second_link(params)
        bend = moment * params["length1"] * jnp.sin(q[1])
        g, angle = params["gravity"], q[0] + params["tilt"]
        inner = jnp.sin(angle)
        upper = params["mass1"] * params["com1"] + mass * params["length1"]
        outer = g * moment * jnp.sin(angle + q[1])
        first = -bend * (2.0 * v[0] + v[1]) * v[1] + g * upper * inner + outer
        second = bend * v[0] ** 2 + outer
        return jnp.stack([first + params["damping1"] * v[0], second + params["damping2"] * v[1]])

    def _second_link(self, params: Params) -> tuple[Any, Any]:
        """Mass [kg] and first moment about the second joint [kg m], payload included."""
        payload = params["tip_payload"]
        moment = params["mass2"] * params["com2"] + payload * self.tip
        return params["mass2"] + payload, moment
