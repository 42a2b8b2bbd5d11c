"""Normal equations of windows: start states eliminated, the damped step, and the covariance."""

from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Float, Int

#: error of a simulation that is not finite, in units of the noise: larger ones say no more
DIVERGED = 1e4
#: level of the intervals of a diagnosis
CONFIDENCE = 0.9
# Added to curvatures, relative to their trace, so that parameters without influence stay.
_RIDGE = 1e-9
# With fewer recordings than this more than there are parameters, windows count as independent.
_FEWEST_RECORDINGS = 12
# A direction is undetermined if its standard error is this many typical deviations.
_UNDETERMINED = 100.0


class Blocks(NamedTuple):
    """
    Cost of windows with its derivatives by start state and parameters, of Gauss-Newton. Leaves have
    one row for each window.

    :param residual: simulated minus measured, shape ``(n, rows, n_obs)``
    :param cost: shape ``(n,)``
    :param start_hessian: shape ``(n, free, free)``
    :param cross_hessian: by start state and parameters, shape ``(n, free, p)``
    :param hessian: by parameters in units of their scale, shape ``(n, p, p)``
    :param start_gradient: shape ``(n, free)``
    :param gradient: by parameters in units of their scale, shape ``(n, p)``
    """

    residual: np.ndarray
    cost: np.ndarray
    start_hessian: np.ndarray
    cross_hessian: np.ndarray
    hessian: np.ndarray
    start_gradient: np.ndarray
    gradient: np.ndarray


class Step(NamedTuple):
    """Normal equations with the start states eliminated, and how the start states follow."""

    curvature: np.ndarray
    scores: np.ndarray
    from_score: np.ndarray
    from_step: np.ndarray


# States that diverge count as errors of a fixed size: no warning is needed.
@np.errstate(over="ignore", invalid="ignore")
def normal_equations(
    residual: np.ndarray,
    by_start: np.ndarray,
    by_theta: np.ndarray,
    noise: np.ndarray,
    counted: np.ndarray,
    threshold: float,
) -> Blocks:
    """
    Of Gauss-Newton with Huber's loss.

    :param residual: simulated minus measured, shape ``(n, rows, n_obs)``
    :param by_start: its derivative by the start state, shape ``(n, rows, n_obs, free)``
    :param by_theta: by the parameters in units of their scale, shape ``(n, rows, n_obs, p)``
    :param noise: standard deviation of each channel's noise, shape ``(n_obs,)``
    :param counted: weight of each row, shape ``(rows,)``
    :param threshold: of Huber's loss, in units of the noise
    """
    n = len(residual)
    finite = np.isfinite(residual)
    error = np.where(finite, residual / noise, DIVERGED) * counted[:, None]
    size = np.abs(error)
    small = np.minimum(size, threshold)
    cost = np.sum(0.5 * small**2 + threshold * (size - small), (1, 2))
    weight = np.sqrt(np.minimum(1.0, threshold / np.maximum(size, 1e-12)))
    factor = (weight * counted[:, None] / noise)[..., None]
    start, theta = (
        np.where(np.isfinite(slopes), slopes, 0.0) * factor for slopes in (by_start, by_theta)
    )
    numbers = residual[0].size
    start, theta = (x.reshape(n, numbers, x.shape[-1]) for x in (start, theta))
    right = (weight * error).reshape(n, -1, 1)
    across = start.transpose(0, 2, 1)
    return Blocks(
        residual=residual,
        cost=cost,
        start_hessian=across @ start,
        cross_hessian=across @ theta,
        hessian=theta.transpose(0, 2, 1) @ theta,
        start_gradient=(across @ right)[..., 0],
        gradient=(theta.transpose(0, 2, 1) @ right)[..., 0],
    )


@np.errstate(over="ignore", invalid="ignore")
def eliminate_starts(blocks: Blocks, damping: float) -> Step:
    """
    Schur complement of the start states.

    :param damping: Levenberg-Marquardt's, relative to the diagonal
    """
    free = blocks.start_hessian.shape[1]
    diagonal = np.einsum("nff->nf", blocks.start_hessian)
    ridge = damping * diagonal + _RIDGE * diagonal.sum(1, keepdims=True) + 1e-300
    own = blocks.start_hessian + ridge[:, :, None] * np.eye(free)
    right = np.concatenate([blocks.start_gradient[..., None], blocks.cross_hessian], 2)
    solved = np.linalg.solve(own, right)
    back = blocks.cross_hessian.transpose(0, 2, 1)
    return Step(
        curvature=blocks.hessian - back @ solved[..., 1:],
        scores=blocks.gradient - (back @ solved[..., :1])[..., 0],
        from_score=-solved[..., 0],
        from_step=-solved[..., 1:],
    )


def damped_step(
    values: np.ndarray,
    step: Step,
    prior_terms: tuple[np.ndarray, np.ndarray],
    size: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    damping: float,
) -> np.ndarray:
    """
    :param prior_terms: curvature and slope of the prior
    :return: the parameters after the damped step; those at a bound that would leave it stay
    """
    curvature = step.curvature.sum(0) + np.diag(prior_terms[0])
    score = step.scores.sum(0) + prior_terms[1]
    free = ~(((values <= low) & (score > 0.0)) | ((values >= high) & (score < 0.0)))
    if not free.any():
        return values
    inner = curvature[np.ix_(free, free)]
    ridge = damping * np.diag(inner) + _RIDGE * np.trace(inner) + 1e-300
    moved = values.copy()
    moved[free] -= size[free] * np.linalg.solve(inner + np.diag(ridge), score[free])
    return np.clip(moved, low, high)


class Uncertainty(NamedTuple):
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
) -> Uncertainty:
    """
    The sandwich estimator, clustered by recording, or by window where recordings are few.

    Source: Cameron and Miller, *A practitioner's guide to cluster-robust inference*, Journal of
    Human Resources 50(2), 2015, sections II and VI (CR1 correction, t with G - 1).

    :param curvature: of the cost, start states eliminated, parameters in units of their scale
    :param scores: slopes of the cost of each window, in the same units
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
    return Uncertainty(
        covariance * np.outer(scale, scale),
        stderr * scale,
        max(n_groups - 1, 1),
        n_groups,
        directions[:, weak].T,
    )
