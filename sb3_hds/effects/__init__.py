"""The catalogue of effects: a class listed in ``ALL`` is tested, offered and documented."""

from sb3_hds.core import Effect
from sb3_hds.effects.joint import CoulombFriction, ViscousFriction

ALL: tuple[type[Effect], ...] = (ViscousFriction, CoulombFriction)

__all__ = ["ALL", "CoulombFriction", "ViscousFriction"]
