"""Gymnasium wrappers for what robots need, one file per concern."""

from sb3_hds.wrappers.cpg_prior import CPGPrior
from sb3_hds.wrappers.manual_reset import ManualReset
from sb3_hds.wrappers.perturb import Perturb
from sb3_hds.wrappers.record import Record
from sb3_hds.wrappers.show_joints import ShowJoints

__all__ = ["CPGPrior", "ManualReset", "Perturb", "Record", "ShowJoints"]
