"""Values that jump: outliers, glitches, and resets of the state within a recording."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Int

from sb3_hds.data.audit.finding import Finding, Place
from sb3_hds.data.audit.segments import Segment, joined, steps_of
from sb3_hds.data.resampling.values import angle_wraps, runs

_TYPICAL = 0.98  # of the samples are within the typical range
_FAR = 20.0  # typical ranges from the median
_AT_ONCE = 0.5  # of the excursion, in the first and in the last step

_SPIKE_FAR = 10.0  # largest other steps of the recording
_NEIGHBOURS_APART = 0.2  # of the excursion: largest difference of the neighbours
_RARE = 0.01  # of the samples of a recording, but at least one: frequent spikes are noise
_TYPICAL_STEPS = 0.98  # of the steps of all recordings are within the typical range
_SMALLEST_SPIKE = 0.2  # of the range that 98 % of a channel's samples fill
# Turns: range of a wrapped angle with noise, and deviation of a wrap from one turn.
_ONE_TURN, _NEAR_TURN = 1.05, 0.16

_LARGE = 0.2  # of the standard deviation of a channel: smallest reset
_ISOLATED = 6.0  # times the steps around it
_NEAR_START = 0.05  # of the standard deviation of a channel
_AT_START = 1e-6  # of the standard deviation of a channel


@dataclasses.dataclass(frozen=True)
class Outliers(Finding):
    """
    Excursions far beyond the typical range, which would dominate a mean squared error.

    :param value: the most extreme outlier, in the unit of the channel
    :param low: lower end of the range that 98 % of the channel's samples fill
    :param high: upper end
    """

    blocks = True
    value: float
    low: float
    high: float

    @property
    def sentence(self) -> str:
        return (
            f"'{self.channel}' jumps to {self.value:.4g} and back, where 98 % of its samples are "
            f"between {self.low:.4g} and {self.high:.4g} ({self.where})."
        )

    remedy = (
        "Look at sensor and cable. audit.corrected(data), or --correct, cuts these samples out."
    )


@dataclasses.dataclass(frozen=True)
class Glitches(Outliers):
    """
    Single samples far from their neighbours.

    :param step: largest other step from sample to sample in these recordings
    """

    step: float

    @property
    def sentence(self) -> str:
        return (
            f"'{self.channel}' jumps to {self.value:.4g} and back in a single sample, where it "
            f"moves by {self.step:.3g} at most from one sample to the next "
            f"({self.where})."
        )


@dataclasses.dataclass(frozen=True)
class ReinitialisedState(Finding):
    """
    :param to_start: whether the state jumps to the start of a recording
    :param size: of the largest jump, in the unit of its channel
    """

    to_start: bool
    size: float

    @property
    def sentence(self) -> str:
        target = "to the start of a recording" if self.to_start else "unlike any motion"
        return (
            f"'{self.channel}' jumps by up to {self.size:.3g} from one sample to the next, "
            f"{target} ({self.where})."
        )

    remedy = (
        "The state was reset within the recording: audit.corrected(data), or --correct, cuts "
        "there. Or name the column that counts episodes when loading."
    )


def outliers(segments: Sequence[Segment], names: Sequence[str]) -> list[Outliers]:
    """
    Runs of samples far outside the typical range that begin and end with a single step.

    The response to an impact decays, and an unstable system does not return: neither matches.
    """
    found = []
    tail = 0.5 * (1.0 - _TYPICAL)
    low, middle, high = np.quantile(joined(segments), (tail, 0.5, 1.0 - tail), axis=0)
    for j, name in enumerate(names):
        farthest = _FAR * (high[j] - low[j])
        if farthest == 0.0:
            continue
        places, values = [], []
        for segment in segments:
            x = segment.obs[:, j] - middle[j]
            steps = np.abs(np.diff(x))
            for a, end in runs(np.abs(x) > farthest):
                leaves = a == 0 or steps[a - 1] > _AT_ONCE * abs(x[a])
                returns_at_once = end == len(x) or steps[end - 1] > _AT_ONCE * abs(x[end - 1])
                if leaves and returns_at_once and end - a < len(x):
                    places.append(segment.place(a, end - 1))
                    values.append(segment.obs[a:end, j][np.abs(x[a:end]).argmax()])
        if places:
            worst = max(values, key=lambda value: abs(value - middle[j]))
            found.append(Outliers(name, tuple(places), float(worst), float(low[j]), float(high[j])))
    return found


def glitches(
    segments: Sequence[Segment], names: Sequence[str], resolution: np.ndarray
) -> list[Glitches]:
    """
    Single samples between two opposite steps, both many times larger than any other step.

    Neither an impact nor a decaying response returns within one sample. A wrapping angle and the
    tick of an encoder at rest are not glitches.
    """
    found = []
    low, high = np.quantile(joined(segments), (0.01, 0.99), axis=0)
    steps = np.abs(steps_of(segments))
    typical = np.quantile(steps, _TYPICAL_STEPS, axis=0) if len(steps) else np.zeros(len(names))
    least = np.maximum(typical, 2.0 * resolution)
    least = np.maximum(least, _SMALLEST_SPIKE / _SPIKE_FAR * (high - low))
    for j, name in enumerate(names):
        places, values, largest = [], [], 0.0
        for segment in segments:
            x = segment.obs[:, j]
            rows, step = _spikes(x, float(least[j]))
            places += [segment.place(int(k), int(k)) for k in rows]
            values += x[rows].tolist()
            largest = max(largest, step if len(rows) else 0.0)
        if places:
            middle = 0.5 * (low[j] + high[j])
            worst = max(values, key=lambda value: abs(value - middle))
            span = float(low[j]), float(high[j])
            found.append(Glitches(name, tuple(places), worst, *span, largest))
    return found


def _spikes(x: np.ndarray, least: float) -> tuple[Int[np.ndarray, " rows"], float]:
    """
    :param least: lower bound of the step that spikes are compared with
    :return: rows of the spikes, and the largest other step
    """
    steps = np.diff(x)
    none = np.array([], dtype=int), 0.0
    if len(steps) < 4 or least == 0.0:
        return none
    size = np.minimum(np.abs(steps[:-1]), np.abs(steps[1:]))
    returns = np.abs(x[2:] - x[:-2]) < _NEIGHBOURS_APART * size
    candidates = np.flatnonzero(returns & (size > _SPIKE_FAR * least) & ~_is_wrap(x, size))
    candidates = candidates[np.argsort(-size[candidates])]
    most = max(1, int(_RARE * len(x)))
    for n in range(min(len(candidates), most), 0, -1):
        chosen = candidates[:n]
        rest = np.delete(np.abs(steps), np.union1d(chosen, chosen + 1))
        largest = float(rest.max(initial=0.0))
        if size[chosen[-1]] > _SPIKE_FAR * max(largest, least):
            return np.sort(chosen) + 1, largest
    return none


def _is_wrap(x: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Whether a step is a wrap of an angle whose range is one turn [rad] or [deg]."""
    turns = [turn for turn in (2.0 * np.pi, 360.0) if np.ptp(x) < _ONE_TURN * turn]
    return np.any([np.abs(size / turn - 1.0) < _NEAR_TURN for turn in turns], axis=0) & bool(turns)


def reinitialised(
    segments: Sequence[Segment], names: Sequence[str], resolution: np.ndarray
) -> list[ReinitialisedState]:
    """
    Resets of the state: steps many times larger than their neighbours, in several channels at once
    or back to the start of a recording; and steps of any size that lead exactly to that start.
    Quantised channels are exempt from the latter, because they return there by chance.

    A jump of a single channel has other explanations (an impact, an outlier), and full turns of an
    angle are not jumps.
    """
    steps, std = np.abs(steps_of(segments)), joined(segments).std(axis=0)
    curvatures = np.concatenate([_curvatures(segment.obs, std) for segment in segments])
    if not steps.any() or not len(curvatures):
        return []
    typical_step = np.quantile(steps[steps.any(axis=1)], 0.9, axis=0)
    sharp_curvature = np.quantile(curvatures, 0.9)
    starts = np.array([segment.obs[0] for segment in segments])
    at_start = _AT_START * std if (resolution == 0.0).any() else np.full(len(names), -1.0)
    places: dict[bool, list[Place]] = {True: [], False: []}
    sizes = {True: np.zeros(len(names)), False: np.zeros(len(names))}
    for segment in segments:
        jumps = np.diff(segment.obs, axis=0)
        large = np.abs(jumps) > np.maximum(_LARGE * std, 10.0 * resolution)
        large &= ~angle_wraps(jumps, typical_step)
        isolated = large & _isolated(jumps, typical_step)
        sharp = np.pad(_curvatures(segment.obs, std) > sharp_curvature, (1, 0))
        goes_on = np.append(jumps[1:].any(axis=1), True)
        for k in np.flatnonzero(large.any(axis=1)):
            distance = np.abs(segment.obs[k + 1] - starts)
            near_start = bool((distance <= _NEAR_START * std + 2.0 * typical_step).all(1).any())
            at_a_start = bool((distance <= at_start).all(1).any() and sharp[k] and goes_on[k])
            if at_a_start or isolated[k].sum() > (not near_start and len(names) > 1):
                to_start = near_start or at_a_start
                places[to_start].append(segment.place(int(k) + 1, int(k) + 1))
                sizes[to_start] = np.maximum(sizes[to_start], np.abs(jumps[k]) * large[k])
    return [
        ReinitialisedState(
            ", ".join(n for n, size in zip(names, sizes[to_start], strict=True) if size),
            tuple(places[to_start]),
            to_start,
            float(sizes[to_start].max()),
        )
        for to_start in (True, False)
        if places[to_start]
    ]


def _curvatures(x: np.ndarray, std: np.ndarray) -> np.ndarray:
    """Largest change of the step at each inner row, relative to the standard deviation."""
    return np.max(np.abs(np.diff(x, 2, axis=0)) / np.where(std > 0.0, std, np.inf), axis=1)


def _isolated(jumps: np.ndarray, typical: np.ndarray) -> np.ndarray:
    """Which steps are large relative to the two before, the two after, and the typical one."""
    size = np.abs(jumps)
    padded = np.pad(size, ((2, 2), (0, 0)))
    around = np.max([padded[i : i + len(size)] for i in (0, 1, 3, 4)], axis=0)
    return size > _ISOLATED * np.maximum(around, typical)
