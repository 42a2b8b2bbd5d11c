"""Regression tests of what a reward depends on beyond the observation."""

import numpy as np

from sb3_hds.wrappers.checks.task_sample import Sample

# Shares of the variance of rewards.
_MATERIAL = 0.02
_RECOVERED = 0.5
# Of the variance of the last action, that an observation leaves open where it contains it.
_KNOWN = 0.02
# Of the variance of rewards: rounding, and the ridge of the regression.
_NOTHING = 1e-4
_FEWEST = 200
_BLOCKS = 10


def explained_by(sample: Sample) -> tuple[float, float, float] | None:
    """
    Regress rewards on observation and action, then on earlier ones as well.

    :return: unexplained shares of the variance given observation and action, given the last action
        too, and given the last observation too; None where there is nothing to regress
    """
    later = np.flatnonzero(sample.age > 0)
    reward = sample.rewards[later]
    sizes = (sample.obs.shape[1], sample.actions.shape[1])
    if len(later) < _FEWEST or not all(sizes) or np.ptp(sample.rewards) < 1e-9:
        return None
    obs, before = _scaled(sample.obs)[later], _scaled(sample.obs)[later - 1]
    action, last = _scaled(sample.actions)[later], _scaled(sample.actions)[later - 1]
    base = _quadratic(np.hstack([obs, action]))
    # As far as the observation contains it, the last action is no news.
    news = np.hstack([last, last**2, last * action])
    moved = obs - before
    return (
        _left_open(base, reward),
        _left_open(np.hstack([base, news]), reward),
        _left_open(np.hstack([base, moved, moved**2]), reward),
    )


def knows_last_action(sample: Sample) -> bool:
    """:return: whether the observation contains every entry of the last action"""
    later = np.flatnonzero(sample.age > 0)
    obs, last = _scaled(sample.obs)[later], sample.actions[later - 1]
    return all(_left_open(obs, column) < _KNOWN for column in last.T)


def of_action_alone(sample: Sample) -> bool:
    """:return: whether the reward is a quadratic function of the action alone"""
    if len(sample.rewards) < _FEWEST or not sample.actions.shape[1]:
        return False
    return _left_open(_quadratic(_scaled(sample.actions)), sample.rewards) < _NOTHING


def is_missing(before: float, after: float) -> bool:
    """:return: whether the added regressors explain most of a substantial residual"""
    return before > _MATERIAL and after < _RECOVERED * before


def _left_open(features: np.ndarray, target: np.ndarray) -> float:
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
