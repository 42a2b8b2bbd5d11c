"""Gymnasium wrappers for what robots need, one file per concern."""

from sb3_hds.wrappers.barrier import JointLimitBarrier
from sb3_hds.wrappers.check_task import TaskReport, check_task
from sb3_hds.wrappers.check_truncation import TruncationReport, check_truncation
from sb3_hds.wrappers.continuity import ContinuityCost
from sb3_hds.wrappers.cpg_prior import CPGPrior
from sb3_hds.wrappers.delay import ActionDelay
from sb3_hds.wrappers.ends import InfiniteHorizon, TerminateToTruncate, TruncateToTerminate
from sb3_hds.wrappers.gymnasium_vec_env import GymnasiumVecEnv
from sb3_hds.wrappers.history import HistoryObservation
from sb3_hds.wrappers.low_pass import LowPassAction
from sb3_hds.wrappers.manual_reset import ManualReset
from sb3_hds.wrappers.perturb import Perturb
from sb3_hds.wrappers.rate_limit import ActionRateLimit
from sb3_hds.wrappers.real_time import RealTime, Timing
from sb3_hds.wrappers.record import Record
from sb3_hds.wrappers.scale import ActionScale
from sb3_hds.wrappers.shared_control import Phase, SharedControlTemplate
from sb3_hds.wrappers.shield import ActionShield
from sb3_hds.wrappers.show_joints import ShowJoints
from sb3_hds.wrappers.time_aware import TimeAware

__all__ = [
    "ActionDelay",
    "ActionRateLimit",
    "ActionScale",
    "ActionShield",
    "CPGPrior",
    "ContinuityCost",
    "GymnasiumVecEnv",
    "HistoryObservation",
    "InfiniteHorizon",
    "JointLimitBarrier",
    "LowPassAction",
    "ManualReset",
    "Perturb",
    "Phase",
    "RealTime",
    "Record",
    "SharedControlTemplate",
    "ShowJoints",
    "TaskReport",
    "TerminateToTruncate",
    "TimeAware",
    "Timing",
    "TruncateToTerminate",
    "TruncationReport",
    "check_task",
    "check_truncation",
]
