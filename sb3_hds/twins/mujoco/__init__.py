"""Twins of robots from their model files."""

from sb3_hds.twins.mujoco.from_mujoco import from_mujoco
from sb3_hds.twins.mujoco.matching import Matching, arranged, match
from sb3_hds.twins.mujoco.mechanism import Mechanism
from sb3_hds.twins.mujoco.twin import MechanismTwin
from sb3_hds.twins.mujoco.writing import Written, write_model

__all__ = [
    "Matching",
    "Mechanism",
    "MechanismTwin",
    "Written",
    "arranged",
    "from_mujoco",
    "match",
    "write_model",
]
