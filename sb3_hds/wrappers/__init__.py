"""
Gymnasium wrappers for learning on robots, in rooms by what they act on.

Names are imported on first use: a loop on a robot needs few of them, and neither JAX nor PyTorch.
"""

from typing import TYPE_CHECKING

from sb3_hds.lazy import lazily

if TYPE_CHECKING:
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

lazily(
    __name__,
    {
        "ActionDelay": "sb3_hds.wrappers.actions.filters",
        "ActionRateLimit": "sb3_hds.wrappers.actions.filters",
        "ActionScale": "sb3_hds.wrappers.actions.scale",
        "ActionShield": "sb3_hds.wrappers.safety.shield",
        "CPGPrior": "sb3_hds.wrappers.actions.cpg_prior",
        "ContinuityCost": "sb3_hds.wrappers.actions.continuity",
        "GymnasiumVecEnv": "sb3_hds.wrappers.vec_env",
        "HistoryObservation": "sb3_hds.wrappers.observations.history",
        "InfiniteHorizon": "sb3_hds.wrappers.episodes.ends",
        "JointLimitBarrier": "sb3_hds.wrappers.safety.barrier",
        "LowPassAction": "sb3_hds.wrappers.actions.filters",
        "ManualReset": "sb3_hds.wrappers.episodes.manual_reset",
        "Perturb": "sb3_hds.wrappers.hardware.perturb",
        "Phase": "sb3_hds.wrappers.safety.shared_control",
        "RealTime": "sb3_hds.wrappers.hardware.real_time",
        "Record": "sb3_hds.wrappers.hardware.record",
        "SharedControlTemplate": "sb3_hds.wrappers.safety.shared_control",
        "ShowJoints": "sb3_hds.wrappers.observations.show_joints",
        "TaskReport": "sb3_hds.wrappers.checks.task",
        "TerminateToTruncate": "sb3_hds.wrappers.episodes.ends",
        "TimeAware": "sb3_hds.wrappers.observations.time_aware",
        "Timing": "sb3_hds.wrappers.hardware.real_time",
        "TruncateToTerminate": "sb3_hds.wrappers.episodes.ends",
        "TruncationReport": "sb3_hds.wrappers.checks.truncation",
        "check_task": "sb3_hds.wrappers.checks.task",
        "check_truncation": "sb3_hds.wrappers.checks.truncation",
    },
)
