"""Twins of robots from their model files."""

from sb3_hds.twins.mujoco.engine.contact_twin import ContactTwin
from sb3_hds.twins.mujoco.files.writing import Written, write_model, write_models
from sb3_hds.twins.mujoco.from_mujoco import from_mujoco
from sb3_hds.twins.mujoco.mechanism import Mechanism
from sb3_hds.twins.mujoco.names.matching import Matching, arranged, match
from sb3_hds.twins.mujoco.twin import MechanismTwin

__all__ = [
    "ContactTwin",
    "Matching",
    "Mechanism",
    "MechanismTwin",
    "Written",
    "arranged",
    "from_mujoco",
    "match",
    "write_model",
    "write_models",
]
