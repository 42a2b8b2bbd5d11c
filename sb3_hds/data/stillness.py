"""Where a system stands still, and how much its sensors move there."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from sb3_hds.data.stretches import Stretch

_SECONDS, _FEWEST, _MOST = 0.1, 12, 100  # length of a window, and its limits in rows
_WHITE = 0.5  # mean squared step by variance: 2 for white noise, 0 for smooth motion
_SMALL = 0.3  # of the spread of a channel: what is larger is motion
_ALL_NOISE = 3.0  # a channel that spreads no further than this times its noise does not move


class Stillness(NamedTuple):
    """
    :param share: of the time, in [0, 1]
    :param noise: standard deviation of each channel while standing still, in its unit; nan where
        the system never does
    :param n_windows: number of windows that were looked at
    """

    share: float
    noise: Float64[np.ndarray, " n_obs"]
    n_windows: int


def stillness_of(stretches: list[Stretch], resolution: Float64[np.ndarray, " n_obs"]) -> Stillness:
    """
    A window of rows stands still if each channel either stays within two of its smallest steps, or
    spreads little and jumps to and fro as noise does, without the smoothness of motion (von
    Neumann's ratio, the mean squared step by the variance).

    :param stretches: at least one
    :param resolution: smallest step of each channel, 0 where it has none
    """
    windows = [_windows(stretch) for stretch in stretches]
    if not any(len(part) for part in windows):
        return Stillness(0.0, np.full(len(resolution), np.nan), 0)
    # Deviations, steps, ranges: one array per window and channel, whatever its number of rows.
    parts = [part for part in windows if len(part)]
    spread = np.concatenate([part.std(axis=1, ddof=1) for part in parts])
    step = np.concatenate([np.sqrt(np.mean(np.diff(p, axis=1) ** 2, axis=1)) for p in parts])
    width = np.concatenate([np.ptp(part, axis=1) for part in parts])
    overall = np.concatenate([stretch.obs for stretch in stretches]).std(axis=0)
    jitters = step**2 >= _WHITE * spread**2
    floor = np.array([_median(s[j]) for s, j in zip(spread.T, jitters.T, strict=True)])
    small = (spread <= _SMALL * overall) | (overall <= _ALL_NOISE * floor)
    still = ((width <= 2.01 * resolution) | (jitters & small)).all(axis=1)
    noise = (
        np.sqrt(np.mean(spread[still] ** 2, axis=0)) if still.any() else np.full_like(floor, np.nan)
    )
    return Stillness(float(still.mean()), noise, len(still))


def _windows(stretch: Stretch) -> np.ndarray:
    """Rows in windows without overlap, shape ``(windows, rows, n_obs)``; the rest is left out."""
    length = int(np.clip(round(_SECONDS / stretch.dt), _FEWEST, _MOST))
    n = len(stretch.obs) // length
    return stretch.obs[: n * length].reshape(n, length, stretch.obs.shape[1])


def _median(values: np.ndarray) -> float:
    return float(np.median(values)) if len(values) else 0.0
