"""Gymnasium wrappers for what robots need, one file per concern, and checks of tasks."""

from sb3_hds.wrappers.check_task import TaskReport, check_task
from sb3_hds.wrappers.check_truncation import TruncationReport, check_truncation
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
    "TaskReport",
    "TerminateToTruncate",
    "TimeAware",
    "TruncateToTerminate",
    "TruncationReport",
    "check_task",
    "check_truncation",
]
