"""Velocity channels that come late or early, as the derivative of a position tells."""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from sb3_hds.core.trajectories import Trajectories
from sb3_hds.data.finding import Place
from sb3_hds.data.findings import VelocityShift

_REACH = 0.05  # [s] longest shift that is looked for, but at least _FEWEST samples
_FEWEST, _MOST = 8, 100  # samples
_SHORTEST = 24  # steps of an episode that is looked at
_PER_REACH = 4  # steps of an episode for each sample of the longest shift
_WIDTHS = (1, 3, 7, 15, 31)  # samples of the moving average; the first that makes a pair clear
_CLEAR = 0.95  # correlation of a position's derivative with its velocity
_SAME = 0.25  # largest difference of their ratio from 1
_CIRCLE = 0.1  # largest root mean square of cos^2 + sin^2 - 1
_BLOCKS = 12
_VISIBLE = 0.75  # samples: half of one is what a backward difference or semi-implicit Euler has
_SIGMAS = 3.0
_BETTER = 2.0  # by how much the shift must reduce the unexplained variance,
_LONG = 2.0  # unless it is longer than this [samples]

Pairs = Sequence[tuple[np.ndarray, np.ndarray]]
"""Position and velocity of each episode, each of shape ``(rows,)``."""


class Lag(NamedTuple):
    """
    :param velocity: channel
    :param position: name of the position whose derivative it is
    :param samples: by how many the velocity comes late; negative: early
    :param stderr: standard error of that, from blocks of the data
    :param better: unexplained variance of the velocity without the shift by that with it
    """

    velocity: int
    position: str
    samples: float
    stderr: float
    better: float


def velocity_shifts(data: Trajectories, names: Sequence[str]) -> list[VelocityShift]:
    """
    :param data: at one interval
    :param names: of the observation channels
    :return: the lags that are longer than a backward difference has, beyond doubt, and either long
        or the cause of half of what the derivative leaves unexplained
    """
    whole = tuple(Place(f"trajectory {i}", 0, int(n), i) for i, n in enumerate(data.lengths))
    return [
        VelocityShift(
            names[lag.velocity],
            whole,
            position=lag.position,
            samples=lag.samples,
            seconds=lag.samples * data.dt,
            stderr=lag.stderr,
        )
        for lag in lags_of(data, names)
        if abs(lag.samples) >= max(_VISIBLE, _SIGMAS * lag.stderr)
        and (lag.better >= _BETTER or abs(lag.samples) >= _LONG)
    ]


def lags_of(data: Trajectories, names: Sequence[str]) -> list[Lag]:
    """
    Pairs of a position and its velocity, found by their correlation, and the lag between them.

    The velocity is compared with the central difference of the position, which has no delay, both
    smoothed by the same symmetric window. A parabola through the correlations around the best shift
    gives the fraction of a sample. The angle of a cosine and a sine is a position too.

    :param data: at one interval
    :param names: of the observation channels
    """
    episodes = [data.episode(i)[0] for i, n in enumerate(data.lengths) if n >= _SHORTEST]
    if not episodes:
        return []
    wanted = int(np.clip(round(_REACH / data.dt), _FEWEST, _MOST))
    reach = min(wanted, *(len(x) // _PER_REACH for x in episodes))
    found = []
    for v in range(data.n_obs):
        scored = []
        for name, positions in _positions(episodes, names, v):
            pairs = [(q, x[:, v]) for q, x in zip(positions, episodes, strict=True)]
            for width in _WIDTHS:
                if any(len(x) <= 4 * reach + width for x in episodes):
                    continue
                scores = _Scores.of(pairs, data.dt, reach, width)
                if scores.highest > _CLEAR:
                    scored.append((scores.highest, name, pairs, scores, width))
                    break
        matching = [s for s in scored if abs(s[3].slope_there - 1.0) < _SAME]
        if matching:
            _, name, pairs, scores, width = max(matching, key=lambda s: s[0])
            stderr = _stderr(pairs, data.dt, reach, width)
            found.append(Lag(v, name, scores.lag, stderr, scores.better))
    return found


def _positions(
    episodes: Sequence[np.ndarray], names: Sequence[str], v: int
) -> list[tuple[str, list[np.ndarray]]]:
    """Everything that channel v may be the derivative of, per episode; turns are counted."""
    others = [j for j in range(len(names)) if j != v]
    found = [(names[j], [_unwrapped(x[:, j]) for x in episodes]) for j in others]
    joined = np.concatenate(episodes)
    for c, s in itertools.permutations(others, 2):
        if np.sqrt(np.mean((joined[:, c] ** 2 + joined[:, s] ** 2 - 1.0) ** 2)) < _CIRCLE:
            angles = [np.unwrap(np.arctan2(x[:, s], x[:, c])) for x in episodes]
            found.append((f"{names[c]}, {names[s]}", angles))
    return found


def _unwrapped(x: np.ndarray) -> np.ndarray:
    """With turns counted, where the values look like a wrapped angle [rad]."""
    wraps = np.abs(np.abs(np.diff(x)) - 2.0 * np.pi) < 1.0
    return np.unwrap(x) if wraps.any() and np.ptp(x) < 2.1 * np.pi else x


def _stderr(pairs: Pairs, dt: float, reach: int, width: int) -> float:
    n_blocks = max(1, _BLOCKS // len(pairs))
    blocks = [
        block
        for q, v in pairs
        for block in zip(np.array_split(q, n_blocks), np.array_split(v, n_blocks), strict=True)
        if len(block[0]) > 4 * reach + width
    ]
    scores = [_Scores.of([block], dt, reach, width) for block in blocks or pairs]
    lags = np.array([s.lag for s in scores if s.highest > 0.5 * _CLEAR])
    if len(lags) < 3:
        return 0.0 if len(lags) else np.inf
    # Robust, because a block in which hardly anything moves says little.
    spread = 1.4826 * float(np.median(np.abs(lags - np.median(lags))))
    return float(spread / np.sqrt(len(lags)))


class _Scores(NamedTuple):
    """
    How a velocity follows from the derivative, at shifts from -reach to reach samples.

    :param correlation: at each shift
    :param slope: of the velocity on the derivative
    """

    correlation: Float64[np.ndarray, " shifts"]
    slope: Float64[np.ndarray, " shifts"]

    @classmethod
    def of(cls, pairs: Pairs, dt: float, reach: int, width: int) -> "_Scores":
        window = np.ones(width) / width
        moments = np.zeros((3, 2 * reach + 1))
        for q, v in pairs:
            rate = np.convolve((q[2:] - q[:-2]) / (2.0 * dt), window, "valid")
            speed = np.convolve(v[1:-1], window, "valid")[reach : len(rate) - reach]
            # At shift s, the velocity of sample k is compared with the derivative of k - s.
            shifted = np.lib.stride_tricks.sliding_window_view(rate, len(speed))[::-1]
            moments[0] += speed @ speed
            moments[1] += shifted @ speed
            moments[2] += np.einsum("ij,ij->i", shifted, shifted)
        vv, vr, rr = moments
        tiny = np.finfo(float).tiny
        return cls(vr / np.sqrt(np.maximum(vv * rr, tiny)), vr / np.maximum(rr, tiny))

    @property
    def highest(self) -> float:
        """The largest correlation."""
        return float(self.correlation.max())

    @property
    def slope_there(self) -> float:
        """The slope where the correlation is largest."""
        return float(self.slope[self.correlation.argmax()])

    @property
    def better(self) -> float:
        """Unexplained variance without a shift by that with the best one."""
        unexplained = 1.0 - self.correlation**2
        return float(unexplained[len(unexplained) // 2] / max(unexplained.min(), 1e-12))

    @property
    def lag(self) -> float:
        """The shift of the largest correlation, to a fraction of a sample."""
        reach, i = len(self.correlation) // 2, int(self.correlation.argmax())
        if i in (0, 2 * reach):
            return float(i - reach)
        left, middle, right = self.correlation[i - 1 : i + 2]
        bend = left - 2.0 * middle + right
        return float(i - reach + (0.5 * (left - right) / bend if bend < 0.0 else 0.0))
