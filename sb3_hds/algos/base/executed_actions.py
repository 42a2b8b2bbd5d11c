"""Storing the actions that a layer executed in place of the chosen ones."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.buffers import DictReplayBuffer, ReplayBuffer

# Tolerance of the limits of a stored action, for single precision, in scaled actions.
_ROUNDING = 1e-5
# Tolerance between the chosen action and the one that a layer received, as a share of the range.
_REACHED = 1e-4


def executed(
    space: spaces.Space, chosen: np.ndarray, infos: Sequence[Mapping[str, Any]]
) -> np.ndarray:
    """
    The actions to store: ``info["stored_action"]`` where a layer of ``sb3_hds.wrappers`` sets it
    (``store="executed"``), otherwise the chosen ones.

    :param space: action space
    :param chosen: scaled to [-1, 1] where the space is a Box, shape ``(n_envs, n_act)``
    :param infos: of the step, one for each environment
    :return: scaled actions, shape of ``chosen``
    :raises ValueError: for a stored action outside the space, and for a layer that received another
        action than the chosen one
    """
    given = [info.get("stored_action") for info in infos]
    if all(action is None for action in given) or not isinstance(space, spaces.Box):
        return chosen
    stored = np.array(chosen, copy=True)
    for i, action in enumerate(given):
        if action is not None:
            found = _scaled(space, np.asarray(action, float)).reshape(stored[i].shape)
            _check_reached(space, stored[i], infos[i])
            stored[i] = found
    return stored


class _StoresExecuted:
    """Stores executed actions (see :func:`executed`)."""

    action_space: spaces.Space

    def add(
        self,
        obs: Any,
        next_obs: Any,
        action: np.ndarray,
        reward: np.ndarray,
        done: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        buffer: Any = super()
        stored = executed(self.action_space, action, infos)
        buffer.add(obs, next_obs, stored, reward, done, infos)


class ExecutedReplayBuffer(_StoresExecuted, ReplayBuffer):
    """
    SB3's replay buffer, which stores executed actions (see :func:`executed`), for algorithms of
    Stable-Baselines3 and SBX: ``SAC(..., replay_buffer_class=ExecutedReplayBuffer)``. The
    model-free algorithms of this package store them in any replay buffer.
    """


class ExecutedDictReplayBuffer(_StoresExecuted, DictReplayBuffer):
    """:class:`ExecutedReplayBuffer` for Dict observations."""


def _check_reached(space: spaces.Box, chosen: np.ndarray, info: Mapping[str, Any]) -> None:
    raw = info.get("raw_action")
    # After `command_dropped`, a watchdog acted and nothing of the chosen action was executed.
    if raw is None or info.get("command_dropped"):
        return
    low, high = space.low.astype(float), space.high.astype(float)
    wanted = low + 0.5 * (chosen.reshape(space.shape) + 1.0) * (high - low)
    if not np.allclose(raw, wanted, rtol=0.0, atol=_REACHED * np.max(high - low)):
        raise ValueError(
            f"A layer asks to store the executed form of action {raw}, but {wanted} was chosen. A "
            "wrapper outside that layer changes actions, for example by rescaling them: move it "
            "below the layer, or use store='raw'."
        )


def _scaled(space: spaces.Box, action: np.ndarray) -> np.ndarray:
    """``BasePolicy.scale_action`` in double precision, for actions within the limits only."""
    low, high = space.low.astype(float), space.high.astype(float)
    scaled = 2.0 * (action - low) / (high - low) - 1.0 if action.shape == space.shape else action
    if action.shape != space.shape or not np.all(np.abs(scaled) <= 1.0 + _ROUNDING):
        raise ValueError(
            f"A layer asks to store the action {action}, which is not in {space}. A wrapper "
            "outside that layer rescales actions: move it below the layer, or use store='raw'."
        )
    return np.clip(scaled, -1.0, 1.0)


# Pickled buffers refer to the public package, whose name does not change.
ExecutedReplayBuffer.__module__ = ExecutedDictReplayBuffer.__module__ = "sb3_hds.algos"
