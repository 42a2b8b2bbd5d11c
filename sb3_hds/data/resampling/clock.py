"""Identification of the clock that paced the rows, from their time stamps."""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int

from sb3_hds.core.trajectories.episodes import SAME_RATE

ON_GRID = 0.01  # of an interval: a stamp closer than this to a tick is on it
_ROUNDED = 0.75  # of the resolution of stamps: largest error due to rounding and the fitted line
_FINEST = 1e-3  # of an interval: finer rounding is ignored
_SHARED = 0.2  # of the rows: so many repeat the previous stamp if stamps are coarse
_SKIPPED = 2  # missing rows with which a line through consecutive rows may still fit by chance
_FEW_LATE = 0.02  # of the rows
_BLOCK = 16  # rows over which the phase of the clock is assumed constant
_COHERENT = 0.5  # length of the mean phasor of a block under white jitter of 19 % of an interval
_LINE_BLOCKS, _TREND_BLOCK = 64, 50
_STEADY = 0.1  # of an interval: largest deviation of a block of rows from one line
_CHANCE = 5.0  # largest ratio of a mean square to its expected value
_SIGMAS = 5.0
_LONG, _OFTEN = 5.0, 0.05  # median intervals; share of longer intervals if rows come in bursts
_CRYSTAL_ERROR = 2e-4  # relative difference of two crystals with the same nominal frequency
_ROUND_NUMBER = 0.01  # relative distance within which a round number is preferred
_MAD = 1.4826  # standard deviation over median absolute deviation of a normal distribution

Kind = Literal["regular", "rounded", "late", "jittered", "irregular"]


class Clock(NamedTuple):
    """
    The clock that paced the rows between two gaps.

    :param kind: ``"regular"``: each stamp is on a tick; ``"rounded"``: except for rounding;
        ``"late"``: except for a few stamps; ``"jittered"``: except for errors that do not
        accumulate; ``"irregular"``: there are no ticks
    :param dt: interval [s]
    :param stderr: its standard error [s]
    :param ticks: number of the tick of each row, strictly increasing from 0
    :param times: of these ticks in the logger's time; the stamps if the clock is irregular [s]
    :param drift: relative change of the rate
    """

    kind: Kind
    dt: float
    stderr: float
    ticks: Int[np.ndarray, " rows"]
    times: Float64[np.ndarray, " rows"]
    drift: float = 0.0

    @property
    def periodic(self) -> bool:
        """Whether rows belong to ticks of a constant interval."""
        return self.kind != "irregular"


def clock_of(
    stamps: Float64[np.ndarray, " rows"], guess: float, rounding: float, dt: float | None = None
) -> Clock:
    """
    Fit a robust line through all stamps. Rows are on consecutive ticks, or, if that fits better,
    some ticks lack a row that was dropped. A slow change of the rate, up to 0.1 %, is removed.

    :param stamps: of rows without a gap, never decreasing [s]
    :param guess: interval to within a few per cent [s]
    :param rounding: resolution of the stamps; 0 if they are not rounded [s]
    :param dt: the interval, if it is known [s]
    """
    n = len(stamps)
    guess = dt or guess
    if n < 3:
        own = dt or (float(stamps[-1] - stamps[0]) / (n - 1) if n > 1 else guess)
        return Clock("regular", own, np.inf, np.arange(n), stamps.copy())
    line = _line(np.arange(n), stamps, guess, rounding, dt is not None)
    if rounding < 1.5 * guess and (ticks := _ticks_by_phase(stamps, guess)) is not None:
        skipping = _line(ticks, stamps, guess, rounding, dt is not None)
        # With many ticks without a row, these are the ticks of the logger rather than the clock.
        often = ticks[-1] - n + 1 > _SKIPPED and _kind(line, rounding) == "rounded"
        if not often and np.abs(skipping.off).mean() < np.abs(line.off).mean():
            line = skipping
    drift = 0.0
    if not _fits_line(line, rounding):
        found = _trend(line) if dt is None else None
        if found is None:
            intervals = np.diff(stamps)
            median = float(np.median(intervals[intervals > 0.0]))
            return Clock("irregular", median, np.inf, np.arange(n), stamps.copy())
        trend, drift = found
        line = line._replace(off=line.off - trend)
    kind = _kind(line, rounding)
    return Clock(kind, line.dt, line.stderr, line.ticks, stamps - line.off, drift)


def late_rows(clock: Clock, stamps: np.ndarray, rounding: float) -> Bool[np.ndarray, " rows"]:
    """:return: which stamps deviate from their ticks by more than rounding explains"""
    return np.abs(stamps - clock.times) > _tolerance(clock.dt, rounding)


def rounding_of(stamps: Float64[np.ndarray, " rows"], interval: float) -> float:
    """
    :param interval: approximate interval between rows [s]
    :return: decimal of which all stamps are multiples, or the resolution of single precision [s];
        0 if there is none, or if it is too fine to matter
    """
    largest = float(np.abs(stamps).max())
    error = 4.0 * np.spacing(largest)
    for digits in range(10):
        step = 10.0**-digits
        if step < 5.0 * error:
            break
        whole = np.round(stamps / step)
        if np.abs(stamps / step - whole).max() <= max(1e-3, error / step):
            between = np.diff(whole).astype(np.int64)
            common = step * int(np.gcd.reduce(between)) if between.any() else step
            return common if common > _FINEST * interval else 0.0
    single = float(np.spacing(np.float32(largest)))
    coarse = single > _FINEST * interval and np.array_equal(stamps, stamps.astype(np.float32))
    return single if coarse else 0.0


def typical_interval(stamps: Float64[np.ndarray, " rows"]) -> float:
    """
    :param stamps: of at least two rows, not all the same [s]
    :return: mean interval without gaps and outliers [s]
    """
    different, counts = np.unique(stamps, return_counts=True)
    between = np.diff(different)
    median = float(np.median(between))
    long = float((between > _LONG * median).mean())
    if long > _OFTEN:
        # Rows arrive in bursts: the time between two bursts is not a gap.
        lag = min(round(10.0 / long), len(stamps) - 1)
        return float(np.median(stamps[lag:] - stamps[:-lag])) / lag
    typical = np.abs(between - median) <= 0.5 * median
    if not typical.any():
        return median
    rows = counts[:-1] if shares_stamps(stamps) else np.ones(len(between))
    return float(between[typical].sum() / rows[typical].sum())


def shares_stamps(stamps: Float64[np.ndarray, " rows"]) -> bool:
    """Whether stamps are so coarse that several rows share one."""
    return bool((np.diff(stamps) == 0.0).mean() > _SHARED)


def common_interval(clocks: Sequence[Clock]) -> float | None:
    """
    The interval of the periodic clocks; a round number, or a whole number of hertz, if the stamps
    are consistent with it.

    :return: None unless most rows belong to periodic clocks [s]
    """
    periodic = [clock for clock in clocks if clock.periodic and len(clock.ticks) > 1]
    rows = np.array([len(clock.ticks) for clock in periodic])
    if rows.sum() <= 0.5 * sum(len(clock.ticks) for clock in clocks):
        return None
    own = np.array([clock.dt for clock in periodic])
    order = np.argsort(own)
    median = own[order][np.searchsorted(rows[order].cumsum(), 0.5 * rows.sum())]
    alike = np.abs(own - median) <= SAME_RATE * median
    # Inverse-variance weighted mean.
    stderr = np.array([c.stderr if np.isfinite(c.stderr) else SAME_RATE * c.dt for c in periodic])
    weights = 1.0 / np.maximum(stderr[alike], 1e-9 * median) ** 2
    mean = float(weights @ own[alike] / weights.sum())
    scatter = min(max(_CRYSTAL_ERROR * mean, float(np.ptp(own[alike]))), SAME_RATE * mean)
    uncertainty = min(3.0 * float(weights.sum() ** -0.5), _ROUND_NUMBER * mean)
    return _nominal_interval(mean, max(scatter, uncertainty))


def round_number(interval: float) -> float:
    """:return: the number with the fewest digits within 1 %"""
    for digits in range(3):
        close = float(f"{interval:.{digits}e}")
        if abs(close - interval) <= _ROUND_NUMBER * interval:
            return close
    return interval


class _Line(NamedTuple):
    ticks: np.ndarray
    dt: float
    stderr: float
    off: np.ndarray  # of the stamps [s]


def _line(
    ticks: np.ndarray, stamps: np.ndarray, guess: float, rounding: float, known: bool
) -> _Line:
    """Median of the slopes between blocks, then least squares without outliers."""
    residual = stamps - stamps[0] - guess * ticks
    slope = 0.0
    if not known:
        blocks = np.array_split(np.arange(len(ticks)), min(len(ticks), _LINE_BLOCKS))
        at = np.array([ticks[block].mean() for block in blocks])
        height = np.array([np.median(residual[block]) for block in blocks])
        i, j = np.triu_indices(len(blocks), 1)
        slope = float(np.median((height[j] - height[i]) / (at[j] - at[i])))
    off = residual - slope * ticks
    off -= np.median(off)
    scatter = 3.0 * _MAD * float(np.median(np.abs(off)))
    near = np.abs(off) <= max(scatter, 2.0 * _ROUNDED * rounding, 1e-6 * guess)
    x = ticks[near] - ticks[near].mean()
    sum_of_squares = float(x @ x)
    if not known and sum_of_squares > 0.0:
        slope += float(x @ off[near]) / sum_of_squares
    off = residual - slope * ticks
    off -= off[near].mean()
    sigma = float(np.sqrt(np.mean(off[near] ** 2)))
    stderr = 0.0 if known else sigma / np.sqrt(sum_of_squares) if sum_of_squares > 0.0 else np.inf
    return _Line(ticks, guess + slope, float(stderr), off)


def _fits_line(line: _Line, rounding: float) -> bool:
    """Whether one line fits all blocks of rows: jitter does not accumulate."""
    blocks = np.array_split(line.off, max(1, min(16, len(line.off) // _BLOCK)))
    level = np.array([np.median(block) for block in blocks])
    if np.abs(level).max() <= max(_STEADY * line.dt, _ROUNDED * rounding):
        return True
    return bool(np.mean(level**2) <= _CHANCE * _median_variance(blocks))


def _median_variance(blocks: Sequence[np.ndarray]) -> float:
    """Variance of the median of a block with independent normal errors."""
    within = [_MAD * float(np.median(np.abs(block - np.median(block)))) for block in blocks]
    return 0.5 * np.pi * float(np.median(within)) ** 2 / len(blocks[0])


def _trend(line: _Line) -> tuple[np.ndarray, float] | None:
    """:return: slow part of the deviations and its relative change of rate; None if not slow"""
    n = len(line.ticks)
    if n < 2 * _TREND_BLOCK:
        return None
    blocks = np.array_split(np.arange(n), n // _TREND_BLOCK)
    at = np.array([line.ticks[block].mean() for block in blocks])
    level = np.array([np.median(line.off[block]) for block in blocks])
    fast = np.maximum(np.abs(np.diff(level)) - SAME_RATE * line.dt * np.diff(at), 0.0)
    if np.mean(fast**2) > 2.0 * _CHANCE * _median_variance([line.off[block] for block in blocks]):
        return None
    # Extrapolate linearly beyond the middles of the outermost blocks.
    ends = line.ticks[[0, -1]]
    slopes = np.diff(level)[[0, -1]] / np.diff(at)[[0, -1]]
    outer = level[[0, -1]] + slopes * (ends - at[[0, -1]])
    trend = np.interp(
        line.ticks,
        np.concatenate([ends[:1], at, ends[1:]]),
        np.concatenate([outer[:1], level, outer[1:]]),
    )
    parts = np.array_split(np.arange(len(blocks)), min(8, len(blocks)))
    mean = np.array([level[p].mean() for p in parts])
    rates = np.diff(mean) / np.diff(np.array([at[p].mean() for p in parts])) / line.dt
    return trend, float(np.ptp(rates)) if len(rates) > 1 else 0.0


def _ticks_by_phase(stamps: np.ndarray, guess: float) -> np.ndarray | None:
    """
    Tick numbers from the phase of the clock, which dropped rows do not affect.

    :return: strictly increasing from 0; None if the phase is not coherent
    """
    x = (stamps - stamps[0]) / guess
    blocks = np.array_split(np.arange(len(x)), max(1, len(x) // _BLOCK))
    phasors = np.array([np.exp(2j * np.pi * x[block]).mean() for block in blocks])
    if np.median(np.abs(phasors)) < _COHERENT:
        return None
    at = np.array([x[block].mean() for block in blocks])
    phase = np.interp(x, at, np.unwrap(np.angle(phasors)) / (2.0 * np.pi))
    nearest = np.round(x - phase)
    skipped = _non_decreasing(nearest - np.arange(len(x)))
    off = np.abs(x - phase - np.arange(len(x)) - skipped)
    _keep_ends(skipped, off)
    _keep_ends(skipped[::-1], off[::-1])
    return (np.arange(len(x)) + skipped - skipped[0]).astype(int)


def _keep_ends(skipped: np.ndarray, off: np.ndarray) -> None:
    """A last row far from its tick is late; no row before it was dropped."""
    typical = max(_STEADY, _SIGMAS * float(np.median(off)))
    for rows in (1, 2):
        step = len(skipped) > 2 * rows and skipped[-rows] != skipped[-rows - 1]
        if step and (off[-rows:] > typical).all():
            skipped[-rows:] = skipped[-rows - 1]


def _non_decreasing(values: np.ndarray) -> np.ndarray:
    """Isotonic L1 regression: pool adjacent violators by their median."""
    pools: list[list[float]] = []
    for value in values.tolist():
        pools.append([value])
        while len(pools) > 1 and _lower_median(pools[-2]) > _lower_median(pools[-1]):
            last = pools.pop()
            pools[-1] = sorted(pools[-1] + last)
    return np.array([_lower_median(pool) for pool in pools for _ in pool])


def _lower_median(ordered: list[float]) -> float:
    return ordered[(len(ordered) - 1) // 2]


def _kind(line: _Line, rounding: float) -> Kind:
    off = np.abs(line.off)
    if off.max() <= ON_GRID * line.dt:
        return "regular"
    wrong = int((off > _tolerance(line.dt, rounding)).sum())
    if not wrong:
        return "rounded"
    return "late" if wrong <= max(1.0, _FEW_LATE * len(off)) else "jittered"


def _tolerance(dt: float, rounding: float) -> float:
    return max(ON_GRID * dt, _ROUNDED * rounding)


def _nominal_interval(interval: float, far: float) -> float:
    """The simplest interval within a distance ``far``; otherwise the interval itself."""
    hertz = 1.0 / interval
    simple = [float(f"{interval:.0e}"), *([1.0 / round(hertz)] if 0.5 < hertz < 1000.5 else [])]
    simple += [float(f"{interval:.{digits}e}") for digits in (1, 2)]
    return next((value for value in simple if abs(value - interval) <= far), interval)
