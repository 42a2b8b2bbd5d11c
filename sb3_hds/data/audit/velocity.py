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
from sb3_hds.data.audit.finding import Finding, Place
from sb3_hds.data.audit.replay import replay, windows_of
from sb3_hds.data.audit.segments import all_samples
from sb3_hds.data.resampling.values import unwrapped

_REACH = 0.05  # longest shift that is tried [s], but at least _FEWEST samples
_FEWEST, _MOST = 8, 100  # samples
_SHORTEST = 24  # steps of an episode; shorter ones are ignored
_PER_REACH = 4  # steps of an episode for each sample of the longest shift
_WIDTHS = (1, 3, 7, 15, 31)  # samples of the moving average; the first that identifies a pair
_MOST_ROWS, _STRETCH = 100_000, 10_000  # rows that are compared; longer data: stretches of them
_CLEAR = 0.95  # smallest correlation of a position's derivative with its velocity
_SAME_SCALE = 0.25  # largest difference of their ratio from 1
_CIRCLE = 0.1  # largest root mean square of cos^2 + sin^2 - 1
_BLOCKS, _FEWEST_BLOCKS = 12, 3
_SHORTEST_SHIFT = 0.75  # samples; half a sample is due to backward differences or Euler steps
_SIGMAS = 3.0
_VARIANCE_RATIO = 2.0  # smallest reduction of the unexplained variance by the shift, unless ...
_LONG = 2.0  # ... the shift is longer than this [samples]
# Largest ratio of mean squared deviations of a velocity from the backward difference and from a
# smoother one, if the difference is noisy, and if not. A smooth velocity half a sample late has
# 1/50.
_SAME_NOISE, _SAME_SIGNAL = 0.5, 2.5e-3
# Correlation of successive fourth differences: -0.8 for measurement noise, -0.67 under random
# forces, and more for smooth motion.
_NOISE_CORRELATION = -0.735

Signals = Sequence[tuple[np.ndarray, np.ndarray]]
"""Position and velocity of each episode, each of shape ``(rows,)``."""


@dataclasses.dataclass(frozen=True)
class VelocityShift(Finding):
    """
    :param position: name of the channel whose derivative it is
    :param samples: delay of the velocity [samples]; negative: it is early
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
        "Shift it: audit.corrected(data), or --correct. A filter in the drive is the usual cause; "
        "uncorrected, it passes for a delay or for friction."
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
        "Shift it: audit.corrected(data), or --correct. This is not a sensor delay. Do not shift "
        "it if the twin computes its velocity in the same way."
    )


@dataclasses.dataclass(frozen=True, eq=False)
class VelocityPair:
    """
    A channel that is proportional to the derivative of another one.

    :param velocity: channel
    :param name: of the velocity
    :param position: name of the position
    :param parts: channels of the position: one, or a cosine and a sine
    :param signals: position and velocity of each episode
    :param dt: sampling interval [s]
    :param scores: of the signals
    :param width: of the moving average [samples]
    :param places: all samples of the data
    """

    velocity: int
    name: str
    position: str
    parts: tuple[int, ...]
    signals: Signals
    dt: float
    scores: "_CrossCorrelation"
    width: int
    places: tuple[Place, ...]

    @property
    def same_unit(self) -> bool:
        """Whether both are in the same unit."""
        return abs(self.scores.peak_slope - 1.0) < _SAME_SCALE

    @property
    def channels(self) -> set[int]:
        """All channels of the pair."""
        return {self.velocity, *self.parts}

    @property
    def samples(self) -> float:
        """Delay [samples]; positive: the velocity was true that long before its position."""
        return self.scores.lag

    @functools.cached_property
    def stderr(self) -> float:
        """
        Standard error of ``samples``, from the scatter over blocks of the data; infinite, since
        unknown, where these are fewer than three.
        """
        lags = np.array([s.lag for s in self._block_scores() if s.peak > 0.5 * _CLEAR])
        if len(lags) < _FEWEST_BLOCKS:
            return np.inf
        # Robust, because blocks with little motion are inaccurate.
        sigma = 1.4826 * np.median(np.abs(lags - np.median(lags)))
        return float(sigma / np.sqrt(len(lags)))

    @functools.cached_property
    def difference(self) -> "_Difference":
        """How the velocity compares with the backward difference of the position."""
        return _difference_of(self.signals, self.dt)

    def slopes(self) -> Float64[np.ndarray, " blocks"]:
        """:return: slope of the velocity on the derivative at this lag, in blocks of the data"""
        there = self.scores.correlation.argmax()
        return np.array([block.slope[there] for block in self._block_scores()])

    def _block_scores(self) -> list["_CrossCorrelation"]:
        """The cross-correlation in parts of the episodes, or in episodes if parts are too short."""
        most = max(1, _BLOCKS // len(self.signals))
        reach = len(self.scores.slope) // 2
        least = 4 * reach + self.width + 1
        blocks = []
        for q, v in self.signals:
            n = max(1, min(most, len(q) // least))
            blocks += zip(np.array_split(q, n), np.array_split(v, n), strict=True)
        return [_CrossCorrelation.of([block], self.dt, reach, self.width) for block in blocks]


def velocity_shifts(pairs: Sequence[VelocityPair]) -> list[VelocityShift]:
    """
    :return: the significant lags beyond that of a backward difference that are either long or
        explain half of the residual variance
    """
    return [
        VelocityShift(
            pair.name,
            pair.places,
            position=pair.position,
            samples=pair.samples,
            seconds=pair.samples * pair.dt,
            stderr=pair.stderr,
        )
        for pair in best_pairs(pairs)
        if abs(pair.samples) >= max(_SHORTEST_SHIFT, _SIGMAS * pair.stderr)
        and (pair.scores.variance_ratio >= _VARIANCE_RATIO or abs(pair.samples) >= _LONG)
    ]


def backward_differences(
    data: Trajectories, pairs: Sequence[VelocityPair], twin: Twin | None
) -> list[BackwardDifference]:
    """
    :param data: at one interval
    :param pairs: of the data
    :param twin: if its own velocities are backward differences (semi-implicit Euler), they are not
        reported; without a twin, only differences that carry the noise of the position are
    """
    found = {m.velocity: m for m in pairs if m.same_unit and m.difference.is_backward}
    simulated = _backward_in_simulation(data, twin, found) if twin and found else None
    return [
        BackwardDifference(
            pair.name,
            pair.places,
            position=pair.position,
            samples=0.5,
            seconds=0.5 * pair.dt,
            stderr=0.0,
        )
        for v, pair in found.items()
        if (pair.difference.is_noisy if simulated is None else v not in simulated)
    ]


def _backward_in_simulation(
    data: Trajectories, twin: Twin, found: Mapping[int, VelocityPair]
) -> set[int] | None:
    """Velocity channels that are backward differences in a simulation; None if it is impossible."""
    windows = windows_of(data)
    if windows is None:
        return None
    obs = replay(twin, windows, np.ones(data.n_obs)).obs
    obs = obs[np.isfinite(obs).all((1, 2))]
    if not len(obs):
        return None
    own = set()
    for v, pair in found.items():
        first, *second = (obs[..., part] for part in pair.parts)
        position = np.unwrap(np.arctan2(second[0], first), axis=1) if second else first
        if _difference_of(list(zip(position, obs[..., v], strict=True)), data.dt).is_backward:
            own.add(v)
    return own


class _Difference(NamedTuple):
    """
    :param is_backward: whether a velocity is the backward difference of its position: it has the
        same noise, or the same values
    :param is_noisy: whether it contains the noise of the position
    """

    is_backward: bool
    is_noisy: bool


def _difference_of(signals: Signals, dt: float) -> _Difference:
    """
    Compare a velocity with the backward difference, and with a smoother one of equal delay.

    :param signals: position and velocity of each episode
    """
    exact, smooth, bends = [], [], []
    for q, v in signals:
        steps = np.diff(q) / dt
        exact.append(v[2:-1] - steps[1:-1])
        smooth.append(v[2:-1] - (steps[2:] + 2.0 * steps[1:-1] + steps[:-2]) / 4.0)
        bends.append(np.diff(q, 4))
    ours, others = (float(np.mean(np.concatenate(part) ** 2)) for part in (exact, smooth))
    products = sum(float(x[1:] @ x[:-1]) for x in bends)
    is_noisy = bool(products < _NOISE_CORRELATION * sum(float(x @ x) for x in bends))
    share = _SAME_NOISE if is_noisy else _SAME_SIGNAL
    return _Difference(ours < share * others, is_noisy)


def best_pairs(pairs: Sequence[VelocityPair]) -> list[VelocityPair]:
    """:return: for each velocity, the pair in the same unit with the highest correlation"""
    best: dict[int, VelocityPair] = {}
    for pair in pairs:
        v = pair.velocity
        if pair.same_unit and (v not in best or pair.scores.peak > best[v].scores.peak):
            best[v] = pair
    return list(best.values())


def velocity_pairs(data: Trajectories, names: Sequence[str]) -> list[VelocityPair]:
    """
    Pairs of a position and its velocity, found by their correlation.

    The velocity is compared with the central difference of the position, which has no delay, both
    smoothed by the same symmetric window. A parabola through the correlations around the best shift
    interpolates between samples. The angle of a cosine and a sine is a position, too.

    :param data: at one interval
    :param names: of the observation channels
    """
    episodes = [data.episode(i)[0] for i, n in enumerate(data.lengths) if n >= _SHORTEST]
    if not episodes:
        return []
    episodes = _stretches(episodes)
    wanted = int(np.clip(round(_REACH / data.dt), _FEWEST, _MOST))
    reach = min(wanted, *(len(x) // _PER_REACH for x in episodes))
    found = []
    for v in range(data.n_obs):
        for parts, positions in _positions(episodes, v):
            signals = [(q, x[:, v]) for q, x in zip(positions, episodes, strict=True)]
            for width in _WIDTHS:
                if any(len(x) <= 4 * reach + width for x in episodes):
                    continue
                scores = _CrossCorrelation.of(signals, data.dt, reach, width)
                if scores.peak > _CLEAR:
                    position = ", ".join(names[j] for j in parts)
                    about = (names[v], position, parts, signals, data.dt, scores, width)
                    found.append(VelocityPair(v, *about, all_samples(data)))
                    break
    return found


def _stretches(episodes: list[np.ndarray]) -> list[np.ndarray]:
    """All episodes, or evenly spaced stretches of them where they are long."""
    if sum(map(len, episodes)) <= _MOST_ROWS:
        return episodes
    parts = [part for x in episodes for part in np.array_split(x, max(len(x) // _STRETCH, 1))]
    chosen = np.linspace(0, len(parts) - 1, min(_MOST_ROWS // _STRETCH, len(parts)))
    return [parts[int(i)] for i in chosen]


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


class _CrossCorrelation(NamedTuple):
    """
    Cross-correlation of a velocity and a derivative, at shifts from -reach to reach samples.

    :param correlation: at each shift
    :param slope: of the velocity on the derivative
    """

    correlation: Float64[np.ndarray, " shifts"]
    slope: Float64[np.ndarray, " shifts"]

    @classmethod
    def of(cls, signals: Signals, dt: float, reach: int, width: int) -> "_CrossCorrelation":
        window = np.ones(width) / width
        moments = np.zeros((3, 2 * reach + 1))
        for q, v in signals:
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
    def peak(self) -> float:
        """The largest correlation."""
        return float(self.correlation.max())

    @property
    def peak_slope(self) -> float:
        """The slope where the correlation is largest."""
        return float(self.slope[self.correlation.argmax()])

    @property
    def variance_ratio(self) -> float:
        """Unexplained variance without a shift over that with the best one."""
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
