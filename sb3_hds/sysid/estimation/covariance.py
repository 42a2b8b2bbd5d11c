"""Covariance of estimates, clustered, and directions that the data do not determine."""

from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Float, Int

# With fewer recordings than this more than there are parameters, windows count as independent.
_FEWEST_RECORDINGS = 12
# A direction is undetermined if its standard error is this many typical deviations.
_UNDETERMINED = 100.0


class Spread(NamedTuple):
    """
    :param covariance: of the estimates, shape ``(p, p)``; infinite where they are undetermined
    :param stderr: standard errors, shape ``(p,)``
    :param freedom: degrees of freedom of the t distribution
    :param n_groups: independent clusters
    :param undetermined: unit vectors that the data do not determine, shape ``(k, p)``, in units of
        each parameter's scale
    """

    covariance: np.ndarray
    stderr: np.ndarray
    freedom: int
    n_groups: int
    undetermined: np.ndarray

    def quantile(self, level: float) -> float:
        """:return: half the width of a confidence interval, in standard errors"""
        return float(scipy.stats.t.ppf(0.5 + 0.5 * level, self.freedom))


def covariance_of(
    curvature: Float[np.ndarray, "p p"],
    scores: Float[np.ndarray, "n p"],
    origin: Int[np.ndarray, " n"],
    scale: Float[np.ndarray, " p"],
    prior: float,
    n_measured: int,
) -> Spread:
    """
    The sandwich estimator, clustered by recording, or by window where recordings are few.

    Source: Cameron and Miller, *A practitioner's guide to cluster-robust inference*, Journal of
    Human Resources 50(2), 2015, sections II and VI (CR1 correction, t with G - 1).

    :param curvature: of the cost, start states eliminated, parameters in units of their scale
    :param scores: slopes of the cost of each window, likewise
    :param origin: recording of each window
    :param scale: typical deviation of each parameter
    :param prior: reciprocal of the standard deviation of each parameter's prior, in units of its
        scale
    :param n_measured: number of measurements minus number of start-state parameters
    """
    n, p = scores.shape
    recordings = np.unique(origin)
    groups = origin if len(recordings) >= _FEWEST_RECORDINGS + p else np.arange(n)
    labels = np.unique(groups)
    power, directions = np.linalg.eigh(curvature + prior**2 * np.eye(p))
    # In units of the scale, under noise of one, the standard error along a direction.
    weak = power <= _UNDETERMINED**-2
    bread = (directions[:, ~weak] / power[~weak]) @ directions[:, ~weak].T
    summed = np.stack([scores[groups == label].sum(0) for label in labels])
    n_groups = len(labels)
    correction = n_groups / max(n_groups - 1, 1) * (n_measured - 1) / max(n_measured - p, 1)
    covariance = bread @ (correction * summed.T @ summed + prior**2 * np.eye(p)) @ bread
    stderr = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    touched = (np.abs(directions[:, weak]) > 0.1).any(1)
    stderr = np.where(touched, np.inf, stderr)
    covariance = covariance.copy()
    covariance[touched] = covariance[:, touched] = np.inf
    return Spread(
        covariance * np.outer(scale, scale),
        stderr * scale,
        max(n_groups - 1, 1),
        n_groups,
        directions[:, weak].T,
    )
