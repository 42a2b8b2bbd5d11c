"""Bootstrap confidence intervals over seeds, as in rliable."""

from collections.abc import Sequence

import numpy as np
from scipy.stats import trim_mean

_N_DRAWS, _LEVEL = 10_000, 0.95


def of_mean(values: Sequence[float]) -> tuple[float, float, float]:
    """
    :param values: of one method, by seed
    :return: their mean and its 95 % interval; that of a single seed is not known
    """
    values = np.asarray(values, float)
    if len(values) < 2:
        return float(values.mean()), np.nan, np.nan
    return float(values.mean()), *_limits(_means(values, np.random.default_rng(0)))


def of_difference(ours: Sequence[float], theirs: Sequence[float]) -> tuple[float, float, float]:
    """:return: our mean minus theirs and its 95 % interval; both are drawn independently"""
    ours, theirs = np.asarray(ours, float), np.asarray(theirs, float)
    difference = float(ours.mean() - theirs.mean())
    if min(len(ours), len(theirs)) < 2:
        return difference, np.nan, np.nan
    rng = np.random.default_rng(0)
    return difference, *_limits(_means(ours, rng) - _means(theirs, rng))


def of_iqm(groups: Sequence[np.ndarray]) -> tuple[float, float, float]:
    """
    :param groups: scores of one method, by seed, for each environment
    :return: their interquartile mean and its 95 % interval: seeds are drawn within each environment
    """
    rng = np.random.default_rng(0)
    drawn = [group[rng.integers(len(group), size=(_N_DRAWS, len(group)))] for group in groups]
    middles = trim_mean(np.concatenate(drawn, 1), 0.25, axis=1)
    return float(trim_mean(np.concatenate(groups), 0.25)), *_limits(middles)


def probability_of_improvement(ours: Sequence[float], theirs: Sequence[float]) -> float:
    """:return: the probability that a run of ours earns more than one of theirs; ties count half"""
    above = np.subtract.outer(np.asarray(ours, float), np.asarray(theirs, float))
    return float(np.mean((above > 0.0) + 0.5 * (above == 0.0)))


def _means(values: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return values[rng.integers(len(values), size=(_N_DRAWS, len(values)))].mean(1)


def _limits(means: np.ndarray) -> tuple[float, float]:
    low, high = np.quantile(means, (0.5 - _LEVEL / 2.0, 0.5 + _LEVEL / 2.0))
    return float(low), float(high)
