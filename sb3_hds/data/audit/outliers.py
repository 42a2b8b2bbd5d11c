"""Outliers: values that a physical system cannot reach, and leave, within one sample."""

import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Int

from sb3_hds.data.audit.finding import Finding, listed
from sb3_hds.data.audit.stretches import Stretch, joined, runs

_USUAL = 0.98  # of the samples: the range that they fill is the usual one
_FAR = 20.0  # usual ranges from the median
_AT_ONCE = 0.5  # of the way there, and of the way back, in one sample


@dataclasses.dataclass(frozen=True)
class Outliers(Finding):
    """
    Excursions far beyond the usual range, which would dominate a mean squared error.

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
            f"between {self.low:.4g} and {self.high:.4g} ({listed(self.places)})."
        )

    remedy = "Look at sensor and cable. audit.corrected(data) cuts these samples out."


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
            f"({listed(self.places)})."
        )


def outliers(stretches: Sequence[Stretch], names: Sequence[str]) -> list[Outliers]:
    """
    Runs of samples far beyond the usual range that begin and end with a single step.

    The response to an impact decays, and an unstable system does not return: neither matches.
    """
    found = []
    tail = 0.5 * (1.0 - _USUAL)
    everything = joined(stretches)
    low, middle, high = np.quantile(everything, (tail, 0.5, 1.0 - tail), axis=0)
    for j, name in enumerate(names):
        farthest = _FAR * (high[j] - low[j])
        if farthest == 0.0:
            continue
        places, values = [], []
        for stretch in stretches:
            x = stretch.obs[:, j] - middle[j]
            for a, b in _excursions(x, farthest):
                places.append(stretch.place(a, b))
                values.append(stretch.obs[a : b + 1, j][np.abs(x[a : b + 1]).argmax()])
        if places:
            worst = max(values, key=lambda value: abs(value - middle[j]))
            found.append(Outliers(name, tuple(places), float(worst), float(low[j]), float(high[j])))
    return found


def _excursions(x: np.ndarray, farthest: float) -> Iterator[tuple[int, int]]:
    """First and last row of each run beyond that begins and ends at once, or with the recording."""
    steps = np.abs(np.diff(x))
    for a, end in runs(np.abs(x) > farthest):
        goes = a == 0 or steps[a - 1] > _AT_ONCE * abs(x[a])
        comes = end == len(x) or steps[end - 1] > _AT_ONCE * abs(x[end - 1])
        if goes and comes and end - a < len(x):
            yield a, end - 1


_SPIKE_FAR = 10.0  # largest other steps of the recording
_NEIGHBOURS_APART = 0.2  # of the way there: how far the neighbours may be apart
_RARE = 0.01  # of the samples of a recording, but at least one: what is frequent is noise
_USUAL_STEPS = 0.98  # of the steps of all recordings: the range that is usual
_LARGE = 0.2  # of the range that 98 % of a channel's samples fill

# Turns that a wrapped angle fills with its noise, and how far a step may be from one.
_ONE_TURN, _NEAR_TURN = 1.05, 0.16


def glitches(
    stretches: Sequence[Stretch], names: Sequence[str], resolution: np.ndarray
) -> list[Glitches]:
    """
    Single samples between two opposite steps, both many times larger than any other step.

    Neither an impact nor a decaying response returns within one sample. A wrapping angle and the
    tick of an encoder at rest are not glitches.
    """
    found = []
    everything = joined(stretches)
    low, high = np.quantile(everything, (0.01, 0.99), axis=0)
    steps = np.abs(np.concatenate([np.diff(stretch.obs, axis=0) for stretch in stretches]))
    usual = np.quantile(steps, _USUAL_STEPS, axis=0) if len(steps) else np.zeros(len(names))
    for j, name in enumerate(names):
        places, values, largest = [], [], 0.0
        for stretch in stretches:
            x = stretch.obs[:, j]
            least = max(usual[j], 2.0 * resolution[j], _LARGE / _SPIKE_FAR * (high[j] - low[j]))
            rows, step = _spikes(x, float(least))
            places += [stretch.place(int(k), int(k)) for k in rows]
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
    candidates = np.flatnonzero(returns & (size > _SPIKE_FAR * least) & ~_turns(x, size))
    candidates = candidates[np.argsort(-size[candidates])]
    most = max(1, int(_RARE * len(x)))
    for n in range(min(len(candidates), most), 0, -1):
        chosen = candidates[:n]
        rest = np.delete(np.abs(steps), np.union1d(chosen, chosen + 1))
        largest = max(float(rest.max(initial=0.0)), least)
        if size[chosen[-1]] > _SPIKE_FAR * largest:
            return np.sort(chosen) + 1, float(rest.max(initial=0.0))
    return none


def _turns(x: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Whether a step is one turn of a wrapped angle [rad] or [deg], which fills one turn."""
    turns = [turn for turn in (2.0 * np.pi, 360.0) if np.ptp(x) < _ONE_TURN * turn]
    return np.any([np.abs(size / turn - 1.0) < _NEAR_TURN for turn in turns], axis=0) & bool(turns)
