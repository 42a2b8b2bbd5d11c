"""Comparison of two models on held-out windows, clustered by recording."""

from typing import Any, NamedTuple

import numpy as np
import scipy
from jaxtyping import Float, Int

from sb3_hds.core import Trajectories
from sb3_hds.sysid.estimation.normal_equations import CONFIDENCE, DIVERGED
from sb3_hds.sysid.measurements import FEWEST_CLUSTERS, N_STRETCHES

# Ratios of errors beyond this say no more.
_MOST_RATIO = 1e6
#: by which factor the level of a test on windows is stricter than that on clusters: windows of one
#: recording are not independent
STRICTER = 25.0
# What confirms a candidate: by which share the mean square error of held-out recordings falls, at
# which level (one-sided: 5 % of a two-sided test), and by how much the information criterion of the
# others. A difference of 6 is strong evidence: Kass and Raftery, Bayes factors, J. American
# Statistical Association 90, 1995.
LEAST_GAIN, LEVEL, LEAST_BIC = 0.05, 0.025, 6.0
# Another candidate belongs into the set unless it is worse than the best at this level.
_LEVEL_OF_SET = 0.05
# Errors that differ by a smaller share are the same, however surely they differ.
_SAME = 0.01


class Comparison(NamedTuple):
    """
    One model against another on the same windows.

    :param gain: relative decrease of the mean square error, geometric mean over clusters
    :param p_value: one-sided p-value of the hypothesis that there is no gain
    :param low: lower end of the 90 % interval of the gain
    :param high: upper end
    :param n_clusters: clusters
    """

    gain: float
    p_value: float
    low: float
    high: float
    n_clusters: int


class Split(NamedTuple):
    """
    :param cluster: cluster of each window, -1 for padding, shape ``(n,)``
    :param held_out: whether the window is kept from selection, shape ``(n,)``
    """

    cluster: Int[np.ndarray, " n"]
    held_out: np.ndarray


def t_test(
    new: Float[np.ndarray, " n"], old: Float[np.ndarray, " n"], cluster: Int[np.ndarray, " n"]
) -> Comparison:
    """
    A t test on the logarithms of error ratios, one for each cluster: ratios of single windows, or
    differences instead of ratios, have tails too heavy for it.

    :param new: mean square error of each window
    :param old: the same of the model that is to be beaten
    :param cluster: cluster of each window; negative: does not count
    """
    labels = np.unique(cluster[cluster >= 0])
    sums = [[errors[cluster == label].sum() for label in labels] for errors in (new, old)]
    after, before = (np.maximum(np.array(s), 1e-300) for s in sums)
    ratio = np.clip(np.log(before / after), -np.log(_MOST_RATIO), np.log(_MOST_RATIO))
    n = len(ratio)
    if n < 2:
        return Comparison(float(1.0 - np.exp(-ratio.mean())), 1.0, -np.inf, 1.0, n)
    stderr = max(ratio.std(ddof=1) / np.sqrt(n), 1e-12)
    p_value = float(scipy.stats.t.sf(ratio.mean() / stderr, n - 1))
    half = scipy.stats.t.ppf(0.5 + 0.5 * CONFIDENCE, n - 1) * stderr
    low, gain, high = 1.0 - np.exp(-ratio.mean() - np.array([-half, 0.0, half]))
    return Comparison(float(gain), p_value, float(low), float(high), n)


def t_or_rank_test(
    new: Float[np.ndarray, " n"], old: Float[np.ndarray, " n"], cluster: Int[np.ndarray, " n"]
) -> Comparison:
    """
    As :func:`t_test`, with a second chance. Four or five clusters of which some gain a little and
    others nearly all are too few for a t test, though every window speaks for the new model: so a
    signed rank test on windows, which has no tails to fear, counts too, at a much stricter level,
    because windows of one recording are not independent.
    """
    comparison = t_test(new, old, cluster)
    before, after = (np.maximum(errors[cluster >= 0], 1e-300) for errors in (old, new))
    ratio = np.log(before / after)
    if not np.any(ratio):
        return comparison
    by_window: Any = scipy.stats.wilcoxon(ratio, alternative="greater")
    return comparison._replace(p_value=min(comparison.p_value, STRICTER * float(by_window.pvalue)))


def by_scores(
    new: Float[np.ndarray, "n rows obs"],
    old: Float[np.ndarray, "n rows obs"],
    cluster: Int[np.ndarray, " n"],
) -> float:
    r"""
    One-sided score test: are the residuals of a model correlated with the change that another one
    predicts?

    With errors :math:`r` of the old and :math:`r'` of the new model, and :math:`\delta = r - r'`,
    the sum of :math:`\delta \cdot r` has the mean zero if the old model is right, whatever the new
    one is, as long as neither has seen these data. Its variance is estimated by the same sum with
    :math:`r'`, which the effect is not in. So recordings that show an effect strongly and others
    that show it weakly do not raise the p-value, as they would in a t test on gains. Errors are
    clustered by recording.

    Source: a score (Lagrange multiplier) test, its covariance clustered and taken under the
    alternative; Cameron and Miller, *A practitioner's guide to cluster-robust inference*, Journal
    of Human Resources 50(2), 2015.

    :param new: errors of windows in units of the noise
    :param old: the same of the model that is to be beaten
    :param cluster: cluster of each window; negative: does not count
    :return: one-sided p-value
    """
    labels = np.unique(cluster[cluster >= 0])
    if len(labels) < 2:
        return 1.0
    before, after = (
        np.clip(np.nan_to_num(r, nan=DIVERGED), -DIVERGED, DIVERGED) for r in (old, new)
    )
    leans, noise = (np.sum((before - after) * r, (1, 2)) for r in (before, after))
    by_cluster = np.array([noise[cluster == label].sum() for label in labels])
    correction = len(labels) / (len(labels) - 1)
    variance = max(
        float(np.sum(noise[cluster >= 0] ** 2)), correction * float(np.sum(by_cluster**2))
    )
    if not variance:
        return 1.0
    return float(scipy.stats.t.sf(leans[cluster >= 0].sum() / np.sqrt(variance), len(labels) - 1))


def split(data: Trajectories, origin: Int[np.ndarray, " n"], seed: int) -> Split:
    """
    Half of the clusters to select on, half to confirm. Where there are several recordings of each
    condition, both halves see all conditions; where recordings are few, stretches of them are the
    clusters.

    :param origin: recording of each window, -1 for padding, in order of time
    """
    recordings = np.unique(origin[origin >= 0])
    cluster = origin.copy()
    if len(recordings) < FEWEST_CLUSTERS:
        cluster = _in_blocks(origin, recordings)
    rng, held_out = np.random.default_rng(seed), np.zeros(len(origin), bool)
    labels = np.unique(cluster[cluster >= 0])
    condition = {
        label: data.conditions[int(np.flatnonzero(data.origin == origin[cluster == label][0])[0])]
        for label in labels
    }
    turn = 0
    for name in dict.fromkeys(condition.values()):
        own = rng.permutation([label for label in labels if condition[label] == name])
        for label in own:
            held_out |= (cluster == label) & bool(turn % 2)
            turn += 1
    return Split(cluster, held_out)


def effective_size(residual: Float[np.ndarray, "n rows obs"]) -> float:
    """:return: effective sample size of these errors, by their lag-one autocorrelation"""
    before, after = residual[:, :-1], residual[:, 1:]
    power = np.sum(residual**2, (0, 1)) + 1e-300
    correlation = np.clip(np.sum(before * after, (0, 1)) / power, 0.0, 0.999)
    return float(
        residual.shape[0] * residual.shape[1] * np.sum((1 - correlation) / (1 + correlation))
    )


def _in_blocks(origin: np.ndarray, recordings: np.ndarray) -> np.ndarray:
    """Stretches of recordings, about as many windows each."""
    cluster, label = np.full(len(origin), -1), 0
    n_blocks = -(-N_STRETCHES // max(len(recordings), 1))
    for recording in recordings:
        for rows in np.array_split(np.flatnonzero(origin == recording), n_blocks):
            if len(rows):
                cluster[rows], label = label, label + 1
    return cluster


def as_good(better: Comparison) -> bool:
    """
    :return: whether one model is not significantly better than another, or by a negligible amount
    """
    return better.p_value > _LEVEL_OF_SET or better.gain < _SAME


def passes(comparison: Comparison, level: float = LEVEL) -> bool:
    return comparison.gain >= LEAST_GAIN and comparison.p_value < level


def information_gain(before: float, after: float, n: float, n_parameters: int) -> float:
    """:return: by which Schwarz's criterion is lower; ``before`` and ``after``: sums of squares"""
    return n * float(np.log(before / after)) - n_parameters * float(np.log(max(n, 2.0)))
