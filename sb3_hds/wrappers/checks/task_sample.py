"""A sample of a task under random actions, as arrays."""

import copy
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from gymnasium import spaces

from sb3_hds.wrappers.episodes.step_limit import step_limit_of


class Sample(NamedTuple):
    """
    Steps one after the other, ``n`` of them.

    :param obs: before each step, flat, shape ``(n, n_obs)``; no columns for images
    :param names: of the entries of an observation
    :param actions: as drawn, flat, shape ``(n, n_act)``
    :param rewards: shape ``(n,)``
    :param age: steps since the episode began, shape ``(n,)``
    :param terminated: shape ``(n,)``
    :param truncated: shape ``(n,)``
    :param success: what ``info["is_success"]`` said, shape ``(n,)``
    :param limit: steps after which an episode is cut; None: not known
    """

    obs: np.ndarray
    names: list[str]
    actions: np.ndarray
    rewards: np.ndarray
    age: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    success: np.ndarray
    limit: int | None

    @property
    def ended(self) -> np.ndarray:
        return self.terminated | self.truncated

    @property
    def lengths(self) -> np.ndarray:
        """Steps of each episode that came to its end."""
        return self.age[self.ended] + 1


def sampled(env: gymnasium.Env, n_steps: int, seed: int) -> Sample:
    """
    :param seed: of starts and actions; the action space's own generator is left alone
    """
    space = copy.deepcopy(env.action_space)
    space.seed(seed)
    obs, _ = env.reset(seed=seed)
    rows: list[tuple] = []
    age = 0
    for _ in range(n_steps):
        action = space.sample()
        before = _numbers(env.observation_space, obs)
        obs, reward, terminated, truncated, info = env.step(action)
        flags = bool(terminated), bool(truncated), bool(info.get("is_success", False))
        rows.append((before, _numbers(space, action), float(reward), age, *flags))
        age += 1
        if terminated or truncated:
            obs, _ = env.reset()
            age = 0
    seen, actions, rewards, ages, *ends = (np.array(column) for column in zip(*rows, strict=True))
    names = _names(env.observation_space, "obs")
    return Sample(seen, names, actions, rewards, ages, *ends, limit=step_limit_of(env))


def _numbers(space: spaces.Space, value: Any) -> np.ndarray:
    """:return: what of it is a number that a network sees as it is; choices and images are not"""
    if isinstance(space, spaces.Dict):
        return np.concatenate([_numbers(part, value[name]) for name, part in space.items()])
    if not _is_numeric(space):
        return np.zeros(0)
    return np.asarray(value, np.float64).ravel()


def _names(space: spaces.Space, name: str) -> list[str]:
    if isinstance(space, spaces.Dict):
        return [one for key, part in space.items() for one in _names(part, f"obs['{key}']")]
    if not _is_numeric(space):
        return []
    return [f"{name}[{', '.join(map(str, i))}]" for i in np.ndindex(space.shape or ())]


def _is_numeric(space: spaces.Space) -> bool:
    return isinstance(space, spaces.Box) and space.dtype != np.uint8
