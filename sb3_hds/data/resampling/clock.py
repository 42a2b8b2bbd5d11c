"""The clock behind the time stamps of rows: its interval, and how far each stamp is off."""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int

from sb3_hds.core.trajectories.episodes import SAME_RATE

ON_GRID = 0.01  # of an interval: a stamp that is closer than this to a tick is on it
_ROUNDED = 0.75  # of a tick of the logger: farthest that rounding, and the line, move a stamp
_FINEST = 1e-3  # of an interval: finer rounding is not looked for
_SHARED = 0.2  # of the rows: as many have the stamp of the row before where ticks are coarse
_SKIPPED = 2  # rows that may be missing by chance so that a line still fits rounded stamps
_FEW_LATE = 0.02  # of the rows
_BLOCK = 16  # rows in which the phase of the clock is taken as constant
_COHERENT = 0.5  # length of the mean phasor of a block: white jitter of 19 % of an interval
_LINE_BLOCKS, _TREND_BLOCK = 64, 50
_STEADY = 0.1  # of an interval: how far parts of the rows may lie off one line
_CHANCE = 5.0  # ratio of a mean square to what is expected of it
_SIGMAS = 5.0
_LONG, _OFTEN = 5.0, 0.05  # median intervals; share of the intervals that are longer, in bursts
_NOMINAL = 2e-4  # relative error of two crystals that are meant to agree
_ROUND = 0.01  # relative difference of a round number that nothing speaks against
_MAD = 1.4826  # standard deviation by median absolute deviation, of a normal distribution

Kind = Literal["regular", "rounded", "late", "jittered", "irregular"]


class Clock(NamedTuple):
    """
    The clock that paced the rows between two gaps.

    :param kind: ``"regular"``: each stamp is on a tick; ``"rounded"``: but for the digits that the
        logger keeps; ``"late"``: but for a few; ``"jittered"``: but for errors that do not add up;
        ``"irregular"``: there are no ticks
    :param dt: interval [s]
    :param stderr: its standard error [s]
    :param slots: number of the tick of each row, strictly increasing from 0
    :param times: of these ticks, on the clock of the logger; of an irregular clock, the stamps [s]
    :param drift: how much the rate changes, relative
    """

    kind: Kind
    dt: float
    stderr: float
    slots: Int[np.ndarray, " rows"]
    times: Float64[np.ndarray, " rows"]
    drift: float = 0.0

    @property
    def ticks(self) -> bool:
        """Whether rows belong to ticks of one interval."""
        return self.kind != "irregular"


def clock_of(
    stamps: Float64[np.ndarray, " rows"], guess: float, rounding: float, dt: float | None = None
) -> Clock:
    """
    A robust line through all stamps. Rows are counted one by one, or, where the stamps fit better,
    with ticks left out for rows that were dropped; a slow change of the rate, up to 0.1 %, is taken
    out.

    :param stamps: of rows without a gap, never decreasing [s]
    :param guess: interval to within some percent [s]
    :param rounding: what stamps are multiples of, 0 if nothing [s]
    :param dt: the interval, where it is known [s]
    """
    n = len(stamps)
    guess = dt or guess
    if n < 3:
        own = dt or (float(stamps[-1] - stamps[0]) / (n - 1) if n > 1 else guess)
        return Clock("regular", own, np.inf, np.arange(n), stamps.copy())
    line = _line(np.arange(n), stamps, guess, rounding, dt is not None)
    if rounding < 1.5 * guess and (slots := _slots(stamps, guess)) is not None:
        skipping = _line(slots, stamps, guess, rounding, dt is not None)
        # Ticks of the logger that rows leave out regularly are those of another clock.
        often = slots[-1] - n + 1 > _SKIPPED and _kind(line, rounding) == "rounded"
        if not often and np.abs(skipping.off).mean() < np.abs(line.off).mean():
            line = skipping
    drift = 0.0
    if not _holds(line, rounding):
        found = _trend(line) if dt is None else None
        if found is None:
            intervals = np.diff(stamps)
            middle = float(np.median(intervals[intervals > 0.0]))
            return Clock("irregular", middle, np.inf, np.arange(n), stamps.copy())
        trend, drift = found
        line = line._replace(off=line.off - trend)
    kind = _kind(line, rounding)
    return Clock(kind, line.dt, line.stderr, line.slots, stamps - line.off, drift)


def late_rows(clock: Clock, stamps: np.ndarray, rounding: float) -> Bool[np.ndarray, " rows"]:
    """:return: which stamps are off their ticks by more than rounding explains"""
    return np.abs(stamps - clock.times) > _tolerance(clock.dt, rounding)


def rounding_of(stamps: Float64[np.ndarray, " rows"], interval: float) -> float:
    """
    :param interval: between rows, roughly [s]
    :return: what all stamps are multiples of, if it is a decimal, or all that single precision can
        tell [s]; 0 where that is nothing, or too fine to matter
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
    :return: mean interval, gaps and the most uneven ones apart [s]
    """
    different, counts = np.unique(stamps, return_counts=True)
    between = np.diff(different)
    middle = float(np.median(between))
    long = float((between > _LONG * middle).mean())
    if long > _OFTEN:
        # Rows arrive in bursts: what separates two bursts is no gap.
        lag = min(round(10.0 / long), len(stamps) - 1)
        return float(np.median(stamps[lag:] - stamps[:-lag])) / lag
    usual = np.abs(between - middle) <= 0.5 * middle
    if not usual.any():
        return middle
    rows = counts[:-1] if shares_stamps(stamps) else np.ones(len(between))
    return float(between[usual].sum() / rows[usual].sum())


def shares_stamps(stamps: Float64[np.ndarray, " rows"]) -> bool:
    """Whether the ticks of the logger are so coarse that several rows have the same stamp."""
    return bool((np.diff(stamps) == 0.0).mean() > _SHARED)


def common_interval(clocks: Sequence[Clock]) -> float | None:
    """
    A round number, or a whole number of hertz, where the stamps cannot tell the difference.

    :return: interval of the clocks that tick, if most rows belong to these [s]
    """
    ticking = [clock for clock in clocks if clock.ticks and len(clock.slots) > 1]
    rows = np.array([len(clock.slots) for clock in ticking])
    if rows.sum() <= 0.5 * sum(len(clock.slots) for clock in clocks):
        return None
    own = np.array([clock.dt for clock in ticking])
    order = np.argsort(own)
    middle = own[order][np.searchsorted(rows[order].cumsum(), 0.5 * rows.sum())]
    alike = np.abs(own - middle) <= SAME_RATE * middle
    # The accuracy of their common interval comes from all of them together.
    sure = np.array([c.stderr if np.isfinite(c.stderr) else SAME_RATE * c.dt for c in ticking])
    weights = 1.0 / np.maximum(sure[alike], 1e-9 * middle) ** 2
    mean = float(weights @ own[alike] / weights.sum())
    apart = min(max(_NOMINAL * mean, float(np.ptp(own[alike]))), SAME_RATE * mean)
    unsure = min(3.0 * float(weights.sum() ** -0.5), _ROUND * mean)
    return _nominal(mean, max(apart, unsure))


def round_number(interval: float) -> float:
    """:return: the number with the fewest digits that is within 1 %"""
    for digits in range(3):
        close = float(f"{interval:.{digits}e}")
        if abs(close - interval) <= _ROUND * interval:
            return close
    return interval


class _Line(NamedTuple):
    slots: np.ndarray
    dt: float
    stderr: float
    off: np.ndarray  # of the stamps [s]


def _line(
    slots: np.ndarray, stamps: np.ndarray, guess: float, rounding: float, known: bool
) -> _Line:
    """Median of the slopes between blocks, then least squares without what is far off."""
    over = stamps - stamps[0] - guess * slots
    slope = 0.0
    if not known:
        blocks = np.array_split(np.arange(len(slots)), min(len(slots), _LINE_BLOCKS))
        at = np.array([slots[block].mean() for block in blocks])
        height = np.array([np.median(over[block]) for block in blocks])
        i, j = np.triu_indices(len(blocks), 1)
        slope = float(np.median((height[j] - height[i]) / (at[j] - at[i])))
    off = over - slope * slots
    off -= np.median(off)
    scatter = 3.0 * _MAD * float(np.median(np.abs(off)))
    near = np.abs(off) <= max(scatter, 2.0 * _ROUNDED * rounding, 1e-6 * guess)
    x = slots[near] - slots[near].mean()
    wide = float(x @ x)
    if not known and wide > 0.0:
        slope += float(x @ off[near]) / wide
    off = over - slope * slots
    off -= off[near].mean()
    sigma = float(np.sqrt(np.mean(off[near] ** 2)))
    stderr = 0.0 if known else sigma / np.sqrt(wide) if wide > 0.0 else np.inf
    return _Line(slots, guess + slope, float(stderr), off)


def _holds(line: _Line, rounding: float) -> bool:
    """Whether one line describes all parts of the rows: jitter does not add up."""
    blocks = np.array_split(line.off, max(1, min(16, len(line.off) // _BLOCK)))
    level = np.array([np.median(block) for block in blocks])
    if np.abs(level).max() <= max(_STEADY * line.dt, _ROUNDED * rounding):
        return True
    return bool(np.mean(level**2) <= _CHANCE * _of_median(blocks))


def _of_median(blocks: Sequence[np.ndarray]) -> float:
    """Variance of the median of a block whose errors are independent and normal."""
    within = [_MAD * float(np.median(np.abs(block - np.median(block)))) for block in blocks]
    return 0.5 * np.pi * float(np.median(within)) ** 2 / len(blocks[0])


def _trend(line: _Line) -> tuple[np.ndarray, float] | None:
    """:return: slow part of the deviations, and its change of rate; None if it is not slow"""
    n = len(line.slots)
    if n < 2 * _TREND_BLOCK:
        return None
    blocks = np.array_split(np.arange(n), n // _TREND_BLOCK)
    at = np.array([line.slots[block].mean() for block in blocks])
    level = np.array([np.median(line.off[block]) for block in blocks])
    fast = np.maximum(np.abs(np.diff(level)) - SAME_RATE * line.dt * np.diff(at), 0.0)
    if np.mean(fast**2) > 2.0 * _CHANCE * _of_median([line.off[block] for block in blocks]):
        return None
    # Straight on beyond the middles of the outermost blocks.
    ends = line.slots[[0, -1]]
    slopes = np.diff(level)[[0, -1]] / np.diff(at)[[0, -1]]
    outer = level[[0, -1]] + slopes * (ends - at[[0, -1]])
    trend = np.interp(
        line.slots,
        np.concatenate([ends[:1], at, ends[1:]]),
        np.concatenate([outer[:1], level, outer[1:]]),
    )
    parts = np.array_split(np.arange(len(blocks)), min(8, len(blocks)))
    middle = np.array([level[p].mean() for p in parts])
    rates = np.diff(middle) / np.diff(np.array([at[p].mean() for p in parts])) / line.dt
    return trend, float(np.ptp(rates)) if len(rates) > 1 else 0.0


def _slots(stamps: np.ndarray, guess: float) -> np.ndarray | None:
    """
    Ticks by the phase of the clock, which does not depend on how many rows were dropped.

    :return: strictly increasing from 0; None if stamps have no common phase
    """
    x = (stamps - stamps[0]) / guess
    blocks = np.array_split(np.arange(len(x)), max(1, len(x) // _BLOCK))
    phasors = np.array([np.exp(2j * np.pi * x[block]).mean() for block in blocks])
    if np.median(np.abs(phasors)) < _COHERENT:
        return None
    at = np.array([x[block].mean() for block in blocks])
    phase = np.interp(x, at, np.unwrap(np.angle(phasors)) / (2.0 * np.pi))
    nearest = np.round(x - phase)
    skipped = _never_decreasing(nearest - np.arange(len(x)))
    off = np.abs(x - phase - np.arange(len(x)) - skipped)
    _undo_ends(skipped, off)
    _undo_ends(skipped[::-1], off[::-1])
    return (np.arange(len(x)) + skipped - skipped[0]).astype(int)


def _undo_ends(skipped: np.ndarray, off: np.ndarray) -> None:
    """A row at the end, off the ticks that would be its own: it is late, and none was dropped."""
    usual = max(_STEADY, _SIGMAS * float(np.median(off)))
    for rows in (1, 2):
        step = len(skipped) > 2 * rows and skipped[-rows] != skipped[-rows - 1]
        if step and (off[-rows:] > usual).all():
            skipped[-rows:] = skipped[-rows - 1]


def _never_decreasing(values: np.ndarray) -> np.ndarray:
    """The closest such sequence (L1): pools adjacent violators by their median."""
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


def _nominal(interval: float, far: float) -> float:
    """The simplest interval that is not farther than this; otherwise the interval itself."""
    hertz = 1.0 / interval
    simple = [float(f"{interval:.0e}"), *([1.0 / round(hertz)] if 0.5 < hertz < 1000.5 else [])]
    simple += [float(f"{interval:.{digits}e}") for digits in (1, 2)]
    return next((value for value in simple if abs(value - interval) <= far), interval)
