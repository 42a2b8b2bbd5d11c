"""Gymnasium wrappers for what robots need, one file per concern."""

from sb3_hds.wrappers.ends import InfiniteHorizon, TerminateToTruncate, TruncateToTerminate
from sb3_hds.wrappers.gymnasium_vec_env import GymnasiumVecEnv
from sb3_hds.wrappers.manual_reset import ManualReset
from sb3_hds.wrappers.record import Record
from sb3_hds.wrappers.time_aware import TimeAware

__all__ = [
    "GymnasiumVecEnv",
    "InfiniteHorizon",
    "ManualReset",
    "Record",
    "TerminateToTruncate",
    "TimeAware",
    "TruncateToTerminate",
]
