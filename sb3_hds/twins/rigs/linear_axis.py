"""A mass on a rail, pushed by a motor."""

import math

import jax.numpy as jnp

from sb3_hds.core import Actuator, Joint, Parameter, State
from sb3_hds.core.types import Action, Force, MassMatrix, Params, Position, Velocity
from sb3_hds.twins.rigs.rig import Rig


class LinearAxis(Rig):
    r"""
    A carriage with a ball screw or a linear motor.

    .. math:: m\,\dot v = u - b\,v

    The command is the force of the drive, without limits: they depend on the amplifier. Attach dry
    friction, an offset or a lag as effects.
    """

    name = "LinearAxis"
    joints = (Joint("axis", "m"),)
    actuators = (Actuator("force", "N", -math.inf, math.inf),)
    parameters = {
        "mass": Parameter(null=1.0, scale=0.1, unit="kg", lower=1e-6),
        "damping": Parameter(null=0.0, scale=0.1, unit="N s/m", lower=0.0),
    }
    native_effects = {("viscous_friction", 0): {"b": "damping"}}

    def actuate(self, state: State, action: Action, params: Params) -> Force:
        return action

    def mass_matrix(self, q: Position, params: Params) -> MassMatrix:
        return (params["mass"] + 0.0 * q).reshape(1, 1)

    def bias(self, q: Position, v: Velocity, params: Params) -> Force:
        return jnp.asarray(params["damping"], v.dtype) * v
