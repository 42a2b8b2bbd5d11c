"""Time shifts of velocity channels relative to the derivatives of their positions."""

import dataclasses
import functools
import itertools
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from sb3_hds.core.trajectories import Trajectories
from sb3_hds.core.twin import Twin
from sb3_hds.data.audit.finding import Finding
from sb3_hds.data.audit.replay import replayed, stretches_in
from sb3_hds.data.audit.stretches import all_samples
from sb3_hds.data.resampling.values import unwrapped

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
# Mean square of a velocity less its backward difference, by that less a smoother one: where both
# are noise, and where they are not. A smooth velocity half a sample late has 1/50.
_SAME_NOISE, _SAME_NUMBER = 0.5, 2.5e-3
# Correlation of successive fourth differences: -0.8 for noise of a position, -0.67 under random
# forces, and more for smooth motion.
_ALTERNATES = -0.735
_LONG = 2.0  # unless it is longer than this [samples]

Pairs = Sequence[tuple[np.ndarray, np.ndarray]]
"""Position and velocity of each episode, each of shape ``(rows,)``."""


@dataclasses.dataclass(frozen=True)
class VelocityShift(Finding):
    """
    :param position: name of the channel whose derivative it is
    :param samples: delay of the velocity [samples]; negative: early
    :param seconds: the same delay [s]
    :param stderr: standard error of ``samples``
    """

    position: str
    samples: float
    seconds: float
    stderr: float

    @property
    def sentence(self) -> str:
        verb = "lags" if self.samples > 0 else "leads"
        return (
            f"'{self.channel}' {verb} the derivative of '{self.position}' by "
            f"{abs(self.samples):.2f} +- {self.stderr:.2f} samples, "
            f"{1e3 * abs(self.seconds):.3g} ms ({self.recordings})."
        )

    remedy = (
        "Shift it: audit.corrected(data). A filter in the drive is the usual cause; uncorrected, "
        "it passes for a delay or for friction."
    )


@dataclasses.dataclass(frozen=True)
class BackwardDifference(VelocityShift):
    """A velocity that is the backward difference of its position, and so half a sample late."""

    @property
    def sentence(self) -> str:
        return (
            f"'{self.channel}' is the backward difference of '{self.position}', which belongs half "
            f"a sample, {1e3 * self.seconds:.3g} ms, earlier ({self.recordings})."
        )

    remedy = (
        "Shift it: audit.corrected(data). No sensor is late, unless the twin computes its velocity "
        "in the same way."
    )


@dataclasses.dataclass(frozen=True, eq=False)
class Match:
    """
    A channel that is proportional to the derivative of another one.

    :param velocity: channel
    :param position: name of the position
    :param parts: channels of the position: one, or a cosine and a sine
    :param pairs: position and velocity of each episode
    :param dt: sampling interval [s]
    :param scores: of the pairs
    :param width: of the moving average [samples]
    """

    velocity: int
    position: str
    parts: tuple[int, ...]
    pairs: Pairs
    dt: float
    scores: "_Scores"
    width: int

    @property
    def agrees(self) -> bool:
        """Whether both are in the same unit."""
        return abs(self.scores.slope_there - 1.0) < _SAME

    @property
    def samples(self) -> float:
        """Delay of the velocity [samples]; negative: early."""
        return self.scores.lag

    @functools.cached_property
    def stderr(self) -> float:
        """Standard error of ``samples``, from the scatter over blocks of the data."""
        lags = np.array([s.lag for s in self._scores_of_blocks() if s.highest > 0.5 * _CLEAR])
        if len(lags) < 3:
            return 0.0 if len(lags) else np.inf
        # Robust, because a block in which hardly anything moves says little.
        sigma = 1.4826 * np.median(np.abs(lags - np.median(lags)))
        return float(sigma / np.sqrt(len(lags)))

    @functools.cached_property
    def difference(self) -> "_Difference":
        """How the velocity compares with the backward difference of the position."""
        return _difference_of(self.pairs, self.dt)

    def slopes(self) -> Float64[np.ndarray, " blocks"]:
        """:return: of the velocity on the derivative, in blocks of the data, at the same lag"""
        there = self.scores.correlation.argmax()
        return np.array([block.slope[there] for block in self._scores_of_blocks()])

    def _scores_of_blocks(self) -> list["_Scores"]:
        """Of parts of the episodes, or of these if parts are too short."""
        n_blocks = max(1, _BLOCKS // len(self.pairs))
        reach = len(self.scores.slope) // 2
        blocks = [
            block
            for q, v in self.pairs
            for block in zip(np.array_split(q, n_blocks), np.array_split(v, n_blocks), strict=True)
            if len(block[0]) > 4 * reach + self.width
        ]
        return [_Scores.of([b], self.dt, reach, self.width) for b in blocks or self.pairs]


def velocity_shifts(
    data: Trajectories, names: Sequence[str], matches: Sequence[Match]
) -> list[VelocityShift]:
    """
    :param data: at one interval
    :param names: of the observation channels
    :param matches: of the data
    :return: the significant lags beyond that of a backward difference that are either long or
        explain half of the residual variance
    """
    return [
        VelocityShift(
            names[match.velocity],
            all_samples(data),
            position=match.position,
            samples=match.samples,
            seconds=match.samples * data.dt,
            stderr=match.stderr,
        )
        for match in best_of(matches)
        if abs(match.samples) >= max(_VISIBLE, _SIGMAS * match.stderr)
        and (match.scores.better >= _BETTER or abs(match.samples) >= _LONG)
    ]


def backward_differences(
    data: Trajectories, names: Sequence[str], matches: Sequence[Match], twin: Twin | None
) -> list[BackwardDifference]:
    """
    :param data: at one interval
    :param names: of the observation channels
    :param matches: of the data
    :param twin: if its own velocities are backward differences (semi-implicit Euler), they are not
        reported; without a twin, only differences that carry the noise of the position are
    """
    found = {m.velocity: m for m in matches if m.agrees and m.difference.backward}
    simulated = _simulated_differences(data, twin, found) if twin and found else None
    return [
        BackwardDifference(
            names[v],
            all_samples(data),
            position=match.position,
            samples=0.5,
            seconds=0.5 * data.dt,
            stderr=0.0,
        )
        for v, match in found.items()
        if (match.difference.rough if simulated is None else v not in simulated)
    ]


def _simulated_differences(
    data: Trajectories, twin: Twin, found: Mapping[int, Match]
) -> set[int] | None:
    """Velocity channels that are backward differences in a simulation; None: it says nothing."""
    stretches = stretches_in(data)
    if stretches is None:
        return None
    obs = replayed(twin, stretches, np.ones(data.n_obs)).obs
    obs = obs[np.isfinite(obs).all((1, 2))]
    if not len(obs):
        return None
    own = set()
    for v, match in found.items():
        first, *second = (obs[..., part] for part in match.parts)
        position = np.unwrap(np.arctan2(second[0], first), axis=1) if second else first
        if _difference_of(list(zip(position, obs[..., v], strict=True)), data.dt).backward:
            own.add(v)
    return own


class _Difference(NamedTuple):
    """
    :param backward: whether a velocity is the backward difference of its position: it carries the
        same noise, or is the same number
    :param rough: whether it carries the noise of the position
    """

    backward: bool
    rough: bool


def _difference_of(pairs: Pairs, dt: float) -> _Difference:
    """
    Compare a velocity with the backward difference, and with a smoother one of equal delay.

    :param pairs: position and velocity of each episode
    """
    exact, smooth, bends = [], [], []
    for q, v in pairs:
        steps = np.diff(q) / dt
        exact.append(v[2:-1] - steps[1:-1])
        smooth.append(v[2:-1] - (steps[2:] + 2.0 * steps[1:-1] + steps[:-2]) / 4.0)
        bends.append(np.diff(q, 4))
    ours, others = (float(np.mean(np.concatenate(part) ** 2)) for part in (exact, smooth))
    products = sum(float(x[1:] @ x[:-1]) for x in bends)
    rough = bool(products < _ALTERNATES * sum(float(x @ x) for x in bends))
    share = _SAME_NOISE if rough else _SAME_NUMBER
    return _Difference(ours < share * others, rough)


def best_of(matches: Sequence[Match]) -> list[Match]:
    """:return: for each velocity, the position in the same unit that it matches best"""
    best: dict[int, Match] = {}
    for match in matches:
        v = match.velocity
        if match.agrees and (v not in best or match.scores.highest > best[v].scores.highest):
            best[v] = match
    return list(best.values())


def matches_of(data: Trajectories, names: Sequence[str]) -> list[Match]:
    """
    Pairs of a position and its velocity, found by their correlation.

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
        for parts, positions in _positions(episodes, v):
            pairs = [(q, x[:, v]) for q, x in zip(positions, episodes, strict=True)]
            for width in _WIDTHS:
                if any(len(x) <= 4 * reach + width for x in episodes):
                    continue
                scores = _Scores.of(pairs, data.dt, reach, width)
                if scores.highest > _CLEAR:
                    name = ", ".join(names[j] for j in parts)
                    found.append(Match(v, name, parts, pairs, data.dt, scores, width))
                    break
    return found


def _positions(
    episodes: Sequence[np.ndarray], v: int
) -> list[tuple[tuple[int, ...], list[np.ndarray]]]:
    """Candidate positions of channel v for each episode, unwrapped."""
    others = [j for j in range(episodes[0].shape[1]) if j != v]
    found: list[tuple[tuple[int, ...], list[np.ndarray]]]
    found = [((j,), [unwrapped(x[:, j]) for x in episodes]) for j in others]
    joined = np.concatenate(episodes)
    for c, s in itertools.permutations(others, 2):
        if np.sqrt(np.mean((joined[:, c] ** 2 + joined[:, s] ** 2 - 1.0) ** 2)) < _CIRCLE:
            angles = [np.unwrap(np.arctan2(x[:, s], x[:, c])) for x in episodes]
            found.append(((c, s), angles))
    return found


class _Scores(NamedTuple):
    """
    Cross-correlation of a velocity and a derivative, at shifts from -reach to reach samples.

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
