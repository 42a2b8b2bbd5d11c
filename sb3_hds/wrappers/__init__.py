"""Gymnasium wrappers for what robots need, one file per concern."""

from sb3_hds.wrappers.manual_reset import ManualReset
from sb3_hds.wrappers.record import Record

__all__ = ["ManualReset", "Record"]
