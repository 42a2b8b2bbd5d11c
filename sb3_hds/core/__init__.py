"""
The pure JAX core: parameters, effects, twins and data.

Names are imported on first use, so that a control loop on a robot needs neither JAX nor PyTorch.
"""

from sb3_hds.lazy import lazy_imports

with lazy_imports(__name__):
    from sb3_hds.core.analytic import AnalyticTwin
    from sb3_hds.core.declarations import Actuator, Channel, Joint, Parameter
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
    from sb3_hds.core.rollout import Rollout, rollout, rollout_policy
    from sb3_hds.core.trajectories import Trajectories
    from sb3_hds.core.transformed import (
        TRANSFORMS,
        TransformedTwin,
        seen_through,
        transform_from_spec,
        transform_to_spec,
    )
    from sb3_hds.core.transforms.barrier import Barrier
    from sb3_hds.core.transforms.base import (
        ActionTransform,
        ObservationTransform,
        Signals,
        StatefulTransform,
    )
    from sb3_hds.core.transforms.cpg import Rhythm
    from sb3_hds.core.transforms.filters import Continuity, Delay, LowPass, RateLimit, Scale
    from sb3_hds.core.transforms.history import History
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
