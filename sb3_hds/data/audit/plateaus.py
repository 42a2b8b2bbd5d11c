"""Values that do not change although the system moves: repeated, stuck, saturated, at a stop."""

import dataclasses
from collections.abc import Sequence
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sb3_hds.core.numerics.compilation import QUICKEST_COMPILATION
from sb3_hds.core.twin import Twin
from sb3_hds.core.types import Params
from sb3_hds.data.audit.finding import Finding, Place
from sb3_hds.data.audit.segments import Segment, joined, steps_of
from sb3_hds.data.resampling.values import runs
from sb3_hds.data.wording import percent
from sb3_hds.errors import first_names

_STEPS = 8.0  # smallest steps per sample: slower motion repeats values because of quantisation
_ROUGH = 3.0  # typical changes of the step: slower motion repeats values by chance
_REPEATED = 0.01  # of the moving samples
_FEWEST_REPEATED = 3
_FEW_CHANNELS = 3
_LONGEST_REPEAT = 5  # samples
_STEADY = (0.5, 1.6)  # of the speed: range of the steps around a repeated value
_STUCK = 20  # samples
_PLATEAU = 5  # samples
_MOVES, _CREEPS = 0.3, 0.05  # of the rms step of a channel
_MARGIN = 0.002  # of a joint's range: stops are soft, and sensors noisy


@dataclasses.dataclass(frozen=True)
class RepeatedSamples(Finding):
    """
    :param share: of the samples of a moving channel that repeat the one before; of several
        channels, the largest
    :param others: names of further channels that do so
    :param at_once: whether all channels do so in the same samples
    """

    share: float
    others: tuple[str, ...] = ()
    at_once: bool = False

    @property
    def sentence(self) -> str:
        seen = f"{percent(self.share)} of the moving samples ({self.where})."
        if self.at_once:
            n = 1 + len(self.others)
            return f"All {n} channels repeat their last values at once, in {seen}"
        if self.others:
            names = first_names([self.channel, *self.others])
            return f"{names} repeat their last values while they move, in up to {seen}"
        return f"'{self.channel}' repeats its last value while it moves, in {seen}"

    remedy = (
        "The sensor is read more often than it measures, or messages are logged twice: log at its "
        "rate, resample to it, or leave the repeated rows out."
    )


@dataclasses.dataclass(frozen=True)
class StuckChannel(Finding):
    """:param value: the constant value, in the unit of the channel"""

    value: float

    @property
    def sentence(self) -> str:
        return (
            f"'{self.channel}' stays at exactly {self.value:.4g} while other channels move "
            f"({self.where})."
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
            f"'{self.channel}' is clipped at {self.value:.4g}: {percent(self.share)} of its "
            f"samples have exactly this value ({self.where})."
        )

    remedy = (
        "Choose a larger range of the sensor, or leave these samples out. A mechanical stop looks "
        "the same; if there is one, the twin needs it, too."
    )


@dataclasses.dataclass(frozen=True)
class ReachedLimit(Finding):
    """
    :param value: end of the range of the joint
    :param unit: of the value
    :param share: of the samples that are at that end
    """

    value: float
    unit: str
    share: float

    @property
    def sentence(self) -> str:
        return (
            f"Joint '{self.channel}' is at its limit of {self.value:.4g} {self.unit} in "
            f"{percent(self.share)} of the samples ({self.where})."
        )

    remedy = (
        "The twin has no stops and cannot explain forces there: leave these samples out, or "
        "correct the range in the model file."
    )


def repeated_samples(
    segments: Sequence[Segment], names: Sequence[str], resolution: np.ndarray
) -> list[RepeatedSamples]:
    """
    Short runs of equal values in a moving channel.

    A channel without quantisation repeats a value only at rest or in saturation. A quantised
    channel also does so in slow motion, so only fast and steady motion counts there.
    """
    repeats = [_repeats(segments, j, step) for j, step in enumerate(resolution)]
    found = [
        RepeatedSamples(name, tuple(places), share)
        for name, (places, share) in zip(names, repeats, strict=True)
        if share > _REPEATED and len(places) >= _FEWEST_REPEATED
    ]
    places = [set(finding.places) for finding in found]
    together = set.intersection(*places) if len(found) == len(names) > 1 else set()
    at_once = len(together) > 0.8 * max(map(len, places), default=0)
    if not at_once and len(found) <= _FEW_CHANNELS:
        return found
    first, *others = found
    share = max(finding.share for finding in found)
    others = tuple(finding.channel for finding in others)
    return [dataclasses.replace(first, share=share, others=others, at_once=at_once)]


def _repeats(segments: Sequence[Segment], j: int, resolution: float) -> tuple[list[Place], float]:
    """Where channel j repeats a value, and the share of its moving samples that do."""
    everything = joined(segments)[:, j]
    natural = {0.0, float(everything.min()), float(everything.max())}
    bends = np.abs(np.concatenate([np.diff(s.obs[:, j], 2) for s in segments]))
    fast = max(_STEPS * resolution, _ROUGH * float(np.median(bends)) if len(bends) else 0.0)
    places, moving = [], 0
    for segment in segments:
        x = segment.obs[:, j]
        moving += int((np.abs(np.diff(x)) > (fast if resolution else 0.0)).sum())
        for a, b in runs(np.diff(x) == 0.0):
            inside = a >= 1 and b < len(x) - 1 and b - a <= _LONGEST_REPEAT
            if inside and (_moves_on(x, a, b, fast) if resolution else x[a] not in natural):
                places.append(segment.place(a + 1, b))
    n = sum(place.last - place.first + 1 for place in places)
    return places, n / max(moving + n, 1)


def _moves_on(x: np.ndarray, a: int, b: int, fast: float) -> bool:
    """Whether x moves fast and steadily up to row a and from row b on."""
    reach = 2 * _LONGEST_REPEAT
    before, after = np.diff(x[max(a - reach, 0) : a + 1]), np.diff(x[b : b + reach])
    steps = np.concatenate([before[before != 0.0][-2:], after[after != 0.0][:2]])
    if len(steps) < 4:
        return False
    speed = float(np.median(steps))
    low, high = _STEADY
    # The first step afterwards may include the missed motion.
    most = np.array([high, high, high * (b - a + 1), high])
    ratios = steps / speed if speed else np.zeros(4)
    return bool(abs(speed) > fast and (ratios > low).all() and (ratios < most).all())


def saturated(
    segments: Sequence[Segment], names: Sequence[str], resolution: np.ndarray
) -> list[SaturatedChannel]:
    """
    Channels that stay exactly at their extreme value while others move.

    They must reach it at speed, because turning points are flat, too, in particular after
    quantisation.
    """
    found = []
    rms_step = _rms_steps(segments)
    everything = joined(segments)
    for j, name in enumerate(names):
        quantised = resolution[j] > 0.0
        shortest = _PLATEAU if quantised else 2
        fast = max((_MOVES if quantised else _CREEPS) * rms_step[j], 3.0 * resolution[j])
        for value in {float(everything[:, j].min()), float(everything[:, j].max())}:
            places, n = [], 0
            for segment in segments:
                x = segment.obs[:, j]
                for a, b in runs((x[1:] == value) & (x[:-1] == value)):
                    arrives = b - a + 1 >= shortest and _abrupt(x, a, b, fast)
                    if arrives and _others_move(segment.obs[a : b + 1], j, rms_step):
                        places.append(segment.place(a, b))
                        n += b - a + 1
            if n >= _PLATEAU and np.ptp(everything[:, j]) > 0.0:
                found.append(SaturatedChannel(name, tuple(places), value, n / len(everything)))
    return found


def stuck(
    segments: Sequence[Segment], names: Sequence[str], resolution: np.ndarray
) -> list[StuckChannel]:
    """
    Channels that are constant while others move, in one recording or in all, or that stop abruptly
    or jump afterwards. A system that comes to rest does neither.
    """
    found = []
    rms_step = _rms_steps(segments)
    everything = joined(segments)
    for j, name in enumerate(names):
        extremes = everything[:, j].min(), everything[:, j].max()
        if extremes[0] == extremes[1]:
            if np.ptp(np.delete(everything, j, axis=1), axis=0).any():
                places = tuple(s.place(0, len(s.obs) - 1) for s in segments)
                found.append(DeadChannel(name, places, float(extremes[0])))
            continue
        fast = max(_MOVES * rms_step[j], 3.0 * resolution[j])
        for segment in segments:
            x = segment.obs[:, j]
            for a, b in runs(np.diff(x) == 0.0):
                throughout = b - a == len(x) - 1 and rms_step[j] > 3.0 * resolution[j]
                abrupt = x[a] not in extremes and _abrupt(x, a, b, fast)
                long = b - a >= _STUCK and (throughout or abrupt)
                if long and _others_move(segment.obs[a : b + 1], j, rms_step):
                    found.append(StuckChannel(name, (segment.place(a, b),), float(x[a])))
    return found


def _abrupt(x: np.ndarray, a: int, b: int, fast: float) -> bool:
    """Whether x stops at row a while it is fast, or jumps after row b."""
    stops = a >= 2 and min(abs(x[a] - x[a - 1]) * 2, abs(x[a - 1] - x[a - 2])) > fast
    jumps = b + 2 < len(x) and abs(x[b + 1] - x[b]) > max(4.0 * abs(x[b + 2] - x[b + 1]), fast)
    return bool(stops or jumps)


def _others_move(rows: np.ndarray, j: int, rms_step: np.ndarray) -> bool:
    """Whether any channel but j moves in these rows; True if there is no other."""
    steps = np.abs(np.diff(np.delete(rows, j, axis=1), axis=0))
    moving = np.median(steps, axis=0) > _MOVES * np.delete(rms_step, j)
    return bool(moving.any()) or not len(moving)


def _rms_steps(segments: Sequence[Segment]) -> np.ndarray:
    return np.sqrt(np.mean(np.square(steps_of(segments)), axis=0))


def reached_limits(segments: Sequence[Segment], twin: Twin) -> list[ReachedLimit]:
    """:return: one for each joint that reaches an end of the range that the twin declares"""
    limited = [
        (j, joint)
        for j, joint in enumerate(twin.joints)
        if np.isfinite(joint.low) and np.isfinite(joint.high)
    ]
    if not limited:
        return []
    with jax.enable_x64(True):
        coordinates = [
            np.asarray(_coordinates(twin, jnp.asarray(segment.obs), twin.params))
            for segment in segments
        ]
    n_rows = sum(map(len, coordinates))
    found = []
    for j, joint in limited:
        margin = _MARGIN * (joint.high - joint.low)
        for end, sign in ((joint.low, -1.0), (joint.high, 1.0)):
            there = [sign * (q[:, j] - end) >= -margin for q in coordinates]
            places = tuple(
                segment.place(a, b - 1)
                for segment, flags in zip(segments, there, strict=True)
                for a, b in runs(flags)
            )
            if places:
                share = sum(int(flags.sum()) for flags in there) / n_rows
                found.append(ReachedLimit(joint.name, places, float(end), joint.unit, share))
    return found


@partial(jax.jit, static_argnums=0, compiler_options=QUICKEST_COMPILATION)
def _coordinates(
    twin: Twin, obs: Float[Array, "rows n_obs"], params: Params
) -> Float[Array, "rows dof"]:
    return jax.vmap(lambda row: twin.coordinates(twin.infer(row, params).q))(obs)
