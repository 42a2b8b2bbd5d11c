"""A pendulum that swings freely."""

import math

import jax.numpy as jnp

from sb3_hds.core import Actuator, Joint, Parameter, State
from sb3_hds.core.types import Action, Force, MassMatrix, Params, Position, Velocity
from sb3_hds.twins.rigs.rig import TILT, Rig

_MOTOR = Actuator("motor", "N m", -math.inf, math.inf)


class FreePendulum(Rig):
    r"""
    A compound pendulum, by default without a motor.

    .. math::
        (I + m a^2 + m_p l^2)\,\dot\omega
        = -(m a + m_p l)\,g \sin(\theta + \theta_0 + \gamma) - b\,\omega + u

    with the distance :math:`a` from the pivot to the centre of mass, the moment of inertia
    :math:`I` about that, and a payload :math:`m_p` at a distance :math:`l` from the pivot.
    :math:`\theta_0` is 0 if the angle is zero when hanging, and :math:`\pi` if it is zero upright.
    Gravity is tilted by :math:`\gamma`, as on a table that is not level. Without a motor, the
    motion determines only ratios of the parameters.

    :param zero: option; ``"down"`` or ``"up"``: the position at which the angle is zero
    :param driven: option; whether a motor at the pivot takes a torque
    :param tip: option; distance of the payload from the pivot [m]
    """

    name = "FreePendulum"
    options = {"zero": "down", "driven": False, "tip": 0.3}
    choices = {"zero": ("down", "up"), "driven": (True, False)}
    zero: str
    driven: bool
    joints = (Joint("hinge", "rad"),)
    actuators = ()
    parameters = {
        "gravity": Parameter(null=9.81, scale=0.5, unit="m/s2", lower=0.0),
        "mass": Parameter(null=0.15, scale=0.02, unit="kg", lower=1e-6),
        "com": Parameter(null=0.15, scale=0.02, unit="m", lower=1e-6),
        "inertia": Parameter(null=1e-4, scale=1e-4, unit="kg m2", lower=0.0),
        "damping": Parameter(null=0.0, scale=1e-4, unit="N m s/rad", lower=0.0),
        "tilt": TILT,
        "tip_payload": Parameter(null=0.0, scale=0.01, unit="kg", lower=0.0),
    }
    native_effects = {("viscous_friction", 0): {"b": "damping"}}

    def __init__(self, **settings: object) -> None:
        super().__init__(**settings)  # type: ignore[arg-type]
        self.actuators = (_MOTOR,) if self.driven else ()

    def actuate(self, state: State, action: Action, params: Params) -> Force:
        return action if self.driven else jnp.zeros_like(state.q)

    def mass_matrix(self, q: Position, params: Params) -> MassMatrix:
        payload = params["tip_payload"] * self.tip**2
        inertia = params["inertia"] + params["mass"] * params["com"] ** 2 + payload
        return (inertia + 0.0 * q).reshape(1, 1)

    def bias(self, q: Position, v: Velocity, params: Params) -> Force:
        side = 1.0 if self.zero == "down" else -1.0
        lever = params["mass"] * params["com"] + params["tip_payload"] * self.tip
        pull = side * params["gravity"] * lever * jnp.sin(q + params["tilt"])
        return pull + jnp.asarray(params["damping"], v.dtype) * v
