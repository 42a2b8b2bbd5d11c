"""When the columns of a log were sampled: delayed velocities, and those of leapfrog integrators."""

import copy
import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from sb3_hds.core import (
    AnalyticTwin,
    ExtendedTwin,
    Trajectories,
    Twin,
    rollout,
    semi_implicit_euler,
)
from sb3_hds.core.numerics.integrators import Integrator
from sb3_hds.core.twin import layers_of
from sb3_hds.data.audit.results import shifted
from sb3_hds.data.audit.velocity import VelocityPair, best_pairs, velocity_pairs
from sb3_hds.sysid.checks.conventions import residual_beside_friction
from sb3_hds.sysid.motion.joints import encoders, joint_motion, kinematics, velocity_time_of
from sb3_hds.sysid.motion.motion import smoothed_motion

# Longest shift that is attributed to computation [samples], [s], and the least that counts.
_SAMPLES, _SECONDS, _VISIBLE = 1.0, 2e-3, 0.1
_SIGMAS = 3.0
# Steps of each recording, and recordings, that are simulated to time the twin's own velocities.
_STEPS, _RECORDINGS = 1000, 4
# Velocities that are true half an interval before their positions, and the tolerance.
_HALF, _ABOUT = -0.5, 0.1


def align_velocities(twin: Twin, data: Trajectories) -> tuple[Trajectories, tuple[str, ...]]:
    """
    Shift measured velocities to the instants at which the twin reports its own.

    A rig that differentiates and filters its encoders reports velocities late by a fraction of a
    sample. At a high rate this is visible, and too small to be a finding. A backward difference is
    half a sample late at any rate, which is no delay of a sensor.

    :return: the data, and what was changed, in words
    """
    names = [channel.name for channel in twin.channels]
    measured = [pair for pair in best_pairs(velocity_pairs(data, names)) if _short(pair, data.dt)]
    if not measured:
        return data, ()
    simulated = best_pairs(velocity_pairs(_replayed(twin, data), names))
    own = {pair.velocity: pair.samples for pair in simulated}
    late = {
        pair: (0.5 if pair.difference.is_backward else pair.samples) - own[pair.velocity]
        for pair in measured
        if pair.velocity in own
    }
    late = {pair: samples for pair, samples in late.items() if abs(samples) > _VISIBLE}
    if not late:
        return data, ()
    words = tuple(_in_words(pair, names[pair.velocity], n, data.dt) for pair, n in late.items())
    return shifted(data, {pair.velocity: samples for pair, samples in late.items()}), words


def _in_words(pair: VelocityPair, name: str, samples: float, dt: float) -> str:
    time = f"{1e3 * abs(samples) * dt:.2g} ms ({abs(samples):.2g} samples)"
    if pair.difference.is_backward:
        return (
            f"{name} is the backward difference of {pair.position}, and so {time} late; it was "
            "moved back. No sensor delays it."
        )
    when = "after" if samples > 0.0 else "before"
    return (
        f"{name} comes {time} {when} the position that it belongs to, as filters do; it was moved "
        "back."
    )


def _short(pair: VelocityPair, dt: float) -> bool:
    if pair.difference.is_backward:
        return True
    short = abs(pair.samples) <= _SAMPLES and abs(pair.samples) * dt <= _SECONDS
    return short and abs(pair.samples) > max(_VISIBLE, _SIGMAS * pair.stderr)


def _replayed(twin: Twin, data: Trajectories) -> Trajectories:
    """The same commands, simulated."""
    n = min(int(data.lengths.min()), _STEPS)
    obs, actions = data.obs[:_RECORDINGS, 0], data.actions[:_RECORDINGS, :n]

    def one(first: jax.Array, commands: jax.Array) -> jax.Array:
        states = rollout(twin, twin.params, twin.infer(first, twin.params), commands).states
        return jax.vmap(lambda state: twin.observe(state, twin.params))(states)

    with jax.enable_x64(True):
        simulated = np.asarray(jax.jit(jax.vmap(one))(jnp.asarray(obs), jnp.asarray(actions)))
    if not np.isfinite(simulated).all():
        return data
    return Trajectories.from_arrays(list(simulated), list(actions), dt=data.dt)


def match_logged_integrator(
    twin: Twin, data: Trajectories
) -> tuple[Twin, Trajectories, tuple[str, ...]]:
    """
    Where velocities are true half an interval before their positions, let the twin integrate by
    semi-implicit Euler, which logs them so, or shift the velocities of the data: whichever has the
    smaller residual beside friction and an offset at each joint.

    The velocity of semi-implicit Euler is that of the middle of the previous interval. In such a
    log, an accurate twin would find a delay of half an interval and a few per cent of inertia,
    which are the simulator's.

    :param data: sampled at the twin's ``dt``
    :return: the twin, the data, and what was changed, in words
    """
    bare = all(isinstance(layer, ExtendedTwin | AnalyticTwin) for layer in layers_of(twin))
    if velocity_time_of(twin) != 0.0 or not bare:
        return twin, data, ()
    channels = [e.velocity for e in encoders(twin).values() if e.velocity is not None]
    if not channels:
        return twin, data, ()
    before = smoothed_motion(twin, data)
    if not before.moves.any() or not before.measured.any():
        return twin, data, ()
    found = kinematics(joint_motion(twin, data), data.dt, before.period)
    if np.any(np.abs(found.velocity_time[before.measured] - _HALF) > _ABOUT):
        return twin, data, ()
    half = f"{0.5e3 * data.dt:.2g} ms (half a sample) before the positions that they belong to"
    euler = stepping_by(twin, semi_implicit_euler).at_interval(twin.dt, 1)
    moved = _moved(data, channels)
    if _log_residual(euler, data) < _log_residual(twin, moved):
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


def _log_residual(twin: Twin, data: Trajectories) -> float:
    weight, left = residual_beside_friction(twin, smoothed_motion(twin, data))
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
