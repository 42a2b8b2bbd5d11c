"""A weight on an arm, held by a hobby servo."""

import math

import jax.numpy as jnp

from sb3_hds.core import Actuator, Joint, Parameter, State
from sb3_hds.core.types import Action, Force, MassMatrix, Params, Position, Velocity
from sb3_hds.twins.rigs.rig import TILT, Rig

_GOAL = Actuator("goal", "rad", -math.pi, math.pi)
_ENABLE = Actuator("enable", "1", 0.0, 1.0)
_GAIN = Actuator("gain", "1", 0.0, math.inf)
_LOGGED_GAIN = "goal, enable, gain"
_COMMANDS = {
    "goal": (_GOAL,),
    "goal, enable": (_GOAL, _ENABLE),
    _LOGGED_GAIN: (_GOAL, _ENABLE, _GAIN),
}


class ServoPendulum(Rig):
    r"""
    A position-controlled servo whose firmware multiplies the error by a gain and sets a duty cycle.

    .. math::
        d &= \mathrm{clip}\big(k_p\,e\,(u - q),\,-1,\,1\big) \\
        (m l^2 + I)\,\dot v &= \frac{k_t}{R}\,V d - \frac{k_t^2}{R}\,v - b\,v
        - m g l \sin(q + \gamma)

    The arm hangs at zero if the servo is upright; :math:`\gamma` is its tilt. The command
    :math:`u` is the goal position. With the motor off (``enable`` at 0) the winding is open:
    neither torque nor electric damping. A payload at the tip is a larger mass.

    Source: Duclusaud et al., arXiv 2410.08650, 2024, section III; a DC motor without inductance.

    :param commands: option; ``"goal"``, ``"goal, enable"`` or ``"goal, enable, gain"``; the last
        one for logs with different gains of the firmware, which replace the parameter ``kp``
    """

    name = "ServoPendulum"
    dt = 0.005
    options = {"commands": "goal"}
    choices = {"commands": _COMMANDS}
    commands: str
    joints = (Joint("servo", "rad"),)
    actuators = (_GOAL,)
    parameters = {
        "gravity": Parameter(null=9.81, scale=0.5, unit="m/s2", lower=0.0),
        "mass": Parameter(null=0.5, scale=0.05, unit="kg", lower=1e-6),
        "length": Parameter(null=0.1, scale=0.01, unit="m", lower=1e-6),
        "armature": Parameter(null=0.002, scale=0.001, unit="kg m2", lower=0.0),
        "kp": Parameter(null=400.0, scale=40.0, unit="1", lower=0.0),
        "duty_per_error": Parameter(null=2.877e-3, scale=3e-4, unit="1/rad", lower=0.0),
        "voltage": Parameter(null=7.4, scale=0.5, unit="V", lower=0.0),
        "torque_constant": Parameter(null=0.4, scale=0.05, unit="N m/A", lower=1e-6),
        "resistance": Parameter(null=3.0, scale=0.5, unit="ohm", lower=1e-6),
        "damping": Parameter(null=0.0, scale=0.02, unit="N m s/rad", lower=0.0),
        "tilt": TILT,
    }
    native_effects = {("viscous_friction", 0): {"b": "damping"}}

    def __init__(self, **settings: object) -> None:
        if settings.get("commands") == _LOGGED_GAIN:
            self.parameters = {n: p for n, p in self.parameters.items() if n != "kp"}
        super().__init__(**settings)  # type: ignore[arg-type]
        self.actuators = _COMMANDS[self.commands]

    def actuate(self, state: State, action: Action, params: Params) -> Force:
        n = len(self.actuators)
        gain = action[2] if n > 2 else params["kp"]
        on = action[1] if n > 1 else 1.0
        duty = jnp.clip(gain * params["duty_per_error"] * (action[0] - state.q), -1.0, 1.0)
        voltage = params["voltage"] * duty - params["torque_constant"] * state.v
        return on * params["torque_constant"] * (voltage / params["resistance"])

    def mass_matrix(self, q: Position, params: Params) -> MassMatrix:
        inertia = params["mass"] * params["length"] ** 2 + params["armature"]
        return (inertia + 0.0 * q).reshape(1, 1)

    def bias(self, q: Position, v: Velocity, params: Params) -> Force:
        torque = params["mass"] * params["gravity"] * params["length"]
        pull = torque * jnp.sin(q + params["tilt"])
        return pull + jnp.asarray(params["damping"], v.dtype) * v
