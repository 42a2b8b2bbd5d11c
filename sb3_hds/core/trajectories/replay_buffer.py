"""Episodes from a replay buffer of Stable-Baselines3, without importing it."""

from typing import Any

import numpy as np

from sb3_hds.errors import TrajectoryError


def episodes_in(
    buffer: Any, action_space: Any = None, scaled: bool = True, only_finite: bool = False
) -> tuple[list[np.ndarray], list[np.ndarray], list[tuple[int, int]]]:
    """
    Read the ring buffer by environment, oldest step first.

    An episode ends at ``dones`` (timeouts included), and where the next stored observation is not
    the step's next observation: there the environment was reset from outside. With
    ``optimize_memory_usage`` SB3 overwrites an episode's last next observation, and the oldest
    observation of a full ring: those steps are dropped.

    :param buffer: anything with the attributes of SB3's ``ReplayBuffer``
    :param action_space: the box that actions are scaled back to; default: the buffer's own
    :param scaled: whether stored actions are scaled to [-1, 1], as SB3's algorithms store them
    :param only_finite: drop steps with a value that is not finite, and split the episode there
    :return: observations, each ``(T + 1, n_obs)``; actions, each ``(T, n_act)``; and where each
        episode begins: steps since the oldest one in the ring, and the environment
    :raises TrajectoryError: for spaces other than boxes of one axis, and for an empty buffer
    """
    if not isinstance(buffer.observations, np.ndarray) or buffer.observations.ndim != 3:
        raise TrajectoryError(
            "Trajectories are read from buffers of flat Box observations, "
            f"got observations of {buffer.observation_space}."
        )
    shared = bool(getattr(buffer, "optimize_memory_usage", False))
    # Oldest first.
    order = np.arange(buffer.pos)
    if buffer.full:
        order = (buffer.pos + np.arange(int(shared), buffer.buffer_size)) % buffer.buffer_size
    following = (order + 1) % buffer.buffer_size
    space = buffer.action_space if action_space is None else action_space
    commands = _unscaled(buffer, space, scaled)
    obs, actions, begins = [], [], []
    first = int(shared and buffer.full)
    for env in range(buffer.n_envs):
        before = buffer.observations[order, env]
        stored = buffer.observations[following] if shared else buffer.next_observations[order]
        after = stored[:, env]
        ends = (buffer.dones[order, env] > 0) | (buffer.timeouts[order, env] > 0)
        ends[:-1] |= np.any(after[:-1] != before[1:], axis=1)
        for steps in np.split(np.arange(len(order)), np.flatnonzero(ends) + 1):
            if shared and len(steps) and ends[steps[-1]] and steps[-1] != len(order) - 1:
                steps = steps[:-1]
            for piece in _finite_runs(steps, before, after) if only_finite else [steps]:
                if len(piece):
                    obs.append(np.concatenate([before[piece], after[piece[-1:]]]))
                    actions.append(commands[order[piece], env])
                    begins.append((first + int(piece[0]), env))
    if not obs:
        raise TrajectoryError("The replay buffer holds no step yet. Collect some first.")
    return obs, actions, begins


def _finite_runs(steps: np.ndarray, before: np.ndarray, after: np.ndarray) -> list[np.ndarray]:
    finite = np.all(np.isfinite(before[steps]) & np.isfinite(after[steps]), axis=1)
    runs = np.split(steps, np.flatnonzero(np.diff(finite.astype(int))) + 1) if len(steps) else []
    return [run for run in runs if finite[run[0] - steps[0]]]


def _unscaled(buffer: Any, space: Any, scaled: bool) -> np.ndarray:
    """Actions in the units of the action space; the inverse of SB3's ``policy.scale_action``."""
    low, high = getattr(space, "low", None), getattr(space, "high", None)
    if low is None or high is None or not (np.all(np.isfinite(low)) and np.all(np.isfinite(high))):
        raise TrajectoryError(
            f"Actions must come from a Box with finite limits, got {space}. "
            "Pass the box that they were scaled from: action_space=..."
        )
    stored = buffer.actions.astype(np.float64)
    if not scaled:
        return stored
    low, high = np.ravel(low).astype(np.float64), np.ravel(high).astype(np.float64)
    return low + 0.5 * (stored + 1.0) * (high - low)
