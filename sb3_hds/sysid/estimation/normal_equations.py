"""Normal equations of windows, start states eliminated, and the damped step that they give."""

from typing import NamedTuple

import numpy as np

# Stands for the error of a simulation that is not finite, in units of the noise.
_NOT_FINITE = 1e4
# Added to curvatures, relative to their trace, so that what moves nothing stays where it is.
_RIDGE = 1e-9


class Blocks(NamedTuple):
    """Normal equations of windows: of start states, of parameters, and between them."""

    raw: np.ndarray
    cost: np.ndarray
    own: np.ndarray
    cross: np.ndarray
    shared: np.ndarray
    by_start: np.ndarray
    by_theta: np.ndarray


class Step(NamedTuple):
    """Normal equations with the start states eliminated, and how those follow."""

    curvature: np.ndarray
    scores: np.ndarray
    from_score: np.ndarray
    from_step: np.ndarray


# States that grow beyond any bound are counted as errors of a fixed size: they need no warning.
@np.errstate(over="ignore", invalid="ignore")
def normal_equations(
    raw: np.ndarray,
    by_start: np.ndarray,
    by_theta: np.ndarray,
    noise: np.ndarray,
    counted: np.ndarray,
    threshold: float,
) -> Blocks:
    """
    Of Gauss-Newton with Huber's loss.

    :param raw: simulated minus measured, shape ``(n, rows, n_obs)``
    :param by_start: its derivative by the start state, shape ``(n, rows, n_obs, free)``
    :param by_theta: by the parameters in units of their scale, shape ``(n, rows, n_obs, p)``
    :param noise: standard deviation of each channel's noise, shape ``(n_obs,)``
    :param counted: weight of each row, shape ``(rows,)``
    :param threshold: of Huber's loss, in units of the noise
    """
    n = len(raw)
    finite = np.isfinite(raw)
    error = np.where(finite, raw / noise, _NOT_FINITE) * counted[:, None]
    size = np.abs(error)
    small = np.minimum(size, threshold)
    cost = np.sum(0.5 * small**2 + threshold * (size - small), (1, 2))
    weight = np.sqrt(np.minimum(1.0, threshold / np.maximum(size, 1e-12)))
    factor = (weight * counted[:, None] / noise)[..., None]
    start, theta = (
        np.where(np.isfinite(slopes), slopes, 0.0) * factor for slopes in (by_start, by_theta)
    )
    numbers = raw[0].size
    start, theta = (x.reshape(n, numbers, x.shape[-1]) for x in (start, theta))
    right = (weight * error).reshape(n, -1, 1)
    across = start.transpose(0, 2, 1)
    return Blocks(
        raw=raw,
        cost=cost,
        own=across @ start,
        cross=across @ theta,
        shared=theta.transpose(0, 2, 1) @ theta,
        by_start=(across @ right)[..., 0],
        by_theta=(theta.transpose(0, 2, 1) @ right)[..., 0],
    )


@np.errstate(over="ignore", invalid="ignore")
def eliminate_starts(blocks: Blocks, damping: float) -> Step:
    """
    Schur complement of the start states.

    :param damping: Levenberg-Marquardt's, relative to the diagonal
    """
    free = blocks.own.shape[1]
    diagonal = np.einsum("nff->nf", blocks.own)
    ridge = damping * diagonal + _RIDGE * diagonal.sum(1, keepdims=True) + 1e-300
    own = blocks.own + ridge[:, :, None] * np.eye(free)
    solved = np.linalg.solve(own, np.concatenate([blocks.by_start[..., None], blocks.cross], 2))
    back = blocks.cross.transpose(0, 2, 1)
    return Step(
        curvature=blocks.shared - back @ solved[..., 1:],
        scores=blocks.by_theta - (back @ solved[..., :1])[..., 0],
        from_score=-solved[..., 0],
        from_step=-solved[..., 1:],
    )


def damped_step(
    values: np.ndarray,
    step: Step,
    pull: tuple[np.ndarray, np.ndarray],
    size: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    damping: float,
) -> np.ndarray:
    """
    Where the damped step leads; what would leave its bounds stays.

    :param pull: curvature and slope of the prior
    """
    curvature = step.curvature.sum(0) + np.diag(pull[0])
    score = step.scores.sum(0) + pull[1]
    free = ~(((values <= low) & (score > 0.0)) | ((values >= high) & (score < 0.0)))
    if not free.any():
        return values
    inner = curvature[np.ix_(free, free)]
    ridge = damping * np.diag(inner) + _RIDGE * np.trace(inner) + 1e-300
    moved = values.copy()
    moved[free] -= size[free] * np.linalg.solve(inner + np.diag(ridge), score[free])
    return np.clip(moved, low, high)
