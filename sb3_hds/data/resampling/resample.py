"""Resampling of rows with time stamps to one constant interval, with a report of the changes."""

import dataclasses
import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sb3_hds.core.trajectories import Trajectories
from sb3_hds.core.trajectories.episodes import same_interval
from sb3_hds.data.columns import Columns
from sb3_hds.data.resampling.clock import (
    ON_GRID,
    Clock,
    clock_of,
    common_interval,
    late_rows,
    round_number,
    rounding_of,
    typical_interval,
)
from sb3_hds.data.resampling.report import Part, Reading, Sampling
from sb3_hds.data.resampling.rows import Rows
from sb3_hds.data.resampling.stamps import check_resolution, duplicated, values_follow_stamps
from sb3_hds.data.resampling.values import angle_wraps, resolutions
from sb3_hds.errors import TrajectoryError

_UNEVEN = 0.1  # of the median interval
_GAP = 5.0  # intervals
_LARGEST_STEP = 0.2  # largest typical step at which wraps are recognised [rad]
_NEAR_ENDS = 6.0  # typical steps: largest distance from the ends of its range at which it wraps
_AS_GOOD = 1.05  # ratio of mean deviations up to which two clocks fit stamps equally well
_SIGMAS = 3.0  # standard errors by which an interval may differ from the common one
_MAX_STEPS_BETWEEN_ROWS = 10.0  # more steps cannot be interpolated between two measurements


def resample(episodes: Sequence[Rows], columns: Columns, notes: Sequence[str] = ()) -> Trajectories:
    """
    Identify the clock of each episode, drop duplicated rows, cut at gaps, and resample rows of
    irregular clocks or of clocks with another rate.

    Rows of a regular clock are kept, even if their stamps are rounded, late or jittered. If values
    agree with late or jittered stamps rather than with the ticks, these rows are interpolated.
    Commands are held until the next row; a step uses their mean over its duration, which preserves
    the impulse.

    :param episodes: at least one
    :param columns: for ``dt``, ``gap``, names, units, and which channels are angles
    :param notes: for the report
    :return: the samples, with a report of what was changed
    :raises TrajectoryError: if no part is as long as one step, if stamps are too coarse to
        determine an interval, or if steps are far shorter than the intervals of the log
    """
    splits = [_split(rows, columns.gap) for rows in episodes]
    clocks = [clock for split in splits for clock in split.clocks]
    dt = columns.dt or _choose_interval(clocks)
    _check_interval(dt, clocks)
    obs, actions = columns.obs or (), columns.actions or ()
    angles = [i for i, entry in enumerate(obs) if entry.angle]
    samplings: list[Sampling] = []
    found: list[tuple[int, _Samples]] = []
    for number, (rows, split) in enumerate(zip(episodes, splits, strict=True)):
        pieces = [
            _samples_of(part, clock, split.rounding, dt, angles)
            for part, clock in zip(split.parts, split.clocks, strict=True)
        ]
        samplings.append(_sampling_of(rows, split, pieces))
        found += [(number, piece) for piece in pieces if piece is not None]
    if not found:
        raise TrajectoryError(
            f"No episode lasts one step of {dt:g} s: the longest has "
            f"{max(len(rows.times) for rows in episodes)} rows. Choose a smaller dt or a longer "
            "gap."
        )
    report = Reading(
        dt=dt,
        obs=tuple(entry.name for entry in obs),
        actions=tuple(entry.name for entry in actions),
        resolution=tuple(resolutions([piece.rows.obs for _, piece in found]).tolist()),
        recordings=tuple(samplings),
        parts=tuple(Part(i, piece.rows, piece.begin, len(piece.actions)) for i, piece in found),
        units=tuple(entry.si_unit for entry in obs),
        action_units=tuple(entry.si_unit for entry in actions),
        notes=tuple(notes),
    )
    data = Trajectories.from_arrays(
        [piece.obs for _, piece in found],
        [piece.actions for _, piece in found],
        dt=dt,
        conditions=[piece.rows.condition for _, piece in found],
    )
    return dataclasses.replace(data, origin=np.array([i for i, _ in found]), report=report)


class _Split(NamedTuple):
    """
    The rows of an episode between its gaps.

    :param rounding: of the stamps [s]
    :param repeated: duplicated rows, which are dropped
    :param gaps: row after each gap, and its length [s]
    """

    parts: list[Rows]
    clocks: list[Clock]
    rounding: float
    repeated: np.ndarray
    gaps: tuple[tuple[int, float], ...]


class _Samples(NamedTuple):
    """
    The samples of rows without a gap.

    :param begin: time of the first sample, on the clock of the rows [s]
    :param rows: with times consistent with the samples
    :param kept: whether the samples are the measured rows
    :param missing: row before which rows are missing, and how many; these were interpolated
    :param moved: longest time from a sample to the closest row [s]
    :param error: difference of the rows from the samples interpolated back to them
    :param off: distance of the stamps from their ticks [s]
    :param late: which stamps deviate by more than rounding explains
    """

    begin: float
    obs: np.ndarray
    actions: np.ndarray
    rows: Rows
    clock: Clock
    kept: bool
    missing: tuple[tuple[int, int], ...]
    moved: float
    error: np.ndarray
    off: np.ndarray = np.zeros(0)
    late: np.ndarray = np.zeros(0, bool)


def _split(rows: Rows, gap: float | None) -> _Split:
    """Drop duplicated rows, split the others at gaps, and identify the clock of each part."""
    times = rows.times
    if len(times) < 2:
        return _Split([rows], [clock_of(times, math.nan, 0.0)], 0.0, np.zeros(0, int), ())
    interval = typical_interval(times) if times[-1] > times[0] else math.nan
    repeated = duplicated(rows, interval)
    kept = rows.part(~repeated)
    check_resolution(kept)
    if repeated.any():
        interval = typical_interval(kept.times)
    rounding = rounding_of(kept.times, interval)
    ends = _gaps(kept.times, interval, rounding, gap)
    bounds = [0, *ends, len(kept.times)]
    parts = [kept.part(slice(a, b)) for a, b in itertools.pairwise(bounds)]
    clocks = [clock_of(part.times, interval, rounding) for part in parts]
    waits = np.diff(kept.times)
    gaps = tuple((int(kept.numbers[i]), float(waits[i - 1])) for i in ends)
    return _Split(parts, clocks, rounding, np.flatnonzero(repeated), gaps)


def _gaps(times: np.ndarray, interval: float, rounding: float, gap: float | None) -> list[int]:
    """
    The rows after a gap. Rows that arrive late in a burst and catch up with the clock were
    buffered: there is no gap.
    """
    waits = np.diff(times)
    ends = np.flatnonzero(waits > (gap or _GAP * interval + rounding)) + 1
    if gap:
        return ends.tolist()
    return [k for k in ends.tolist() if not _catches_up(times[k - 1 :] / interval)]


def _catches_up(x: np.ndarray) -> bool:
    """:param x: stamps, from the row before a long wait on [intervals]"""
    behind = x - x[0] - np.arange(len(x))
    return bool((behind[1 : 2 + 2 * math.ceil(behind[1])] < 1.0).any())


def _choose_interval(clocks: Sequence[Clock]) -> float:
    """The common interval of the clocks, or else a round number near the median interval."""
    several = [clock for clock in clocks if len(clock.ticks) > 1]
    if not several:
        raise TrajectoryError("Each episode of the log has a single row, so there are no steps.")
    dt = common_interval(several)
    if dt is not None:
        return dt
    waits = np.concatenate([np.diff(clock.times) for clock in several])
    return round_number(float(np.median(waits[waits > 0.0])))


def _check_interval(dt: float, clocks: Sequence[Clock]) -> None:
    """:raises TrajectoryError: for an interval far below that of the log, as from other units"""
    rows = [len(clock.ticks) if len(clock.ticks) > 1 else 0 for clock in clocks]
    own = np.repeat([clock.dt for clock in clocks], rows)
    median = float(np.median(own)) if len(own) else dt
    if median > _MAX_STEPS_BETWEEN_ROWS * dt:
        raise TrajectoryError(
            f"Rows are {median:.4g} s apart, and dt is {dt:.4g} s: there would be "
            f"{median / dt:.0f} steps between two measurements. If time stamps are not in seconds, "
            "declare it: 'time: {column: NAME, scale: 0.001}'."
        )


def _reconciled(clock: Clock, part: Rows, rounding: float, dt: float) -> Clock:
    """The clock with the common interval, if the stamps are consistent with it."""
    if clock.periodic and abs(clock.dt - dt) <= 1e-9 * dt:
        return clock
    common = clock_of(part.times, dt, rounding, dt)
    if common.kind in ("regular", "rounded"):
        return common
    own, other = (float(np.abs(part.times - one.times).mean()) for one in (clock, common))
    near = abs(clock.dt - dt) <= _SIGMAS * clock.stderr or other <= _AS_GOOD * own
    return common if clock.periodic and common.periodic and near else clock


def _samples_of(
    part: Rows, clock: Clock, rounding: float, dt: float, angles: Sequence[int]
) -> _Samples | None:
    """None if the rows are shorter than one step."""
    if len(part.times) < 2:
        return None
    clock = _reconciled(clock, part, rounding, dt)
    off, late = part.times - clock.times, late_rows(clock, part.times, rounding)
    follows = clock.kind in ("late", "jittered") and values_follow_stamps(part, clock)
    if not (clock.periodic and same_interval(clock.dt, dt)):
        measured = part if follows or not clock.periodic else part._replace(times=clock.times)
        piece = _resampled(measured, clock, dt, None, angles)
    elif follows:
        # If only a few stamps deviate, the other rows do not move.
        moved = late if clock.kind == "late" else np.ones_like(late)
        position = np.maximum.accumulate(clock.ticks + np.where(moved, off / clock.dt, 0.0))
        times = clock.times[0] + dt * position
        piece = _resampled(part._replace(times=times), clock, dt, clock.times[0], angles)
    else:
        piece = _keep_rows(part, clock, dt, angles)
    return piece and piece._replace(off=np.abs(off), late=late)


def _keep_rows(part: Rows, clock: Clock, dt: float, angles: Sequence[int]) -> _Samples:
    """Rows at their ticks; observations of missing rows are interpolated."""
    ticks, begin = clock.ticks, float(clock.times[0])
    every = np.arange(ticks[-1] + 1)
    obs, held = part.obs, part.actions[:-1]
    skipped = np.diff(ticks) - 1
    if skipped.any():
        _check_wraps(part, angles, skipped > 0)
        obs = _interpolate(every, ticks, _unwrap(obs, angles))
        obs[ticks] = part.obs
        _wrap(obs, angles)
        held = np.repeat(held, 1 + skipped, axis=0)
    rows = part._replace(times=begin + dt * ticks)
    missing = tuple((int(part.numbers[k + 1]), int(skipped[k])) for k in np.flatnonzero(skipped))
    moved = dt * _longest_distance(ticks, every)
    return _Samples(begin, obs, held, rows, clock, True, missing, moved, np.zeros(part.obs.shape))


def _resampled(
    rows: Rows, clock: Clock, dt: float, begin: float | None, angles: Sequence[int]
) -> _Samples | None:
    """
    :param begin: a time on the grid; default: such that as many rows as possible are on it [s]
    """
    first = np.concatenate([[True], np.diff(rows.times) > 0.0])
    rows = rows.part(first)
    times = rows.times - rows.times[0]
    start = (
        _grid_offset(times, dt) if begin is None else _first_grid_point(begin - rows.times[0], dt)
    )
    n_steps = math.floor((times[-1] - start) / dt + ON_GRID)
    if n_steps < 1:
        return None
    grid = np.minimum(start + dt * np.arange(n_steps + 1), times[-1])
    _check_wraps(rows, angles, np.ones(len(times) - 1, bool))
    continuous = _unwrap(rows.obs, angles)
    new = _interpolate(grid, times, continuous)
    error = _interpolate(times, grid, new) - continuous
    _wrap(new, angles)
    held = rows.actions[:-1] * np.diff(times)[:, None]
    impulse = np.vstack([np.zeros(held.shape[1]), np.cumsum(held, axis=0)])
    actions = np.diff(_interpolate(grid, times, impulse), axis=0) / np.diff(grid)[:, None]
    inside = (times >= grid[0]) & (times <= grid[-1])
    begin = float(rows.times[0]) + start
    moved = _longest_distance(times, grid)
    return _Samples(begin, new, actions, rows, clock, False, (), moved, error[inside])


def _unwrap(obs: np.ndarray, angles: Sequence[int]) -> np.ndarray:
    """A copy with continuous angles, which turn the shorter way."""
    continuous = obs.copy()
    continuous[:, list(angles)] = np.unwrap(continuous[:, list(angles)], axis=0)
    return continuous


def _wrap(obs: np.ndarray, angles: Sequence[int]) -> None:
    for i in angles:
        obs[:, i] = (obs[:, i] + np.pi) % (2.0 * np.pi) - np.pi


def _check_wraps(rows: Rows, angles: Sequence[int], between: np.ndarray) -> None:
    """
    :param between: which steps from row to row are interpolated
    :raises TrajectoryError: if a channel that is not declared an angle wraps there: interpolating
        between the ends of its range is wrong
    """
    for i in set(range(rows.obs.shape[1])) - set(angles):
        x = rows.obs[:, i]
        steps = np.diff(x)
        typical = min(float(np.median(np.abs(steps))) if len(steps) else 0.0, _LARGEST_STEP)
        # Between -pi and pi, or between 0 and two pi.
        ends = np.abs(x[1:] + x[:-1] - (2.0 * np.pi if x.min() >= 0.0 else 0.0))
        wraps = angle_wraps(steps, np.array(typical)) & (ends < _NEAR_ENDS * typical) & between
        if wraps.any():
            row = int(rows.numbers[np.flatnonzero(wraps)[0]])
            raise TrajectoryError(
                f"Channel {i} of '{rows.source}' jumps by a full turn after row {row}, and its "
                "rows have to be resampled. If it is an angle that wraps, declare it: {column: "
                "NAME, angle: true}."
            )


def _grid_offset(times: np.ndarray, dt: float) -> float:
    """
    Start of the grid after the first row, such that as many rows as possible are on it [s].

    This keeps most rows of a log in which all but a few intervals are regular.
    """
    turn = np.exp(2j * np.pi * times / dt).mean()
    phase = float(np.angle(turn) / (2.0 * np.pi) % 1.0)
    return phase * dt if abs(turn) > 0.5 and ON_GRID < phase < 1.0 - ON_GRID else 0.0


def _first_grid_point(time: float, dt: float) -> float:
    """:return: the first point at or after 0 of a grid through this time [s]"""
    phase = time / dt % 1.0
    return phase * dt if 1e-6 < phase < 1.0 - 1e-6 else 0.0


def _sampling_of(rows: Rows, split: _Split, pieces: Sequence[_Samples | None]) -> Sampling:
    waits = np.concatenate([np.diff(part.times) for part in split.parts])
    median = float(np.median(waits)) if len(waits) else math.nan
    kept = [piece for piece in pieces if piece is not None]
    errors = [piece.error for piece in kept] or [np.zeros_like(rows.obs)]
    longest = max(kept, key=lambda piece: len(piece.rows.times), default=None)
    clock = longest.clock if longest else split.clocks[0]
    off = np.concatenate([np.zeros(0), *(piece.off for piece in kept if piece.clock.periodic)])
    late = [
        number
        for part, piece in zip(split.parts, pieces, strict=True)
        if piece is not None and piece.clock.kind == "late"
        for number in part.numbers[piece.late].tolist()
    ]
    return Sampling(
        source=rows.source,
        rows=len(rows.times),
        intervals=(waits.min(initial=median), median, waits.max(initial=median)),
        uneven=int((np.abs(waits - median) > _UNEVEN * median).sum()),
        repeated=tuple(rows.numbers[split.repeated].tolist()),
        gaps=split.gaps,
        unused=sum(len(p.times) for p, m in zip(split.parts, pieces, strict=True) if m is None),
        resampled=not all(piece.kept for piece in kept),
        moved=max((piece.moved for piece in kept), default=0.0),
        error=tuple(np.sqrt(np.mean(np.concatenate(errors) ** 2, axis=0)).tolist()),
        clock=clock.kind,
        interval=clock.dt,
        rounding=split.rounding,
        off=float(off.max(initial=0.0)),
        jitter=float(np.sqrt(np.mean(off**2))) if len(off) else 0.0,
        late=tuple(late),
        drift=clock.drift,
        missing=tuple(hole for piece in kept for hole in piece.missing),
    )


def _interpolate(grid: np.ndarray, times: np.ndarray, values: np.ndarray) -> np.ndarray:
    """:return: the columns of ``values``, interpolated linearly"""
    columns = [np.interp(grid, times, column) for column in values.T]
    return np.stack(columns, axis=1) if columns else np.zeros((len(grid), 0))


def _longest_distance(times: np.ndarray, grid: np.ndarray) -> float:
    """:return: the longest time from a point of the grid to the closest row [s]"""
    right = np.clip(np.searchsorted(times, grid), 1, len(times) - 1)
    return float(np.minimum(np.abs(grid - times[right - 1]), np.abs(times[right] - grid)).max())
