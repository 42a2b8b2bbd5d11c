"""From rows with time stamps to steps of one length, and what that changed."""

import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sb3_hds.data.columns import Columns
from sb3_hds.data.report import Part, Reading, Sampling
from sb3_hds.data.resolution import resolutions
from sb3_hds.data.rows import Rows
from sb3_hds.data.turns import whole_turns
from sb3_hds.errors import TrajectoryError

_REGULAR = 0.01  # of one interval: stamps that are closer to a grid than this are on it
_UNEVEN = 0.1  # of the median interval
_GAP = 5.0  # intervals
_LARGEST = 0.2  # usual step from which a whole turn is told [rad]
_ENDS = 6.0  # usual steps: how near to its ends an angle wraps
_FAR = 10.0  # intervals between two measurements that nobody can fill in


class Steps(NamedTuple):
    """
    Trajectories at one interval, as arguments of ``Trajectories.from_arrays``.

    :param origin: number of the episode that each is a part of
    """

    obs: list[np.ndarray]
    actions: list[np.ndarray]
    conditions: list[str]
    origin: list[int]


def at_one_interval(episodes: Sequence[Rows], columns: Columns) -> tuple[Steps, Reading]:
    """
    Drop repeated stamps, cut at gaps, and resample where stamps are not on a grid already.

    Observations are interpolated linearly. Of the commands, each held until the next row, a step
    gets the mean over its duration, so that it gives the same impulse.

    :param episodes: at least one
    :param columns: for ``dt``, ``gap``, names, and which channels are angles
    :return: the steps, and what was changed
    :raises TrajectoryError: if nothing is left that is as long as one step, or for steps that are
        far shorter than the intervals of the log
    """
    cuts = [_cut(rows, columns.gap) for rows in episodes]
    stamps = [part.times for cut in cuts for part in cut.parts]
    dt = columns.dt or _interval(stamps)
    _check_interval(dt, stamps)
    angles = [i for i, entry in enumerate(columns.obs or ()) if entry.angle]
    steps, samplings = Steps([], [], [], []), []
    parts = []
    for number, (rows, cut) in enumerate(zip(episodes, cuts, strict=True)):
        made = [_resampled(part, dt, angles) for part in cut.parts]
        samplings.append(_described(rows, cut, made))
        for part, piece in zip(cut.parts, made, strict=True):
            if piece is not None:
                steps.obs.append(piece.obs)
                steps.actions.append(piece.actions)
                steps.conditions.append(rows.condition)
                steps.origin.append(number)
                parts.append(Part(number, part, piece.begin, len(piece.actions)))
    if not steps.obs:
        raise TrajectoryError(
            f"No episode lasts one step of {dt:g} s: the longest has "
            f"{max(len(rows.times) for rows in episodes)} rows. Choose a smaller dt or a longer "
            "gap."
        )
    report = Reading(
        dt=dt,
        obs=tuple(entry.name for entry in columns.obs or ()),
        actions=tuple(entry.name for entry in columns.actions or ()),
        resolution=tuple(resolutions([part.rows.obs for part in parts]).tolist()),
        recordings=tuple(samplings),
        parts=tuple(parts),
    )
    return steps, report


class _Cut(NamedTuple):
    parts: list[Rows]
    repeated: np.ndarray
    gaps: tuple[tuple[int, float], ...]


class _Resampled(NamedTuple):
    begin: float  # time of the first sample, on the clock of the rows
    obs: np.ndarray
    actions: np.ndarray
    regular: bool
    moved: float
    error: np.ndarray  # of the rows, read back from the steps


def _cut(rows: Rows, gap: float | None) -> _Cut:
    """Without rows whose stamp is that of the row before, and in parts between the gaps."""
    repeated = np.flatnonzero(np.diff(rows.times) == 0.0) + 1
    kept = rows.part(np.setdiff1d(np.arange(len(rows.times)), repeated))
    intervals = np.diff(kept.times)
    if not len(intervals):
        return _Cut([kept], repeated, ())
    ends = np.flatnonzero(intervals > (gap or _GAP * float(np.median(intervals)))) + 1
    bounds = [0, *ends.tolist(), len(kept.times)]
    parts = [kept.part(slice(a, b)) for a, b in itertools.pairwise(bounds)]
    gaps = tuple((int(kept.numbers[i]), float(intervals[i - 1])) for i in ends)
    return _Cut(parts, repeated, gaps)


def _interval(stamps: Sequence[np.ndarray]) -> float:
    """The interval of the grid that stamps are on; for jittered ones a round number near by."""
    spans = [times for times in stamps if len(times) > 1]
    if not spans:
        raise TrajectoryError("Each episode of the log has a single row: nothing follows from it.")
    mean = sum(float(t[-1] - t[0]) for t in spans) / sum(len(t) - 1 for t in spans)
    round_number = _rounded(float(np.median(np.concatenate([np.diff(times) for times in spans]))))
    for guess in (round_number, mean):
        if all(_on_grid(times, guess) for times in spans):
            return guess
    return round_number


def _check_interval(dt: float, stamps: Sequence[np.ndarray]) -> None:
    """
    :raises TrajectoryError: for an interval far below that of the log: its time is in other units
    """
    intervals = np.concatenate([np.diff(times) for times in stamps])
    median = float(np.median(intervals)) if len(intervals) else dt
    if median > _FAR * dt:
        raise TrajectoryError(
            f"Rows are {median:.4g} s apart, and dt is {dt:.4g} s: between two measurements "
            f"nothing is known of {median / dt:.0f} steps. If time stamps are not in seconds, say "
            "so: 'time: {column: NAME, scale: 0.001}'."
        )


def _rounded(interval: float) -> float:
    """The number with the fewest digits that is within 1 %."""
    for digits in range(3):
        close = float(f"{interval:.{digits}e}")
        if abs(close - interval) <= 0.01 * interval:
            return close
    return interval


def _on_grid(times: np.ndarray, dt: float) -> bool:
    grid = times[0] + dt * np.arange(len(times))
    return bool(np.abs(times - grid).max() <= _REGULAR * dt)


def _resampled(rows: Rows, dt: float, angles: Sequence[int]) -> _Resampled | None:
    """None if the rows are shorter than one step."""
    times, obs = rows.times - rows.times[0], rows.obs
    if len(times) > 1 and _on_grid(times, dt):
        same = rows.actions[:-1]
        return _Resampled(float(rows.times[0]), obs, same, True, 0.0, np.zeros(obs.shape))
    begin = _phase(times, dt)
    n_steps = math.floor((times[-1] - begin) / dt + _REGULAR)
    if n_steps < 1:
        return None
    grid = np.minimum(begin + dt * np.arange(n_steps + 1), times[-1])
    _refuse_turns(rows, angles)
    turns = obs.copy()
    turns[:, list(angles)] = np.unwrap(turns[:, list(angles)], axis=0)
    new = _at(grid, times, turns)
    error = _at(times, grid, new) - turns
    for i in angles:
        new[:, i] = (new[:, i] + np.pi) % (2.0 * np.pi) - np.pi
    held = rows.actions[:-1] * np.diff(times)[:, None]
    impulse = np.vstack([np.zeros(held.shape[1]), np.cumsum(held, axis=0)])
    actions = np.diff(_at(grid, times, impulse), axis=0) / np.diff(grid)[:, None]
    inside = (times >= grid[0]) & (times <= grid[-1])
    moved = _farthest(times, grid)
    return _Resampled(float(rows.times[0]) + begin, new, actions, False, moved, error[inside])


def _refuse_turns(rows: Rows, angles: Sequence[int]) -> None:
    """
    :raises TrajectoryError: where a channel jumps by a whole turn: between its ends there is no
        motion to interpolate
    """
    for i in set(range(rows.obs.shape[1])) - set(angles):
        x = rows.obs[:, i]
        steps = np.diff(x)
        usual = min(float(np.median(np.abs(steps))) if len(steps) else 0.0, _LARGEST)
        # Between -pi and pi, or between 0 and two pi.
        ends = np.abs(x[1:] + x[:-1] - (2.0 * np.pi if x.min() >= 0.0 else 0.0))
        wraps = whole_turns(steps, np.array(usual)) & (ends < _ENDS * usual)
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
    return phase * dt if abs(turn) > 0.5 and _REGULAR < phase < 1.0 - _REGULAR else 0.0


def _described(rows: Rows, cut: _Cut, made: Sequence[_Resampled | None]) -> Sampling:
    intervals = np.concatenate([np.diff(part.times) for part in cut.parts])
    median = float(np.median(intervals)) if len(intervals) else math.nan
    kept = [piece for piece in made if piece is not None]
    errors = [piece.error for piece in kept] or [np.zeros_like(rows.obs)]
    return Sampling(
        source=rows.source,
        rows=len(rows.times),
        intervals=(intervals.min(initial=median), median, intervals.max(initial=median)),
        uneven=int((np.abs(intervals - median) > _UNEVEN * median).sum()),
        repeated=tuple(rows.numbers[cut.repeated].tolist()),
        gaps=cut.gaps,
        unused=sum(len(p.times) for p, m in zip(cut.parts, made, strict=True) if m is None),
        resampled=not all(piece.regular for piece in kept),
        moved=max((piece.moved for piece in kept), default=0.0),
        error=tuple(np.sqrt(np.mean(np.concatenate(errors) ** 2, axis=0)).tolist()),
    )


def _at(grid: np.ndarray, times: np.ndarray, values: np.ndarray) -> np.ndarray:
    """:return: the columns of ``values``, interpolated linearly"""
    columns = [np.interp(grid, times, column) for column in values.T]
    return np.stack(columns, axis=1) if columns else np.zeros((len(grid), 0))


def _farthest(times: np.ndarray, grid: np.ndarray) -> float:
    """:return: the longest time from a point of the grid to the row closest to it [s]"""
    right = np.clip(np.searchsorted(times, grid), 1, len(times) - 1)
    return float(np.minimum(np.abs(grid - times[right - 1]), np.abs(times[right] - grid)).max())
