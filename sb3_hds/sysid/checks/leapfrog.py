"""Logs of simulators that step velocities and positions half an interval apart."""

import copy
import dataclasses

import numpy as np

from sb3_hds.core import AnalyticTwin, ExtendedTwin, Trajectories, Twin, semi_implicit_euler
from sb3_hds.core.numerics.integrators import Integrator
from sb3_hds.core.twin import layers_of, plant_of
from sb3_hds.sysid.checks.conventions import what_friction_leaves
from sb3_hds.sysid.equation.motion import joint_motion, kinematics, lag_of, motion
from sb3_hds.sysid.estimation.candidates import encoders

# Velocities that are true half an interval before their positions, give or take so much.
_HALF, _ABOUT = -0.5, 0.1


def in_step_with_the_log(
    twin: Twin, data: Trajectories
) -> tuple[Twin, Trajectories, tuple[str, ...]]:
    """
    Where velocities are true half an interval before their positions: the twin with the rule of
    integration that logs them so, or the data with velocities moved, whichever friction and an
    offset at each joint explain better.

    Semi-implicit Euler's velocity is that of the middle of the interval before. A twin that
    integrates accurately finds half an interval of delay and a few per cent of inertia there, which
    are the simulator's.

    :param data: sampled at the twin's ``dt``
    :return: the twin, the data, and what was changed, in words
    """
    plant = plant_of(twin)
    if lag_of(twin) != 0.0 or not isinstance(plant, AnalyticTwin) or not _bare(twin):
        return twin, data, ()
    channels = [e.velocity for e in encoders(twin).values() if e.velocity is not None]
    if not channels:
        return twin, data, ()
    before = motion(twin, data)
    if not before.moves.any() or not before.measured.any():
        return twin, data, ()
    lag = kinematics(joint_motion(twin, data), data.dt, before.period).lag[before.measured]
    if np.any(np.abs(lag - _HALF) > _ABOUT):
        return twin, data, ()
    half = f"{0.5e3 * data.dt:.2g} ms (half a sample) before the positions that they belong to"
    euler = stepping_by(twin, semi_implicit_euler).at_interval(twin.dt, 1)
    moved = _moved(data, channels)
    if _left(euler, data) < _left(twin, moved):
        words = (
            f"Velocities come {half}, as a simulator logs them that steps by semi-implicit Euler: "
            "the twin steps in the same way here."
        )
        return euler, data, (words,)
    return twin, moved, (f"Velocities come {half}; they were moved.",)


def stepping_by(twin: Twin, integrator: Integrator) -> Twin:
    """:return: a twin, extended or not, with another rule of integration"""
    if isinstance(twin, ExtendedTwin):
        base = stepping_by(twin.without(*(a.key for a in twin.attached)), integrator)
        return base.extend(*twin.effects_with_values())
    changed = copy.copy(twin)
    changed.integrator = integrator  # type: ignore[attr-defined]  # of the class, else
    return changed


def _bare(twin: Twin) -> bool:
    """Whether no wrapper is around the plant and its effects."""
    return all(isinstance(layer, ExtendedTwin | AnalyticTwin) for layer in layers_of(twin))


def _left(twin: Twin, data: Trajectories) -> float:
    weight, left = what_friction_leaves(twin, motion(twin, data))
    return float(weight @ np.log(left))


def _moved(data: Trajectories, channels: list[int]) -> Trajectories:
    obs, actions = [], []
    for i in range(len(data)):
        o, a = (np.array(x, float) for x in data.episode(i))
        o[:-1, channels] = 0.5 * (o[1:, channels] + o[:-1, channels])
        obs.append(o[:-1])
        actions.append(a[:-1])
    made = Trajectories.from_arrays(obs, actions, dt=data.dt, conditions=data.conditions)
    return dataclasses.replace(made, origin=data.origin, report=data.report)
