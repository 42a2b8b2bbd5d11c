"""Learning from what was executed instead of from what was chosen."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.buffers import DictReplayBuffer, ReplayBuffer

# How far beyond its limits a stored action may be because of single precision, as a share of them.
_ROUNDING = 1e-5
# How far what arrives at a layer may be from what was chosen, as a share of the range.
_REACHED = 1e-4


def executed(
    space: spaces.Space, chosen: np.ndarray, infos: Sequence[Mapping[str, Any]]
) -> np.ndarray:
    """
    The actions to store: ``info["stored_action"]`` where a layer of ``sb3_hds.wrappers`` asks for
    that by ``store="executed"``, otherwise what was chosen.

    :param space: of the actions
    :param chosen: scaled to [-1, 1] where the space is a Box, shape ``(n_envs, n_act)``
    :param infos: of the step, one for each environment
    :return: as ``chosen``
    :raises ValueError: for a stored action that is not in the space, or where the layer was given
        another action than was chosen
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


class ExecutedReplayBuffer(ReplayBuffer):
    """
    SB3's replay buffer, with the actions that were executed (see :func:`executed`), for learners of
    Stable-Baselines3 and SBX: ``SAC(..., replay_buffer_class=ExecutedReplayBuffer)``. The
    model-free algorithms of this package need none: they look themselves.
    """

    def add(
        self,
        obs: np.ndarray,
        next_obs: np.ndarray,
        action: np.ndarray,
        reward: np.ndarray,
        done: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        stored = executed(self.action_space, action, infos)
        super().add(obs, next_obs, stored, reward, done, infos)


class ExecutedDictReplayBuffer(DictReplayBuffer):
    """The same for Dict observations."""

    def add(  # type: ignore[override]
        self,
        obs: dict[str, np.ndarray],
        next_obs: dict[str, np.ndarray],
        action: np.ndarray,
        reward: np.ndarray,
        done: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        stored = executed(self.action_space, action, infos)
        super().add(obs, next_obs, stored, reward, done, infos)


def _check_reached(space: spaces.Box, chosen: np.ndarray, info: Mapping[str, Any]) -> None:
    raw = info.get("raw_action")
    # Where a watchdog acted instead, nothing of what was chosen was executed.
    if raw is None or info.get("command_dropped"):
        return
    low, high = space.low.astype(float), space.high.astype(float)
    wanted = low + 0.5 * (chosen.reshape(space.shape) + 1.0) * (high - low)
    if not np.allclose(raw, wanted, rtol=0.0, atol=_REACHED * np.max(high - low)):
        raise ValueError(
            f"A layer asks to store what was executed for the action {raw}, and {wanted} was "
            "chosen. Some wrapper outside that layer changes actions, for example rescales them: "
            "put it below, or use store='raw'."
        )


def _scaled(space: spaces.Box, action: np.ndarray) -> np.ndarray:
    """As ``BasePolicy.scale_action``."""
    low, high = space.low.astype(float), space.high.astype(float)
    scaled = 2.0 * (action - low) / (high - low) - 1.0 if action.shape == space.shape else action
    if action.shape != space.shape or not np.all(np.abs(scaled) <= 1.0 + _ROUNDING):
        raise ValueError(
            f"A layer asks to store the action {action}, which is not in {space}. Some wrapper "
            "outside that layer rescales actions: put it below, or use store='raw'."
        )
    return np.clip(scaled, -1.0, 1.0)


# Pickles of a buffer name the public package, which stays where it is.
ExecutedReplayBuffer.__module__ = ExecutedDictReplayBuffer.__module__ = "sb3_hds.algos"
