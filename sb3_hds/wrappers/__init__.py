"""
Gymnasium wrappers for learning on robots.

Names are imported on first use: a control loop on a robot needs few of them, and neither JAX nor
PyTorch.
"""

from sb3_hds.lazy import lazy_imports

with lazy_imports(__name__):
    from sb3_hds.wrappers.actions.cpg_prior import CPGPrior
    from sb3_hds.wrappers.actions.scale import ActionScale
    from sb3_hds.wrappers.actions.transforms import (
        ActionDelay,
        ActionRateLimit,
        ContinuityCost,
        HistoryObservation,
        LowPassAction,
    )
    from sb3_hds.wrappers.checks.task import TaskReport, check_task
    from sb3_hds.wrappers.checks.truncation import TruncationReport, check_truncation
    from sb3_hds.wrappers.episodes import (
        InfiniteHorizon,
        ManualReset,
        TerminateToTruncate,
        TruncateToTerminate,
    )
    from sb3_hds.wrappers.observations import ShowJoints, TimeAware
    from sb3_hds.wrappers.perturb import Perturb
    from sb3_hds.wrappers.real_time import RealTime, Timing
    from sb3_hds.wrappers.record import Record
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
