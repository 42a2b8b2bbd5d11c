"""Gymnasium wrappers for what robots need, one file per concern."""

from sb3_hds.wrappers.manual_reset import ManualReset

__all__ = ["ManualReset"]
