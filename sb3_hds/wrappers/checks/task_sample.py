"""A sample of a task under random actions, as arrays, and regressions of its rewards."""

import copy
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from gymnasium import spaces

from sb3_hds.wrappers.episodes import step_limit_of

# Unexplained share of the variance of rewards that matters, and the reduction that explains it.
_MATERIAL = 0.02
_RECOVERED = 0.5
# Largest unexplained share of the last action's variance, if observations contain it.
_KNOWN = 0.02
# Unexplained share of the variance of rewards due to rounding and the ridge penalty.
_NOTHING = 1e-4
_FEWEST = 200
_BLOCKS = 10


class Sample(NamedTuple):
    """
    ``n`` consecutive steps.

    :param obs: before each step, flat, shape ``(n, n_obs)``; no columns for images
    :param names: of the entries of an observation
    :param actions: as drawn, flat, shape ``(n, n_act)``
    :param rewards: shape ``(n,)``
    :param age: steps since the episode began, shape ``(n,)``
    :param terminated: shape ``(n,)``
    :param truncated: shape ``(n,)``
    :param success: ``info["is_success"]``, shape ``(n,)``
    :param limit: steps after which an episode is truncated; None: not known
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
        """Steps of each complete episode."""
        return self.age[self.ended] + 1


def sampled(env: gymnasium.Env, n_steps: int, seed: int) -> Sample:
    """:param seed: of initial states and actions; the action space's own generator is not used"""
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
    """:return: the entries that a network reads as numbers: no choices and no images"""
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


def explained_by(sample: Sample) -> tuple[float, float, float] | None:
    """
    Regress rewards on observation and action, then on earlier ones as well.

    :return: unexplained shares of the variance given observation and action; given also the last
        action; given also the last observation. None if there is nothing to regress
    """
    later = np.flatnonzero(sample.age > 0)
    reward = sample.rewards[later]
    sizes = (sample.obs.shape[1], sample.actions.shape[1])
    if len(later) < _FEWEST or not all(sizes) or np.ptp(sample.rewards) < 1e-9:
        return None
    obs, before = _scaled(sample.obs)[later], _scaled(sample.obs)[later - 1]
    action, last = _scaled(sample.actions)[later], _scaled(sample.actions)[later - 1]
    base = _quadratic(np.hstack([obs, action]))
    # The part of the last action that the observation contains adds nothing.
    added = np.hstack([last, last**2, last * action])
    moved = obs - before
    return (
        _unexplained(base, reward),
        _unexplained(np.hstack([base, added]), reward),
        _unexplained(np.hstack([base, moved, moved**2]), reward),
    )


def knows_last_action(sample: Sample) -> bool:
    """:return: whether the observation contains every entry of the last action"""
    later = np.flatnonzero(sample.age > 0)
    obs, last = _scaled(sample.obs)[later], sample.actions[later - 1]
    return all(_unexplained(obs, column) < _KNOWN for column in last.T)


def of_action_alone(sample: Sample) -> bool:
    """:return: whether the reward is a quadratic function of the action alone"""
    if len(sample.rewards) < _FEWEST or not sample.actions.shape[1]:
        return False
    return _unexplained(_quadratic(_scaled(sample.actions)), sample.rewards) < _NOTHING


def is_missing(before: float, after: float) -> bool:
    """:return: whether the added regressors explain most of a substantial residual"""
    return before > _MATERIAL and after < _RECOVERED * before


def _unexplained(features: np.ndarray, target: np.ndarray) -> float:
    """Unexplained share of the variance of a ridge regression, cross-validated in blocks."""
    block = np.arange(len(target)) * _BLOCKS // len(target)
    open_, total = 0.0, 0.0
    for seen, other in ((block % 2 == 0, block % 2 == 1), (block % 2 == 1, block % 2 == 0)):
        mean, std = features[seen].mean(0), features[seen].std(0)
        used = std > 1e-9
        x = np.clip((features[:, used] - mean[used]) / std[used], -10.0, 10.0)
        y = target - target[seen].mean()
        gram = x[seen].T @ x[seen] + 1e-3 * seen.sum() * np.eye(x.shape[1])
        weights = np.linalg.solve(gram, x[seen].T @ y[seen])
        open_ += np.sum((y[other] - x[other] @ weights) ** 2)
        total += np.sum(y[other] ** 2)
    return float(open_ / max(total, 1e-300))


def _quadratic(x: np.ndarray) -> np.ndarray:
    """All pairwise products where there are few regressors, squares otherwise."""
    n, width = x.shape
    if width * (width + 1) // 2 > n // 8:
        return np.hstack([x, x**2])
    first, second = np.triu_indices(width)
    return np.hstack([x, x[:, first] * x[:, second]])


def _scaled(x: np.ndarray) -> np.ndarray:
    std = x.std(0)
    return (x - x.mean(0)) / np.where(std > 1e-9, std, 1.0)
