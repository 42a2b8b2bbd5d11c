"""
Gymnasium wrappers for learning on robots, in rooms by what they act on.

Names are imported on first use: a loop on a robot needs few of them, and neither JAX nor PyTorch.
"""

from sb3_hds.lazy import lazy_imports

with lazy_imports(__name__):
    from sb3_hds.wrappers.actions.continuity import ContinuityCost
    from sb3_hds.wrappers.actions.cpg_prior import CPGPrior
    from sb3_hds.wrappers.actions.filters import ActionDelay, ActionRateLimit, LowPassAction
    from sb3_hds.wrappers.actions.scale import ActionScale
    from sb3_hds.wrappers.checks.task import TaskReport, check_task
    from sb3_hds.wrappers.checks.truncation import TruncationReport, check_truncation
    from sb3_hds.wrappers.episodes.ends import (
        InfiniteHorizon,
        TerminateToTruncate,
        TruncateToTerminate,
    )
    from sb3_hds.wrappers.episodes.manual_reset import ManualReset
    from sb3_hds.wrappers.hardware.perturb import Perturb
    from sb3_hds.wrappers.hardware.real_time import RealTime, Timing
    from sb3_hds.wrappers.hardware.record import Record
    from sb3_hds.wrappers.observations.history import HistoryObservation
    from sb3_hds.wrappers.observations.show_joints import ShowJoints
    from sb3_hds.wrappers.observations.time_aware import TimeAware
    from sb3_hds.wrappers.safety.barrier import JointLimitBarrier
    from sb3_hds.wrappers.safety.shared_control import Phase, SharedControlTemplate
    from sb3_hds.wrappers.safety.shield import ActionShield
    from sb3_hds.wrappers.vec_env import GymnasiumVecEnv

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
