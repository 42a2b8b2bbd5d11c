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
from sb3_hds.data.resampling.stamps import check_resolved, values_follow_stamps, written_twice
from sb3_hds.data.resampling.values import resolutions, whole_turns
from sb3_hds.errors import TrajectoryError

_UNEVEN = 0.1  # of the median interval
_GAP = 5.0  # intervals
_LARGEST = 0.2  # largest typical step at which whole turns are recognised [rad]
_ENDS = 6.0  # usual steps: how near to its ends an angle wraps
_AS_GOOD = 1.05  # ratio of mean deviations up to which two clocks fit stamps equally well
_SIGMAS = 3.0  # standard errors by which an interval may differ from the common one
_FAR = 10.0  # intervals between two measurements that cannot be interpolated


def at_one_interval(
    episodes: Sequence[Rows], columns: Columns, notes: Sequence[str] = ()
) -> Trajectories:
    """
    Identify the clock of each episode, drop duplicated rows, cut at gaps, and resample rows of
    irregular clocks or of clocks with another rate.

    Rows of a regular clock are kept, even if their stamps are rounded, late or jitter. Where the
    values agree with such stamps rather than with the ticks, only those rows are interpolated.
    Commands are held until the next row; a step gets their mean over its duration, which preserves
    the impulse.

    :param episodes: at least one
    :param columns: for ``dt``, ``gap``, names, units, and which channels are angles
    :param notes: for the report
    :return: the samples, with a report of what was changed
    :raises TrajectoryError: if nothing is left that is as long as one step, for stamps too coarse
        to tell an interval, or for steps that are far shorter than the intervals of the log
    """
    cuts = [_cut(rows, columns.gap) for rows in episodes]
    clocks = [clock for cut in cuts for clock in cut.clocks]
    dt = columns.dt or _interval(clocks)
    _check_interval(dt, clocks)
    obs, actions = columns.obs or (), columns.actions or ()
    angles = [i for i, entry in enumerate(obs) if entry.angle]
    samplings: list[Sampling] = []
    found: list[tuple[int, _Piece]] = []
    for number, (rows, cut) in enumerate(zip(episodes, cuts, strict=True)):
        made = [
            _at_steps(part, _agreeing(clock, part, cut.rounding, dt), cut.rounding, dt, angles)
            for part, clock in zip(cut.parts, cut.clocks, strict=True)
        ]
        samplings.append(_described(rows, cut, made))
        found += [(number, piece) for piece in made if piece is not None]
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


class _Cut(NamedTuple):
    parts: list[Rows]
    clocks: list[Clock]
    rounding: float  # of the stamps [s]
    repeated: np.ndarray  # rows left out
    gaps: tuple[tuple[int, float], ...]


class _Piece(NamedTuple):
    """
    :param begin: time of the first sample, on the clock of the rows [s]
    :param rows: with times that fit the samples
    :param kept: whether rows are samples as they were measured
    :param missing: row before which rows are missing, and how many; samples were interpolated
    :param moved: longest time from a sample to the row closest to it [s]
    :param error: of the rows, read back from the steps
    :param off: how far stamps are from their ticks [s]
    :param late: which of them are farther than rounding explains
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


def _cut(rows: Rows, gap: float | None) -> _Cut:
    """Without rows that were written twice, and in parts between the gaps, each with its clock."""
    times = rows.times
    if len(times) < 2:
        return _Cut([rows], [clock_of(times, math.nan, 0.0)], 0.0, np.zeros(0, int), ())
    interval = typical_interval(times) if times[-1] > times[0] else math.nan
    left_out = written_twice(rows, interval)
    kept = rows.part(~left_out)
    check_resolved(kept)
    if left_out.any():
        interval = typical_interval(kept.times)
    rounding = rounding_of(kept.times, interval)
    ends = _gaps(kept.times, interval, rounding, gap)
    bounds = [0, *ends, len(kept.times)]
    parts = [kept.part(slice(a, b)) for a, b in itertools.pairwise(bounds)]
    clocks = [clock_of(part.times, interval, rounding) for part in parts]
    waits = np.diff(kept.times)
    gaps = tuple((int(kept.numbers[i]), float(waits[i - 1])) for i in ends)
    return _Cut(parts, clocks, rounding, np.flatnonzero(left_out), gaps)


def _gaps(times: np.ndarray, interval: float, rounding: float, gap: float | None) -> list[int]:
    """
    Rows before which a part ends. Rows that arrive late in a burst and catch up with the clock were
    buffered: there is no gap.
    """
    waits = np.diff(times)
    ends = np.flatnonzero(waits > (gap or _GAP * interval + rounding)) + 1
    if gap:
        return ends.tolist()
    return [k for k in ends.tolist() if not _catches_up(times[k - 1 :] / interval)]


def _catches_up(x: np.ndarray) -> bool:
    """:param x: stamps from the row before a long wait on [intervals]"""
    behind = x - x[0] - np.arange(len(x))
    return bool((behind[1 : 2 + 2 * math.ceil(behind[1])] < 1.0).any())


def _interval(clocks: Sequence[Clock]) -> float:
    """The common interval of the clocks, or else a round number near the median interval."""
    several = [clock for clock in clocks if len(clock.slots) > 1]
    if not several:
        raise TrajectoryError("Each episode of the log has a single row: nothing follows from it.")
    dt = common_interval(several)
    if dt is not None:
        return dt
    waits = np.concatenate([np.diff(clock.times) for clock in several])
    return round_number(float(np.median(waits[waits > 0.0])))


def _check_interval(dt: float, clocks: Sequence[Clock]) -> None:
    """
    :raises TrajectoryError: for an interval far below that of the log: its time is in other units
    """
    rows = [len(clock.slots) if len(clock.slots) > 1 else 0 for clock in clocks]
    own = np.repeat([clock.dt for clock in clocks], rows)
    median = float(np.median(own)) if len(own) else dt
    if median > _FAR * dt:
        raise TrajectoryError(
            f"Rows are {median:.4g} s apart, and dt is {dt:.4g} s: between two measurements "
            f"nothing is known of {median / dt:.0f} steps. If time stamps are not in seconds, say "
            "so: 'time: {column: NAME, scale: 0.001}'."
        )


def _agreeing(clock: Clock, part: Rows, rounding: float, dt: float) -> Clock:
    """The clock with the common interval, where the stamps cannot tell them apart."""
    if len(part.times) < 2 or (clock.ticks and abs(clock.dt - dt) <= 1e-9 * dt):
        return clock
    common = clock_of(part.times, dt, rounding, dt)
    if common.kind in ("regular", "rounded"):
        return common
    own, other = (float(np.abs(part.times - one.times).mean()) for one in (clock, common))
    near = abs(clock.dt - dt) <= _SIGMAS * clock.stderr or other <= _AS_GOOD * own
    return common if clock.ticks and common.ticks and near else clock


def _at_steps(
    part: Rows, clock: Clock, rounding: float, dt: float, angles: Sequence[int]
) -> _Piece | None:
    """None if the rows are shorter than one step."""
    if len(part.times) < 2:
        return None
    off, late = part.times - clock.times, late_rows(clock, part.times, rounding)
    follows = clock.kind in ("late", "jittered") and values_follow_stamps(part, clock)
    if not (clock.ticks and same_interval(clock.dt, dt)):
        measured = part if follows or not clock.ticks else part._replace(times=clock.times)
        piece = _resampled(measured, clock, dt, None, angles)
    elif follows:
        # Where a few are off, the others stay as they are.
        moved = late if clock.kind == "late" else np.ones_like(late)
        spot = np.maximum.accumulate(clock.slots + np.where(moved, off / clock.dt, 0.0))
        times = clock.times[0] + dt * spot
        piece = _resampled(part._replace(times=times), clock, dt, clock.times[0], angles)
    else:
        piece = _kept(part, clock, dt, angles)
    return piece and piece._replace(off=np.abs(off), late=late)


def _kept(part: Rows, clock: Clock, dt: float, angles: Sequence[int]) -> _Piece:
    """Rows at their ticks; where some are missing, observations are interpolated."""
    slots, begin = clock.slots, float(clock.times[0])
    every = np.arange(slots[-1] + 1)
    obs, held = part.obs, part.actions[:-1]
    skipped = np.diff(slots) - 1
    if skipped.any():
        _refuse_turns(part, angles, skipped > 0)
        obs = _at(every, slots, _turning(obs, angles))
        obs[slots] = part.obs
        _wrap(obs, angles)
        held = np.repeat(held, 1 + skipped, axis=0)
    rows = part._replace(times=begin + dt * slots)
    missing = tuple((int(part.numbers[k + 1]), int(skipped[k])) for k in np.flatnonzero(skipped))
    moved = dt * _farthest(slots, every)
    return _Piece(begin, obs, held, rows, clock, True, missing, moved, np.zeros(part.obs.shape))


def _resampled(
    rows: Rows, clock: Clock, dt: float, begin: float | None, angles: Sequence[int]
) -> _Piece | None:
    """
    :param begin: a time that the grid passes through; default: so that it passes through as many
        rows as possible [s]
    """
    first = np.concatenate([[True], np.diff(rows.times) > 0.0])
    rows = rows.part(first)
    times = rows.times - rows.times[0]
    start = _phase(times, dt) if begin is None else _next(begin - rows.times[0], dt)
    n_steps = math.floor((times[-1] - start) / dt + ON_GRID)
    if n_steps < 1:
        return None
    grid = np.minimum(start + dt * np.arange(n_steps + 1), times[-1])
    _refuse_turns(rows, angles, np.ones(len(times) - 1, bool))
    turns = _turning(rows.obs, angles)
    new = _at(grid, times, turns)
    error = _at(times, grid, new) - turns
    _wrap(new, angles)
    held = rows.actions[:-1] * np.diff(times)[:, None]
    impulse = np.vstack([np.zeros(held.shape[1]), np.cumsum(held, axis=0)])
    actions = np.diff(_at(grid, times, impulse), axis=0) / np.diff(grid)[:, None]
    inside = (times >= grid[0]) & (times <= grid[-1])
    begin = float(rows.times[0]) + start
    moved = _farthest(times, grid)
    return _Piece(begin, new, actions, rows, clock, False, (), moved, error[inside])


def _turning(obs: np.ndarray, angles: Sequence[int]) -> np.ndarray:
    """With angles that turn the shorter way."""
    turns = obs.copy()
    turns[:, list(angles)] = np.unwrap(turns[:, list(angles)], axis=0)
    return turns


def _wrap(obs: np.ndarray, angles: Sequence[int]) -> None:
    for i in angles:
        obs[:, i] = (obs[:, i] + np.pi) % (2.0 * np.pi) - np.pi


def _refuse_turns(rows: Rows, angles: Sequence[int], between: np.ndarray) -> None:
    """
    :param between: which steps from row to row are interpolated
    :raises TrajectoryError: where a channel jumps by a whole turn there: between its ends there is
        no motion to interpolate
    """
    for i in set(range(rows.obs.shape[1])) - set(angles):
        x = rows.obs[:, i]
        steps = np.diff(x)
        usual = min(float(np.median(np.abs(steps))) if len(steps) else 0.0, _LARGEST)
        # Between -pi and pi, or between 0 and two pi.
        ends = np.abs(x[1:] + x[:-1] - (2.0 * np.pi if x.min() >= 0.0 else 0.0))
        wraps = whole_turns(steps, np.array(usual)) & (ends < _ENDS * usual) & between
        if wraps.any():
            row = int(rows.numbers[np.flatnonzero(wraps)[0]])
            raise TrajectoryError(
                f"Channel {i} of '{rows.source}' jumps by a whole turn after row {row}, and its "
                "rows have to be resampled. If it is an angle that wraps, say so: {column: NAME, "
                "angle: true}."
            )


def _phase(times: np.ndarray, dt: float) -> float:
    """
    Where the grid begins after the first row, so that it passes through as many rows as possible.

    A log in which all but a few intervals are regular then keeps most of its rows as they are.
    """
    turn = np.exp(2j * np.pi * times / dt).mean()
    phase = float(np.angle(turn) / (2.0 * np.pi) % 1.0)
    return phase * dt if abs(turn) > 0.5 and ON_GRID < phase < 1.0 - ON_GRID else 0.0


def _next(time: float, dt: float) -> float:
    """:return: the first point from 0 on of a grid through that time"""
    phase = time / dt % 1.0
    return phase * dt if 1e-6 < phase < 1.0 - 1e-6 else 0.0


def _described(rows: Rows, cut: _Cut, made: Sequence[_Piece | None]) -> Sampling:
    waits = np.concatenate([np.diff(part.times) for part in cut.parts])
    median = float(np.median(waits)) if len(waits) else math.nan
    kept = [piece for piece in made if piece is not None]
    errors = [piece.error for piece in kept] or [np.zeros_like(rows.obs)]
    longest = max(kept, key=lambda piece: len(piece.rows.times), default=None)
    clock = longest.clock if longest else cut.clocks[0]
    off = np.concatenate([np.zeros(0), *(piece.off for piece in kept if piece.clock.ticks)])
    late = [
        number
        for part, piece in zip(cut.parts, made, strict=True)
        if piece is not None and piece.clock.kind == "late"
        for number in part.numbers[piece.late].tolist()
    ]
    return Sampling(
        source=rows.source,
        rows=len(rows.times),
        intervals=(waits.min(initial=median), median, waits.max(initial=median)),
        uneven=int((np.abs(waits - median) > _UNEVEN * median).sum()),
        repeated=tuple(rows.numbers[cut.repeated].tolist()),
        gaps=cut.gaps,
        unused=sum(len(p.times) for p, m in zip(cut.parts, made, strict=True) if m is None),
        resampled=not all(piece.kept for piece in kept),
        moved=max((piece.moved for piece in kept), default=0.0),
        error=tuple(np.sqrt(np.mean(np.concatenate(errors) ** 2, axis=0)).tolist()),
        clock=clock.kind,
        interval=clock.dt,
        rounding=cut.rounding,
        off=float(off.max(initial=0.0)),
        jitter=float(np.sqrt(np.mean(off**2))) if len(off) else 0.0,
        late=tuple(late),
        drift=clock.drift,
        missing=tuple(hole for piece in kept for hole in piece.missing),
    )


def _at(grid: np.ndarray, times: np.ndarray, values: np.ndarray) -> np.ndarray:
    """:return: the columns of ``values``, interpolated linearly"""
    columns = [np.interp(grid, times, column) for column in values.T]
    return np.stack(columns, axis=1) if columns else np.zeros((len(grid), 0))


def _farthest(times: np.ndarray, grid: np.ndarray) -> float:
    """:return: the longest time from a point of the grid to the row closest to it [s]"""
    right = np.clip(np.searchsorted(times, grid), 1, len(times) - 1)
    return float(np.minimum(np.abs(grid - times[right - 1]), np.abs(times[right] - grid)).max())
