"""
Weak form of the equation of motion: noise of velocities averages out, and no accelerations are
formed.

The residual force is an impulse for each interval, and the measured velocities in it telescope
where the mass matrix is constant: multiplied by a smooth bump and summed, only the slopes of the
bump multiply their noise. Overlapping bumps give the rows, with Huber weights and blocks of data.
"""

import itertools
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.lib.stride_tricks import sliding_window_view

from sb3_hds.sysid.equation.regression import TINY, Equation, Item

# Width of a bump, in periods of the joint's motion, and its least number of intervals.
_WIDTH, _LEAST = 0.3, 6
# Number of widths, each half the one before, that are tried where there would be too few rows.
_NARROWEST = 5
# Below this share of the root mean square speed, or this many of its errors, a joint is at rest:
# static friction then takes any value, and such intervals carry no information, nor do those around
# a reversal, which smoothing blurs.
_REST, _ERRORS = 0.02, 3.0
# Where a velocity is below this multiple of what it changes by in an interval, the joint may have
# stopped in between.
_STOPS = 1.0
# Rows per column of the rich model that should remain, the fallbacks where a joint rests for this
# share of the time, and half widths shorter than the least. With too few rows, more intervals are
# kept: around reversals, then where a joint may have stopped, and rest at last.
_ENOUGH, _OFTEN, _SHORTEST = (4.0, 2.0, 1.0), 0.1, (2, 1)
# Wider bumps average the noise of velocities, and cost rows around reversals: bumps are wide where
# this share of the residual is such noise, and narrower by more than this factor only where there
# is hardly any.
_AVERAGED, _NARROW, _NO_NOISE = 0.5, 3.0, 0.05
# Huber's threshold, in units of the noise, and number of reweightings.
_HUBER, _PASSES = 2.0, 4
# Clusters: at least this many recordings, or pieces of them; and folds of held-out data.
_BLOCKS, FOLDS = 16, 8
# Largest ratio of cluster-robust to naive variances.
_MOST_DEFLATION = 10.0
# Effects that the rich model of the noise leaves out: with them, it would fit trivially, 0 = 0.
_SCALES = ("torque_gain", "directional_gain", "dead_zone", "saturation", "sensor_scale")
_RANK = 1e-6


class Rows(NamedTuple):
    """
    The equation of one joint, in units of its noise.

    :param y: residual force, shape ``(n,)``
    :param x: columns, shape ``(n, used)``
    :param used: indices of the columns
    :param block: of data that each row is from, shape ``(n,)``
    :param scale: noise of a row [N m] or [N]
    :param floor: what the noise of the velocities alone would leave, in units of ``scale``
    :param gain: by which a constant force is larger in a row than at an instant
    :param narrowed: by which bumps are narrower than the widest
    """

    y: np.ndarray
    x: np.ndarray
    used: np.ndarray
    block: np.ndarray
    scale: float
    floor: float
    gain: float
    narrowed: float


def rich_columns(items: list[Item], used: np.ndarray) -> np.ndarray:
    """
    :return: places among ``used`` of the columns of a rich linear model, whose residual is noise
    """
    wanted: dict[str, tuple[int, ...]] = {}
    for item in items:
        if item.rule in ("linear", "blend") and item.candidate.name not in _SCALES:
            # The first of several settings stands for all.
            wanted.setdefault(item.key, item.columns)
    columns = {c for cs in wanted.values() for c in cs}
    return np.flatnonzero(np.isin(used, list(columns)))


def weak_rows(equation: Equation, j: int) -> Rows:
    """:return: rows of one joint"""
    columns, motion = equation.columns, equation.motion
    acting = {i: values for i, c in enumerate(columns) if (values := c.at(j)) is not None}
    acting = {i: values for i, values in acting.items() if np.abs(values).max() > 0.0}
    used = np.array([*acting], int)
    table = np.stack([equation.residual[:, j], *acting.values()], 1)
    rich = rich_columns(equation.items, used)
    period = motion.period[j] if np.isfinite(motion.period[j]) else 1.0
    widest = max(_WIDTH * period, _LEAST * motion.dt) / (2.0 * motion.dt)
    halves = [max(round(widest / 2**k), 2) for k in range(_NARROWEST)]
    halves = [n for n in halves if n >= _LEAST // 2] or halves[:1]
    mass = float(np.median(equation.effective_inertia[:, j, j]))

    def against(half: int, left_out: np.ndarray) -> Rows:
        projected, pieces = _against_bumps(table, equation.rows.recording, left_out, half)
        y, x = projected[:, 0], projected[:, 1:]
        weight, scale = _huber(y, x[:, rich]) if len(y) else (y, 1.0)
        slope = np.linalg.norm(np.diff(_bump(half), prepend=0.0, append=0.0))
        return Rows(
            weight * y / scale,
            weight[:, None] * x / scale,
            used,
            _blocks(pieces, equation.rows.recording),
            scale,
            float(mass * motion.noise_v[j] * slope / motion.dt / scale) if len(y) else 0.0,
            float(_bump(half).sum()),
            halves[0] / half,
        )

    def averaged(left_out: np.ndarray, wide: list[int], enough: float) -> Rows | None:
        made = None
        for half in wide:
            n = sum(map(len, _begins(equation.rows.recording, left_out, half)))
            if n <= enough * len(rich):
                continue
            rows = made = against(half, left_out)
            if rows.floor > (_AVERAGED if rows.narrowed < _NARROW else _NO_NOISE):
                break
        return made

    for left_out, wide, enough in _choices(equation, j, halves):
        if (rows := averaged(left_out, wide, enough)) is not None:
            return rows
    return against(halves[0], np.zeros(len(table), bool))


def _choices(
    equation: Equation, j: int, halves: list[int]
) -> Iterator[tuple[np.ndarray, list[int], float]]:
    """
    :return: intervals to leave out, half widths of bumps, and rows per column that must remain, in
        order of preference
    """
    v, motion = equation.rows.v[:, j], equation.motion
    slow = np.abs(v) < max(_ERRORS * motion.error_v[j], _REST * motion.speed[j])
    change = np.abs(np.diff(v, append=v[-1:]))
    stops = np.abs(v) < _STOPS * np.maximum(change, np.roll(change, 1))
    turns = np.abs(np.diff(np.sign(v), prepend=np.sign(v[:1]))) > 0
    around = np.ones(2 * int(motion.blurred[j]) + 1)
    blurred = np.convolve(slow | turns, around, "same") > 0
    careful, careless = (stops | blurred, stops | slow), (slow | turns, slow)
    shortest = [n for n in _SHORTEST if n < halves[-1]]
    first = _ENOUGH if slow.mean() > _OFTEN else _ENOUGH[:1]
    for enough in first:
        yield from itertools.product(careful, [halves], [enough])
    yield from itertools.product(careless, [halves], _ENOUGH[:1])
    for some, enough in itertools.product((careful, careless), _ENOUGH):
        yield from itertools.product(some, [shortest], [enough])


def _bump(half: int) -> np.ndarray:
    s = np.arange(-half, half + 1) / (half + 1)
    phi = (1.0 - s**2) ** 2
    return phi / np.linalg.norm(phi)


def _against_bumps(
    table: np.ndarray, recording: np.ndarray, left_out: np.ndarray, half: int
) -> tuple[np.ndarray, np.ndarray]:
    """:return: sums against bumps at distances of a half width, and the middle of each"""
    phi = _bump(half)
    rows, middles = [np.zeros((0, table.shape[1]))], [np.zeros(0, int)]
    for first in _begins(recording, left_out, half):
        stretch = table[first[0] : first[-1] + len(phi)]
        rows.append(sliding_window_view(stretch, len(phi), axis=0)[::half] @ phi)
        middles.append(first + half)
    return np.concatenate(rows), np.concatenate(middles)


def _begins(recording: np.ndarray, left_out: np.ndarray, half: int) -> list[np.ndarray]:
    """:return: where bumps begin, by stretch of one recording that has room for one"""
    length = 2 * half + 1
    cut = np.flatnonzero(np.diff(recording)) + 1
    edges = np.diff((~left_out).astype(int), prepend=0, append=0)
    begins, ends = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)
    found = []
    for begin, end in zip(begins, ends, strict=True):
        bounds = [begin, *cut[(cut > begin) & (cut < end)].tolist(), end]
        found += [
            np.arange(first, last - length + 1, half)
            for first, last in itertools.pairwise(bounds)
            if last - first >= length
        ]
    return found


def _huber(y: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, float]:
    """Weights of rows that even the rich model misses, and the noise of the others."""
    weight, scale = np.ones(len(y)), 1.0
    for _ in range(_PASSES):
        left = y - x @ _least_squares(weight[:, None] * x, weight * y)
        scale = float(np.median(np.abs(left)) / 0.6745) + 1e-300
        weight = np.sqrt(np.minimum(1.0, _HUBER * scale / np.maximum(np.abs(left), 1e-300)))
    freedom = max(len(y) - x.shape[1], len(y) // 3, 1)
    return weight, scale * float(np.sqrt(len(y) / freedom))


def _least_squares(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    size = np.sqrt(np.mean(x**2, axis=0)) + TINY
    return np.linalg.lstsq(x / size, y, rcond=_RANK)[0] / size


def _blocks(middles: np.ndarray, recording: np.ndarray) -> np.ndarray:
    """Recordings, or pieces of equal length of fewer."""
    names = np.unique(recording)
    pieces = max(1, -(-_BLOCKS // len(names)))
    place = np.arange(len(recording)) - np.searchsorted(recording, recording)
    length = np.bincount(recording, minlength=names.max() + 1)[recording]
    piece = np.minimum(place * pieces // np.maximum(length, 1), pieces - 1)
    return (recording * pieces + piece)[middles]


class Grams(NamedTuple):
    """
    Normal equations, by joint and block of data: any set of columns is solved in a millisecond.

    :param blocks: shape ``(blocks, columns + 1, columns + 1)``; the last row is the residual force
    :param by_joint: shape ``(dof, columns + 1, columns + 1)``
    :param folds: of held-out data, shape ``(folds, dof, columns + 1, columns + 1)``
    :param n_effective: number of independent rows of each joint
    :param floor: what the noise of velocities alone would leave of each joint's rows, in their unit
    :param scale: noise of a row of each joint [N m] or [N]
    :param gain: by which a constant force is larger in a row of each joint than at an instant
    """

    blocks: np.ndarray
    by_joint: np.ndarray
    folds: np.ndarray
    n_effective: Float[np.ndarray, " dof"]
    floor: Float[np.ndarray, " dof"]
    scale: Float[np.ndarray, " dof"]
    gain: Float[np.ndarray, " dof"]


def grams(equation: Equation) -> Grams:
    """
    Normal equations of :func:`weak_rows`.

    Where blocks disagree more than independent rows would, each row counts as less than one, by the
    ratio of cluster-robust to naive variances of the rich model's coefficients.
    """
    n_columns, dof = len(equation.columns), equation.residual.shape[1]
    pieces = max(1, -(-_BLOCKS // len(np.unique(equation.rows.recording))))
    n_blocks = (int(equation.rows.recording.max()) + 1) * pieces
    blocks = np.zeros((n_blocks, n_columns + 1, n_columns + 1))
    by_joint = np.zeros((dof, n_columns + 1, n_columns + 1))
    n_folds = min(FOLDS, n_blocks)
    order = np.arange(n_blocks)
    fold_of = order % n_folds if pieces == 1 else order * n_folds // n_blocks
    folds = np.zeros((n_folds, dof, n_columns + 1, n_columns + 1))
    n_effective, floor = np.full(dof, 5.0), np.zeros(dof)
    scale, gain = np.ones(dof), np.ones(dof)
    for j in range(dof):
        own = weak_rows(equation, j)
        scale[j], gain[j] = own.scale, own.gain
        if not len(own.y):
            continue
        index = np.ix_([*own.used, n_columns], [*own.used, n_columns])
        z = np.concatenate([own.x, own.y[:, None]], 1)
        local = np.stack([z[own.block == b].T @ z[own.block == b] for b in range(n_blocks)])
        rich = rich_columns(equation.items, own.used)
        deflation = _deflation(local, rich, _MOST_DEFLATION * own.narrowed)
        local = local / deflation
        n_effective[j], floor[j] = max(len(own.y) / deflation, 5.0), own.floor
        for b in range(n_blocks):
            blocks[b][index] += local[b]
            folds[fold_of[b], j][index] += local[b]
        by_joint[j][index] = local.sum(0)
    return Grams(blocks, by_joint, folds, n_effective, floor, scale, gain)


def _deflation(local: np.ndarray, rich: np.ndarray, most: float) -> float:
    total = local.sum(0)
    rich = rich[np.diag(total)[rich] > 0.0]
    if not len(rich):
        return 1.0
    size = np.sqrt(np.diag(total)[rich])
    values, vectors = np.linalg.eigh(total[np.ix_(rich, rich)] / np.outer(size, size))
    well = values > 1e-6 * values[-1]
    inverse = (vectors[:, well] / values[well]) @ vectors[:, well].T
    theta = inverse @ (total[rich, -1] / size)
    among = local[:, rich][:, :, rich] / np.outer(size, size)
    scores = local[:, rich, -1] / size - np.einsum("bij,j->bi", among, theta)
    robust = inverse @ (scores.T @ scores) @ inverse
    ratio = np.diag(robust) / np.maximum(np.diag(inverse), 1e-12)
    n = len(local)
    free = n / max(n - int(well.sum()), n / 2)
    return float(np.clip(np.median(ratio) * free, 1.0, most))
