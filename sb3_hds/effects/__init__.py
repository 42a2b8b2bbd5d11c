"""The catalogue of effects: a class listed in ``ALL`` is tested, offered and documented."""

from sb3_hds.core import Effect
from sb3_hds.effects.actuator import (
    ActionDelay,
    DeadZone,
    DirectionalGain,
    MotorLag,
    Saturation,
    TorqueGain,
)
from sb3_hds.effects.joint import (
    ConcaveFriction,
    CoulombFriction,
    DirectionalCoulombFriction,
    DirectionalViscousFriction,
    DryFriction,
    LoadDependentFriction,
    QuadraticDrag,
    StribeckFriction,
    ViscousFriction,
)
from sb3_hds.effects.nameless import ClearanceSpring, Hysteresis
from sb3_hds.effects.names import effect_named
from sb3_hds.effects.neural import NeuralForce, force_of
from sb3_hds.effects.position import Cogging, ConstantForce, CubicStiffness, Stiffness
from sb3_hds.effects.sensor import SensorBias, SensorDelay, SensorScale, SignFlip, reversed_joint
from sb3_hds.effects.transmission import Backlash, JointElasticity

# In the order in which a signal meets them: a bus, then the drive, then its motor; a sensor, then
# its bus.
ALL: tuple[type[Effect], ...] = (
    ViscousFriction,
    DirectionalViscousFriction,
    ConcaveFriction,
    CoulombFriction,
    DirectionalCoulombFriction,
    StribeckFriction,
    LoadDependentFriction,
    QuadraticDrag,
    Stiffness,
    CubicStiffness,
    Cogging,
    ConstantForce,
    JointElasticity,
    Backlash,
    ActionDelay,
    DeadZone,
    TorqueGain,
    DirectionalGain,
    Saturation,
    MotorLag,
    SignFlip,
    SensorScale,
    SensorBias,
    SensorDelay,
)

#: What exists and no catalogue of names can be complete of: never the name of a cause, but what
#: causes at joints are measured against.
NAMELESS: tuple[type[Effect], ...] = (ClearanceSpring, Hysteresis)

#: Everything that a saved twin may have attached: the catalogue, and what is never the name of a
#: cause, a learned residual among it.
KNOWN: tuple[type[Effect], ...] = (*ALL, *NAMELESS, NeuralForce)

__all__ = [
    "ALL",
    "KNOWN",
    "NAMELESS",
    "ActionDelay",
    "Backlash",
    "ClearanceSpring",
    "Cogging",
    "ConcaveFriction",
    "ConstantForce",
    "CoulombFriction",
    "CubicStiffness",
    "DeadZone",
    "DirectionalCoulombFriction",
    "DirectionalGain",
    "DirectionalViscousFriction",
    "DryFriction",
    "Hysteresis",
    "JointElasticity",
    "LoadDependentFriction",
    "MotorLag",
    "NeuralForce",
    "QuadraticDrag",
    "Saturation",
    "SensorBias",
    "SensorDelay",
    "SensorScale",
    "SignFlip",
    "Stiffness",
    "StribeckFriction",
    "TorqueGain",
    "ViscousFriction",
    "effect_named",
    "force_of",
    "reversed_joint",
]
