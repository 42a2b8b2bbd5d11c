"""The pure JAX core: parameters, effects, twins and data."""

from sb3_hds.core.analytic import AnalyticTwin
from sb3_hds.core.effect import (
    NO_EFFECTS,
    ActionEffect,
    Effect,
    EffectChain,
    ForceEffect,
    JointEffect,
    JointMoment,
    Moment,
    SensorEffect,
)
from sb3_hds.core.extended import ExtendedTwin
from sb3_hds.core.integrators import explicit_euler, rk4, semi_implicit_euler
from sb3_hds.core.linear import solve_spd
from sb3_hds.core.parameter import Parameter
from sb3_hds.core.signals import Actuator, Channel, Joint
from sb3_hds.core.twin import State, Twin
from sb3_hds.core.types import (
    Action,
    Flag,
    Force,
    MassMatrix,
    Memory,
    Obs,
    Params,
    Position,
    Scalar,
    Tangent,
    Velocity,
)

__all__ = [
    "NO_EFFECTS",
    "Action",
    "ActionEffect",
    "Actuator",
    "AnalyticTwin",
    "Channel",
    "Effect",
    "EffectChain",
    "ExtendedTwin",
    "Flag",
    "Force",
    "ForceEffect",
    "Joint",
    "JointEffect",
    "JointMoment",
    "MassMatrix",
    "Memory",
    "Moment",
    "Obs",
    "Parameter",
    "Params",
    "Position",
    "Scalar",
    "SensorEffect",
    "State",
    "Tangent",
    "Twin",
    "Velocity",
    "explicit_euler",
    "rk4",
    "semi_implicit_euler",
    "solve_spd",
]
