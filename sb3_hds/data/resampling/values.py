"""Properties of values: wrapped angles, runs of flags, and the smallest step if quantised."""

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Bool, Float64

_AROUND = 5.0  # typical steps: largest deviation of a wrap from a full turn
_NEAR = 50  # smallest steps: for larger ones, quantisation cannot be distinguished from rounding
_FEWEST = 10  # steps from which a smallest step is inferred


def angle_wraps(jumps: np.ndarray, typical: np.ndarray) -> np.ndarray:
    """
    :param jumps: from sample to sample [rad]
    :param typical: size of a jump, one for all or one for each channel
    :return: which of the jumps are wraps of an angle: one or more full turns
    """
    turns = np.round(np.abs(jumps) / (2.0 * np.pi))
    return (turns > 0) & (np.abs(np.abs(jumps) - 2.0 * np.pi * turns) < _AROUND * typical)


def unwrapped(x: np.ndarray) -> np.ndarray:
    """Unwrap values that look like a wrapped angle [rad] or [deg]."""
    for turn in (2.0 * np.pi, 360.0):
        wraps = np.abs(np.abs(np.diff(x)) - turn) < turn / (2.0 * np.pi)
        if wraps.any() and np.ptp(x) < 1.05 * turn:
            return np.unwrap(x, period=turn)
    return x


def runs(flags: Bool[np.ndarray, " steps"]) -> Iterator[tuple[int, int]]:
    """
    :param flags: of rows, or of the steps between rows
    :return: start (inclusive) and end (exclusive) of each run of set flags
    """
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int)))
    yield from zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)


def resolutions(rows: Sequence[np.ndarray]) -> Float64[np.ndarray, " n_obs"]:
    """
    Works for interpolated values, too, if some of them are still equal.

    :param rows: observations of each segment, each of shape ``(rows, n_obs)``
    :return: smallest step of each quantised channel, otherwise 0
    """
    return np.array([_resolution([x[:, j] for x in rows]) for j in range(rows[0].shape[1])])


def _resolution(values: Sequence[np.ndarray]) -> float:
    span = float(np.ptp(np.concatenate(values)))
    steps = np.concatenate([np.diff(x) for x in values])
    kept = np.unique(np.concatenate([x[1:][np.diff(x) == 0.0] for x in values]))
    return _common_step(np.diff(kept), span) or _common_step(np.abs(steps), span)


def _common_step(steps: np.ndarray, span: float) -> float:
    """The common divisor of all steps, or 0."""
    # Differences of decimals are exact to about 1e-16 of the values; smaller steps are rounding.
    moving = steps[steps > 1e-9 * span]
    if len(moving) < _FEWEST:
        return 0.0
    # The smallest observed step may be a multiple of the smallest possible one.
    for quantile in (0.01, 0.001, 0.0):
        smallest = float(np.quantile(moving, quantile, method="lower"))
        for step in (smallest, smallest / 2.0, smallest / 3.0):
            ratios = moving[moving < _NEAR * step] / step
            if len(ratios) >= _FEWEST and (np.abs(ratios - np.round(ratios)) < 0.1).mean() > 0.9:
                return step
    return 0.0
