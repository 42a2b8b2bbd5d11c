"""
The pure JAX core: parameters, effects, twins and data.

Names are imported on first use: a loop on a robot needs few of them, and neither JAX nor PyTorch.
"""

from typing import TYPE_CHECKING

from sb3_hds.lazy import lazily

if TYPE_CHECKING:
    from sb3_hds.core.analytic import AnalyticTwin
    from sb3_hds.core.effect import (
        ActionEffect,
        Effect,
        ForceEffect,
        JointEffect,
        JointMoment,
        Moment,
        Ranges,
        SensorEffect,
    )
    from sb3_hds.core.effect_chain import NO_EFFECTS, EffectChain
    from sb3_hds.core.extended import ExtendedTwin
    from sb3_hds.core.numerics.integrators import explicit_euler, rk4, semi_implicit_euler
    from sb3_hds.core.numerics.linear import solve_spd
    from sb3_hds.core.parameter import Parameter
    from sb3_hds.core.rollout import Rollout, rollout, rollout_policy
    from sb3_hds.core.signals import Actuator, Channel, Joint
    from sb3_hds.core.trajectories import Trajectories
    from sb3_hds.core.transformed import TransformedTwin, seen_through
    from sb3_hds.core.transforms.barrier import Barrier
    from sb3_hds.core.transforms.base import (
        ActionTransform,
        ObservationTransform,
        Signals,
        StatefulTransform,
    )
    from sb3_hds.core.transforms.continuity import Continuity
    from sb3_hds.core.transforms.cpg import Rhythm
    from sb3_hds.core.transforms.filters import Delay, LowPass, RateLimit, Scale
    from sb3_hds.core.transforms.history import History
    from sb3_hds.core.transforms.registry import TRANSFORMS, transform_from_spec, transform_to_spec
    from sb3_hds.core.transforms.rescale import RescaleAction, RescaleObservation
    from sb3_hds.core.twin import State, Twin
    from sb3_hds.core.types import (
        Action,
        Coordinates,
        Flag,
        Force,
        MassMatrix,
        Memory,
        Obs,
        Params,
        Position,
        Scalar,
        Tangent,
        Velocity,
    )

__all__ = [
    "NO_EFFECTS",
    "TRANSFORMS",
    "Action",
    "ActionEffect",
    "ActionTransform",
    "Actuator",
    "AnalyticTwin",
    "Barrier",
    "Channel",
    "Continuity",
    "Coordinates",
    "Delay",
    "Effect",
    "EffectChain",
    "ExtendedTwin",
    "Flag",
    "Force",
    "ForceEffect",
    "History",
    "Joint",
    "JointEffect",
    "JointMoment",
    "LowPass",
    "MassMatrix",
    "Memory",
    "Moment",
    "Obs",
    "ObservationTransform",
    "Parameter",
    "Params",
    "Position",
    "Ranges",
    "RateLimit",
    "RescaleAction",
    "RescaleObservation",
    "Rhythm",
    "Rollout",
    "Scalar",
    "Scale",
    "SensorEffect",
    "Signals",
    "State",
    "StatefulTransform",
    "Tangent",
    "Trajectories",
    "TransformedTwin",
    "Twin",
    "Velocity",
    "explicit_euler",
    "rk4",
    "rollout",
    "rollout_policy",
    "seen_through",
    "semi_implicit_euler",
    "solve_spd",
    "transform_from_spec",
    "transform_to_spec",
]

lazily(
    __name__,
    {
        "Action": "sb3_hds.core.types",
        "ActionEffect": "sb3_hds.core.effect",
        "ActionTransform": "sb3_hds.core.transforms.base",
        "Actuator": "sb3_hds.core.signals",
        "AnalyticTwin": "sb3_hds.core.analytic",
        "Barrier": "sb3_hds.core.transforms.barrier",
        "Channel": "sb3_hds.core.signals",
        "Continuity": "sb3_hds.core.transforms.continuity",
        "Coordinates": "sb3_hds.core.types",
        "Delay": "sb3_hds.core.transforms.filters",
        "Effect": "sb3_hds.core.effect",
        "EffectChain": "sb3_hds.core.effect_chain",
        "ExtendedTwin": "sb3_hds.core.extended",
        "Flag": "sb3_hds.core.types",
        "Force": "sb3_hds.core.types",
        "ForceEffect": "sb3_hds.core.effect",
        "History": "sb3_hds.core.transforms.history",
        "Joint": "sb3_hds.core.signals",
        "JointEffect": "sb3_hds.core.effect",
        "JointMoment": "sb3_hds.core.effect",
        "LowPass": "sb3_hds.core.transforms.filters",
        "MassMatrix": "sb3_hds.core.types",
        "Memory": "sb3_hds.core.types",
        "Moment": "sb3_hds.core.effect",
        "NO_EFFECTS": "sb3_hds.core.effect_chain",
        "Obs": "sb3_hds.core.types",
        "ObservationTransform": "sb3_hds.core.transforms.base",
        "Parameter": "sb3_hds.core.parameter",
        "Params": "sb3_hds.core.types",
        "Position": "sb3_hds.core.types",
        "Ranges": "sb3_hds.core.effect",
        "RateLimit": "sb3_hds.core.transforms.filters",
        "RescaleAction": "sb3_hds.core.transforms.rescale",
        "RescaleObservation": "sb3_hds.core.transforms.rescale",
        "Rhythm": "sb3_hds.core.transforms.cpg",
        "Rollout": "sb3_hds.core.rollout",
        "Scalar": "sb3_hds.core.types",
        "Scale": "sb3_hds.core.transforms.filters",
        "SensorEffect": "sb3_hds.core.effect",
        "Signals": "sb3_hds.core.transforms.base",
        "State": "sb3_hds.core.twin",
        "StatefulTransform": "sb3_hds.core.transforms.base",
        "TRANSFORMS": "sb3_hds.core.transforms.registry",
        "Tangent": "sb3_hds.core.types",
        "Trajectories": "sb3_hds.core.trajectories",
        "TransformedTwin": "sb3_hds.core.transformed",
        "Twin": "sb3_hds.core.twin",
        "Velocity": "sb3_hds.core.types",
        "explicit_euler": "sb3_hds.core.numerics.integrators",
        "rk4": "sb3_hds.core.numerics.integrators",
        "rollout": "sb3_hds.core.rollout",
        "rollout_policy": "sb3_hds.core.rollout",
        "seen_through": "sb3_hds.core.transformed",
        "semi_implicit_euler": "sb3_hds.core.numerics.integrators",
        "solve_spd": "sb3_hds.core.numerics.linear",
        "transform_from_spec": "sb3_hds.core.transforms.registry",
        "transform_to_spec": "sb3_hds.core.transforms.registry",
    },
)
