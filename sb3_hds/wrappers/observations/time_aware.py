"""The remaining time in the observation."""

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from sb3_hds.errors import ParameterError
from sb3_hds.wrappers.episodes.step_limit import chosen_limit

_KEY = "remaining_time"


class TimeAware(gymnasium.Wrapper, gymnasium.utils.RecordConstructorArgs):
    r"""
    Adds the remaining time to the observation: :math:`1 - k / n` after ``k`` of ``n`` steps.

    A Box gets one more entry, a Dict the key ``"remaining_time"``. For tasks with a
    true time limit, where values depend on the remaining time. To make its end a termination, add
    :class:`~sb3_hds.wrappers.TruncateToTerminate`. The spaces of the wrapped
    environment are left alone.

    Source: Pardo et al., *Time Limits in Reinforcement Learning*, ICML 2018, section 3.

    :param env: observes a Box of floats with one axis, or a Dict
    :param max_episode_steps: ``n``; None: the environment's own limit
    :raises ParameterError: for other observations, no positive whole number, or where the
        environment has no limit
    """

    def __init__(self, env: gymnasium.Env, max_episode_steps: int | None = None) -> None:
        gymnasium.utils.RecordConstructorArgs.__init__(self, max_episode_steps=max_episode_steps)
        gymnasium.Wrapper.__init__(self, env)
        self.max_episode_steps = chosen_limit("TimeAware", env, max_episode_steps)
        self.observation_space = _with_time(env.observation_space)
        self._elapsed = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        obs, info = self.env.reset(seed=seed, options=options)
        self._elapsed = 0
        return self._seen(obs), info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        obs, reward, terminated, truncated, info = self.env.step(action)
        self._elapsed += 1
        return self._seen(obs), reward, terminated, truncated, info

    def _seen(self, obs: Any) -> Any:
        left = max(0.0, 1.0 - self._elapsed / self.max_episode_steps)
        if isinstance(obs, dict):
            return obs | {_KEY: np.array([left], np.float32)}
        return np.append(obs, left).astype(self.observation_space.dtype)


def _with_time(space: spaces.Space) -> spaces.Space:
    if isinstance(space, spaces.Dict) and _KEY not in space.spaces:
        return spaces.Dict({**space.spaces, _KEY: spaces.Box(0.0, 1.0, (1,), np.float32)})
    if not _is_row(space):
        raise ParameterError(
            f"TimeAware takes observations that are a Box of floats with one axis, or a Dict "
            f"without '{_KEY}', got {space}. Flatten them first: "
            "gymnasium.wrappers.FlattenObservation."
        )
    low, high = np.append(space.low, 0.0), np.append(space.high, 1.0)  # type: ignore[attr-defined]
    return spaces.Box(low.astype(space.dtype), high.astype(space.dtype), dtype=space.dtype)  # type: ignore[arg-type]


def _is_row(space: spaces.Space) -> bool:
    if not isinstance(space, spaces.Box) or len(space.shape) != 1:
        return False
    return np.issubdtype(space.dtype, np.floating)
