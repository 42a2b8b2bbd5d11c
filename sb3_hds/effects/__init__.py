"""The catalogue of effects: a class listed in ``ALL`` is tested, offered and documented."""

from collections.abc import Iterable

from sb3_hds.core import Effect
from sb3_hds.effects.actuator import (
    ActionDelay,
    DeadZone,
    DirectionalGain,
    MotorLag,
    Saturation,
    TorqueGain,
)
from sb3_hds.effects.flexible import ClearanceSpring, Hysteresis
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
from sb3_hds.effects.neural import NeuralForce, force_of
from sb3_hds.effects.position import Cogging, ConstantForce, CubicStiffness, Stiffness
from sb3_hds.effects.sensor import SensorBias, SensorDelay, SensorScale, SignFlip, reversed_joint
from sb3_hds.effects.transmission import Backlash, JointElasticity
from sb3_hds.errors import EffectError, did_you_mean

# In the order of the signal path: a bus, the drive, its motor; a sensor, its bus.
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

#: flexible forces, which stand for effects outside the catalogue: a diagnosis never names them as a
#: cause, but a cause at a joint must predict better than they do
NAMELESS: tuple[type[Effect], ...] = (ClearanceSpring, Hysteresis)

#: everything that a saved twin may have attached: also flexible forces and learned residuals
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


def effect_named(name: str, kinds: Iterable[type[Effect]]) -> type[Effect]:
    """
    :param name: ``"coulomb_friction"``, ``"CoulombFriction"`` or ``"coulomb friction"``
    :param kinds: the classes to search
    :raises EffectError: for an unknown name; the message suggests the nearest one
    """
    by_name = {kind.name: kind for kind in kinds}
    by_letters = {_letters(known): kind for known, kind in by_name.items()}
    if _letters(name) in by_letters:
        return by_letters[_letters(name)]
    meant = did_you_mean(name.lower(), by_name)
    raise EffectError(f"There is no effect '{name}'.{meant} There are: {', '.join(by_name)}.")


def _letters(name: str) -> str:
    return "".join(letter for letter in name.rpartition(".")[2].lower() if letter.isalnum())
