"""Checks of time stamps, partly against the values: duplicates, resolution, true stamps."""

import numpy as np
from jaxtyping import Bool

from sb3_hds.data.resampling.clock import Clock, shares_stamps
from sb3_hds.data.resampling.rows import Rows
from sb3_hds.data.resampling.values import runs, unwrapped
from sb3_hds.errors import TrajectoryError

_NEIGHBOURS = 5  # rows around a repeated stamp that decide whether a row is duplicated
_EQUAL = 1e-6  # of an interval: closer stamps are equal
_TWICE, _ONCE = 0.9, 0.5  # share of equal rows with equal stamps, and with different ones
_FEWEST_STAMPS = 30  # for an interval to 0.1 %, if several rows share each
_FOURTH = np.array([1.0, -4.0, 6.0, -4.0, 1.0])  # fourth differences, small for smooth motion
_SMOOTH = np.ones(5) / 5.0
_SIGMAS = 4.0


def check_resolution(rows: Rows) -> None:
    """
    :param rows: of one episode, without duplicates
    :raises TrajectoryError: if stamps are too coarse to determine an interval
    """
    different = np.unique(rows.times)
    coarse = len(different) == 1 or (shares_stamps(rows.times) and len(different) < _FEWEST_STAMPS)
    if len(rows.times) < 2 or not coarse:
        return
    largest = float(np.abs(rows.times).max())
    single = float(np.spacing(np.float32(largest)))
    apart = float(np.median(np.diff(different))) if len(different) > 1 else 0.0
    stored_short = len(different) == 1 or np.isclose(apart % single, 0.0, atol=1e-6 * single)
    why = ""
    if single > 1e-3 and stored_short and np.array_equal(rows.times, np.float32(rows.times)):
        why = (
            f"In single precision (float32), numbers around {largest:.4g} are {single:g} apart: "
            "store stamps as float64, or subtract the first one before storing. "
        )
    raise TrajectoryError(
        f"The time stamps of '{rows.source}' are too coarse: {len(rows.times)} rows share "
        f"{len(different)} of them, which does not determine an interval. {why}Or remove 'time' "
        "from columns and give the interval: dt: SECONDS."
    )


def duplicated(rows: Rows, interval: float) -> Bool[np.ndarray, " rows"]:
    """
    Duplicated rows, which repeat the stamp of the previous row.

    If few stamps repeat, a row is a duplicate if the stamps after it are one interval behind the
    count of rows. If many do, all of them are duplicates if their values repeat as well; otherwise
    none is, and stamps are coarser than the interval.

    :param rows: of one episode
    :param interval: typical interval [s]
    """
    waits = np.diff(rows.times)
    repeats_stamp = np.concatenate([[False], (waits == 0.0) | (waits <= _EQUAL * interval)])
    if not repeats_stamp.any():
        return repeats_stamp
    if shares_stamps(rows.times):
        same = np.concatenate([[False], (rows.obs[1:] == rows.obs[:-1]).all(1)])
        elsewhere = same[1:][~repeats_stamp[1:]]
        copied = same[repeats_stamp].mean() > _TWICE and elsewhere.sum() < _ONCE * len(elsewhere)
        return repeats_stamp if copied else np.zeros_like(repeats_stamp)
    ahead = rows.times / interval - np.arange(len(repeats_stamp))
    found = np.zeros_like(repeats_stamp)
    for first, end in runs(repeats_stamp):
        before, after = ahead[max(first - _NEIGHBOURS, 0) : first], ahead[end : end + _NEIGHBOURS]
        behind = np.median(before) - np.median(after) if len(after) else end - first
        found[end - int(np.clip(np.round(behind), 0, end - first)) : end] = True
    return found


def values_follow_stamps(rows: Rows, clock: Clock) -> bool:
    """
    Whether rows were measured at their stamps rather than at the ticks of their clock.

    If row k was measured a time d after its tick, its value differs by v d from the value at the
    tick, so the values at the ticks are not smooth. Therefore, fourth differences of the values are
    regressed on those of v d: the slope is 1 if the stamps are right, and 0 if the ticks are. If
    noise hides the difference, it does not matter, and the answer is no.

    :param rows: some of whose stamps deviate from their ticks
    :param clock: of these rows
    """
    off = (rows.times - clock.times) / clock.dt
    usable = np.zeros(max(len(off) - 4, 0), bool)
    if len(off) > 4:
        usable = clock.ticks[4:] - clock.ticks[:-4] == 4
    products, squares, errors = 0.0, 0.0, []
    for column in rows.obs.T if usable.any() else []:
        x = unwrapped(column)
        rate = np.convolve(
            np.gradient(np.pad(x, 2, "reflect", reflect_type="odd")), _SMOOTH, "valid"
        )
        rough, late = (np.convolve(y, _FOURTH, "valid")[usable] for y in (x, rate * off))
        size = float(np.mean(rough**2))
        if size > 0.0:
            products += float(late @ rough) / size
            squares += float(late @ late) / size
            errors.append((rough / np.sqrt(size), late / np.sqrt(size)))
    if squares == 0.0:
        return False
    slope = products / squares
    left = np.concatenate([rough - slope * late for rough, late in errors])
    stderr = float(np.sqrt(np.mean(left**2) / squares))
    return bool(slope > max(0.5, _SIGMAS * stderr))
