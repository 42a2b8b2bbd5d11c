"""The catalogue of effects: a class listed in ``ALL`` is tested, offered and documented."""

from sb3_hds.core import Effect
from sb3_hds.effects.actuator import ActionDelay, MotorLag, TorqueGain
from sb3_hds.effects.joint import CoulombFriction, QuadraticDrag, ViscousFriction
from sb3_hds.effects.neural import NeuralForce, force_of

ALL: tuple[type[Effect], ...] = (
    ViscousFriction,
    CoulombFriction,
    QuadraticDrag,
    TorqueGain,
    MotorLag,
    ActionDelay,
)

#: Everything that a saved twin may have attached: the catalogue, and the learned residual, which is
#: never the name of a cause.
KNOWN: tuple[type[Effect], ...] = (*ALL, NeuralForce)

__all__ = [
    "ALL",
    "KNOWN",
    "ActionDelay",
    "CoulombFriction",
    "MotorLag",
    "NeuralForce",
    "QuadraticDrag",
    "TorqueGain",
    "ViscousFriction",
    "force_of",
]
