"""Implausible values: repeated, stuck, saturated, or reset within a recording."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sb3_hds.data.audit.finding import Finding, Place, listed, percent
from sb3_hds.data.audit.stretches import Stretch, joined, runs
from sb3_hds.data.resampling.values import whole_turns

_STEPS = 8.0  # smallest steps per sample: slower motion repeats values because of quantisation
_ROUGH = 3.0  # typical changes of the step from sample to sample: slower motion does so by chance
_REPEATED = 0.01  # of the moving samples
_FEWEST_REPEATED = 3
_LONGEST_REPEAT = 5  # samples
_STEADY = (0.5, 1.6)  # of the speed: steps around a repeated value, or it may be a coincidence
_STUCK = 20  # samples
_PLATEAU = 5  # samples
_MOVES, _CREEPS = 0.3, 0.05  # of the usual step of a channel
_LARGE = 0.2  # of the standard deviation of a channel: what a jump exceeds
_ISOLATED = 6.0  # times the steps around it
_NEAR_START = 0.05  # of the standard deviation of a channel
_AT_START = 1e-6  # of the standard deviation of a channel


@dataclasses.dataclass(frozen=True)
class RepeatedSamples(Finding):
    """:param share: of the samples of a moving channel that repeat the one before"""

    share: float

    @property
    def sentence(self) -> str:
        return (
            f"'{self.channel}' repeats its last value while it moves, in {percent(self.share)} of "
            f"its moving samples ({listed(self.places)})."
        )

    remedy = "The sensor is read more often than it measures: log at its rate, or resample to it."


@dataclasses.dataclass(frozen=True)
class StuckChannel(Finding):
    """:param value: the constant value, in the unit of the channel"""

    value: float

    @property
    def sentence(self) -> str:
        return (
            f"'{self.channel}' stays at exactly {self.value:.4g} while other channels move "
            f"({listed(self.places)})."
        )

    remedy = "Check cable and driver of this sensor; leave the channel or these samples out."


@dataclasses.dataclass(frozen=True)
class DeadChannel(StuckChannel):
    """A channel that is stuck in all recordings, so that any cause could explain it."""

    blocks = True
    remedy = "Check cable and driver of this sensor, or leave the channel out."


@dataclasses.dataclass(frozen=True)
class SaturatedChannel(Finding):
    """
    :param value: the limit, in the unit of the channel
    :param share: of the samples that are at the limit
    """

    value: float
    share: float

    @property
    def sentence(self) -> str:
        return (
            f"'{self.channel}' is cut off at {self.value:.4g}: {percent(self.share)} of its "
            f"samples are exactly there ({listed(self.places)})."
        )

    remedy = (
        "Choose a larger range of the sensor, or leave these samples out. A mechanical stop looks "
        "the same: then the twin needs one."
    )


@dataclasses.dataclass(frozen=True)
class ReinitialisedState(Finding):
    """
    :param to_start: whether the state jumps to where a recording begins
    :param size: of the largest jump, in the unit of its channel
    """

    to_start: bool
    size: float

    @property
    def sentence(self) -> str:
        target = "to where a recording begins" if self.to_start else "as no motion does"
        return (
            f"'{self.channel}' jumps by up to {self.size:.3g} from one sample to the next, "
            f"{target} ({listed(self.places)})."
        )

    remedy = (
        "The system was put back inside the recording: audit.corrected(data) cuts there. Or name "
        "the column that counts episodes when loading."
    )


def repeated_samples(
    stretches: Sequence[Stretch], names: Sequence[str], resolution: np.ndarray
) -> list[RepeatedSamples]:
    """
    Short runs of equal values in a moving channel.

    A channel without quantisation repeats a value only at rest or in saturation. A quantised
    channel also does in slow motion, so there only fast and steady motion counts.
    """
    repeats = [_repeats(stretches, j, step) for j, step in enumerate(resolution)]
    found = [
        RepeatedSamples(name, tuple(places), share)
        for name, (places, share) in zip(names, repeats, strict=True)
        if share > _REPEATED and len(places) >= _FEWEST_REPEATED
    ]
    places = [set(finding.places) for finding in found]
    together = set.intersection(*places) if len(found) == len(names) > 1 else set()
    if len(together) > 0.8 * max(map(len, places), default=0):
        return [RepeatedSamples(", ".join(names), found[0].places, found[0].share)]
    return found


def _repeats(stretches: Sequence[Stretch], j: int, resolution: float) -> tuple[list[Place], float]:
    """Where channel j repeats a value, and the share of its moving samples that do."""
    x = np.concatenate([stretch.obs[:, j] for stretch in stretches])
    natural = {0.0, float(x.min()), float(x.max())}
    bends = np.abs(np.concatenate([np.diff(s.obs[:, j], 2) for s in stretches]))
    fast = max(_STEPS * resolution, _ROUGH * float(np.median(bends)) if len(bends) else 0.0)
    places, moving = [], 0
    for stretch in stretches:
        x = stretch.obs[:, j]
        moving += int((np.abs(np.diff(x)) > (fast if resolution else 0.0)).sum())
        for a, b in runs(np.diff(x) == 0.0):
            inside = a >= 1 and b < len(x) - 1 and b - a <= _LONGEST_REPEAT
            if inside and (_moves_on(x, a, b, fast) if resolution else x[a] not in natural):
                places.append(stretch.place(a + 1, b))
    n = sum(place.last - place.first + 1 for place in places)
    return places, n / max(moving + n, 1)


def saturated(
    stretches: Sequence[Stretch], names: Sequence[str], resolution: np.ndarray
) -> list[SaturatedChannel]:
    """
    Channels that stay exactly at their extreme value while others move.

    They must reach it at speed: turning points are flat, too, in particular after quantisation.
    """
    found = []
    usual = _usual_steps(stretches)
    everything = joined(stretches)
    for j, name in enumerate(names):
        quantised = resolution[j] > 0.0
        shortest = _PLATEAU if quantised else 2
        fast = max((_MOVES if quantised else _CREEPS) * usual[j], 3.0 * resolution[j])
        for value in {float(everything[:, j].min()), float(everything[:, j].max())}:
            places, n = [], 0
            for stretch in stretches:
                x = stretch.obs[:, j]
                for a, b in runs((x[1:] == value) & (x[:-1] == value)):
                    arrives = b - a + 1 >= shortest and _abrupt(x, a, b, fast)
                    if arrives and _others_move(stretch.obs[a : b + 1], j, usual):
                        places.append(stretch.place(a, b))
                        n += b - a + 1
            if n >= _PLATEAU and np.ptp(everything[:, j]) > 0.0:
                found.append(SaturatedChannel(name, tuple(places), value, n / len(everything)))
    return found


def stuck(
    stretches: Sequence[Stretch], names: Sequence[str], resolution: np.ndarray
) -> list[StuckChannel]:
    """
    Channels that are constant while others move, in one recording or in all, or that stop abruptly
    or jump afterwards. A system that comes to rest does neither.
    """
    found = []
    usual = _usual_steps(stretches)
    everything = joined(stretches)
    for j, name in enumerate(names):
        extremes = everything[:, j].min(), everything[:, j].max()
        if extremes[0] == extremes[1]:
            if np.ptp(np.delete(everything, j, axis=1), axis=0).any():
                whole = tuple(s.place(0, len(s.obs) - 1) for s in stretches)
                found.append(DeadChannel(name, whole, float(extremes[0])))
            continue
        fast = max(_MOVES * usual[j], 3.0 * resolution[j])
        for stretch in stretches:
            x = stretch.obs[:, j]
            for a, b in runs(np.diff(x) == 0.0):
                throughout = b - a == len(x) - 1 and usual[j] > 3.0 * resolution[j]
                abrupt = x[a] not in extremes and _abrupt(x, a, b, fast)
                long = b - a >= _STUCK and (throughout or abrupt)
                if long and _others_move(stretch.obs[a : b + 1], j, usual):
                    found.append(StuckChannel(name, (stretch.place(a, b),), float(x[a])))
    return found


def reinitialised(
    stretches: Sequence[Stretch], names: Sequence[str], resolution: np.ndarray
) -> list[ReinitialisedState]:
    """
    Resets of the state: steps many times larger than their neighbours, in several channels at once
    or back to the start of a recording; and steps of any size that lead exactly to that start.
    Quantised channels are exempt from the latter, because they return there by chance.

    A jump of a single channel has other explanations (an impact, an outlier), and whole turns of an
    angle are not jumps.
    """
    usual = _Usual.of(stretches)
    if usual is None:
        return []
    at_start = _AT_START * usual.std if (resolution == 0.0).any() else np.full(len(names), -1.0)
    places: dict[bool, list[Place]] = {True: [], False: []}
    sizes = {True: np.zeros(len(names)), False: np.zeros(len(names))}
    for stretch in stretches:
        jumps = np.diff(stretch.obs, axis=0)
        large = np.abs(jumps) > np.maximum(_LARGE * usual.std, 10.0 * resolution)
        large &= ~whole_turns(jumps, usual.step)
        isolated = large & _isolated(jumps, usual.step)
        sharp = np.pad(_bends(stretch.obs, usual.std) > usual.bend, (1, 0))
        goes_on = np.append(jumps[1:].any(axis=1), True)
        for k in np.flatnonzero(large.any(axis=1)):
            away = np.abs(stretch.obs[k + 1] - usual.starts)
            back = bool((away <= _NEAR_START * usual.std + 2.0 * usual.step).all(1).any())
            exactly = bool((away <= at_start).all(1).any() and sharp[k] and goes_on[k])
            if exactly or isolated[k].sum() > (not back and len(names) > 1):
                to_start = back or exactly
                places[to_start].append(stretch.place(int(k) + 1, int(k) + 1))
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


class _Usual(NamedTuple):
    """
    Typical motion over all recordings.

    :param step: 90 % quantile of the step from sample to sample, for each channel
    :param bend: 90 % quantile of the change of the step, in units of ``std``
    :param std: standard deviation of each channel
    :param starts: first sample of each recording
    """

    step: np.ndarray
    bend: float
    std: np.ndarray
    starts: np.ndarray

    @classmethod
    def of(cls, stretches: Sequence[Stretch]) -> "_Usual | None":
        steps = np.abs(np.concatenate([np.diff(stretch.obs, axis=0) for stretch in stretches]))
        moving = steps[steps.any(axis=1)]
        std = joined(stretches).std(axis=0)
        bends = np.concatenate([_bends(stretch.obs, std) for stretch in stretches])
        if not len(moving) or not len(bends):
            return None
        starts = np.array([stretch.obs[0] for stretch in stretches])
        return cls(np.quantile(moving, 0.9, 0), float(np.quantile(bends, 0.9)), std, starts)


def _bends(x: np.ndarray, std: np.ndarray) -> np.ndarray:
    """Largest change of the step at each inner row, in units of the standard deviation."""
    return np.max(np.abs(np.diff(x, 2, axis=0)) / np.where(std > 0.0, std, np.inf), axis=1)


def _moves_on(x: np.ndarray, a: int, b: int, fast: float) -> bool:
    """Whether x moves fast and steadily up to row a and from row b on."""
    reach = 2 * _LONGEST_REPEAT
    before, after = np.diff(x[max(a - reach, 0) : a + 1]), np.diff(x[b : b + reach])
    before, after = before[before != 0.0][-2:], after[after != 0.0][:2]
    if len(before) < 2 or len(after) < 2:
        return False
    speed = float(np.median([*before, *after]))
    low, high = _STEADY
    # The first step afterwards may make up for what was missed.
    most = np.array([high, high, high * (b - a + 1), high])
    ratios = np.array([*before, *after]) / speed if speed else np.zeros(4)
    return bool(abs(speed) > fast and (ratios > low).all() and (ratios < most).all())


def _abrupt(x: np.ndarray, a: int, b: int, fast: float) -> bool:
    """Whether x stops at row a while it is fast, or jumps after row b."""
    stops = a >= 2 and min(abs(x[a] - x[a - 1]) * 2, abs(x[a - 1] - x[a - 2])) > fast
    jumps = b + 2 < len(x) and abs(x[b + 1] - x[b]) > max(4.0 * abs(x[b + 2] - x[b + 1]), fast)
    return bool(stops or jumps)


def _others_move(rows: np.ndarray, j: int, usual: np.ndarray) -> bool:
    steps = np.abs(np.diff(np.delete(rows, j, axis=1), axis=0))
    return not steps.shape[1] or bool(
        (np.median(steps, axis=0) > _MOVES * np.delete(usual, j)).any()
    )


def _usual_steps(stretches: Sequence[Stretch]) -> np.ndarray:
    steps = np.concatenate([np.diff(stretch.obs, axis=0) for stretch in stretches])
    return np.sqrt(np.mean(np.square(steps), axis=0))


def _isolated(jumps: np.ndarray, usual: np.ndarray) -> np.ndarray:
    """Which steps are large beside the two before, the two after, and the usual one."""
    size = np.abs(jumps)
    padded = np.pad(size, ((2, 2), (0, 0)))
    around = np.max([padded[i : i + len(size)] for i in (0, 1, 3, 4)], axis=0)
    return size > _ISOLATED * np.maximum(around, usual)
