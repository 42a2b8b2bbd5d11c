"""Whether motion and commands excite the system enough for identification."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from sb3_hds.core.trajectories import Trajectories
from sb3_hds.data.audit.finding import Finding
from sb3_hds.data.audit.segments import Segment, all_samples, joined
from sb3_hds.data.wording import counted, percent

_SECONDS, _FEWEST, _MOST = 0.1, 12, 100  # length of a window, and its limits in rows
_WHITE_NOISE = 0.5  # mean squared step over variance: 2 for white noise, 0 for smooth motion
_SMALL = 0.3  # of the standard deviation of a channel: larger deviations are motion
_ONLY_NOISE = 3.0  # times the noise: a channel with a smaller standard deviation does not move
_NEEDED = 100  # steps: with fewer, hardly any effect is significant
_THROUGHOUT = 0.95  # share of the time
_MOSTLY = 0.8  # share of the time
_WEAK = 5.0  # noise
_DEPENDENT = 0.999  # share of the variance
_CONSTANT = 0.01  # of its largest value: a command that varies less does not excite its drive
_STROKE = 0.1  # of a channel's range, from one turning point to the next
# Half of the strokes propose causes and half confirm them. The logarithm of the mean squared error
# of a stroke has a standard deviation of about 0.5, so the mean over twenty has a standard error of
# 0.11, and a reduction by a fifth (0.22) is just significant at 2.5 %.
_STROKES = 40


@dataclasses.dataclass(frozen=True)
class StandingStill(Finding):
    """:param share: of the time during which nothing moves beyond noise"""

    blocks = True
    share: float

    @property
    def sentence(self) -> str:
        return (
            f"The system stands still {percent(self.share)} of the time "
            f"({self.recordings}): such data contain the sensor noise, but no motion."
        )

    remedy = "Record motion, with commands over the range of interest."


@dataclasses.dataclass(frozen=True)
class TooShort(Finding):
    """
    :param n_steps: number of steps
    :param needed: smallest number for a verdict
    """

    blocks = True
    n_steps: int
    needed: int

    @property
    def sentence(self) -> str:
        return f"There are {self.n_steps} steps in all; a verdict needs at least {self.needed}."

    remedy = "Record longer, or at a higher rate."


@dataclasses.dataclass(frozen=True)
class WeakMotion(Finding):
    """:param ratio: standard deviation of the channel over that of its noise"""

    ratio: float

    @property
    def sentence(self) -> str:
        return (
            f"'{self.channel}' moves by only {self.ratio:.1f} times its noise ({self.recordings})."
        )

    remedy = "Move it further: effects on it cannot be estimated from such small motion."


@dataclasses.dataclass(frozen=True)
class WithinNoise(Finding):
    """:param ratio: the largest ratio of a channel's standard deviation to that of its noise"""

    blocks = True
    ratio: float

    @property
    def sentence(self) -> str:
        return (
            f"No channel moves by more than {self.ratio:.1f} times its noise ({self.recordings})."
        )

    remedy = "Record larger motion: nothing can be estimated from these data."


@dataclasses.dataclass(frozen=True)
class MostlyStill(Finding):
    """:param share: of the time during which nothing moves beyond noise"""

    share: float

    @property
    def sentence(self) -> str:
        return f"The system stands still {percent(self.share)} of the time ({self.recordings})."

    remedy = "Only the remaining time is informative: record more motion."


@dataclasses.dataclass(frozen=True)
class PoorExcitation(Finding):
    """
    :param n_strokes: number of strokes of the channel, which has the most, in all recordings; a
        stroke covers at least a tenth of its range
    :param n_conditions: number of conditions
    """

    n_strokes: int
    n_conditions: int

    @property
    def sentence(self) -> str:
        return (
            "Excitation is poor: no channel moves back and forth more often than "
            f"'{self.channel}', {counted(self.n_strokes, 'stroke')} in "
            f"{counted(len(self.places), 'recording')} under "
            f"{counted(self.n_conditions, 'condition')} ({self.recordings})."
        )

    remedy = (
        "With so few strokes, an effect that removes less than a fifth of the error is hardly "
        "significant. Record more strokes at other speeds, and vary the load, the gain and the "
        "shape of the commands."
    )


@dataclasses.dataclass(frozen=True)
class ConstantCommand(Finding):
    """
    :param low: smallest value of the command, in its unit
    :param high: largest value, in its unit
    """

    low: float
    high: float

    @property
    def sentence(self) -> str:
        span = f"between {self.low:.5g} and {self.high:.5g}"
        value = span if f"{self.low:.4g}" != f"{self.high:.4g}" else f"{self.high:.4g}"
        return f"The command '{self.channel}' is {value} throughout ({self.recordings})."

    remedy = (
        "Gain, delay and lag of this actuator cannot be estimated from it. If it is intended (free "
        "swing), continue."
    )


@dataclasses.dataclass(frozen=True)
class DependentCommand(Finding):
    """:param r2: share of its variance that the observations explain"""

    r2: float

    @property
    def sentence(self) -> str:
        return (
            f"The command '{self.channel}' is a function of the simultaneous observations "
            f"(R2 = {self.r2:.5f}), as under linear feedback ({self.recordings})."
        )

    remedy = (
        "Feedback and dynamics cannot be distinguished in such data: add a signal to the command, "
        "or change the set point."
    )


class Stillness(NamedTuple):
    """
    :param share: of the time, in [0, 1]
    :param noise: standard deviation of each channel at rest, in its unit; nan if the system never
        rests
    """

    share: float
    noise: Float64[np.ndarray, " n_obs"]


def stillness_of(segments: list[Segment], resolution: Float64[np.ndarray, " n_obs"]) -> Stillness:
    """
    Detect rest in windows of 0.1 s: each channel either stays within two quantisation steps, or has
    a small standard deviation and the von Neumann ratio (mean squared step over variance) of white
    noise.

    :param segments: at least one
    :param resolution: smallest step of each channel, 0 if it is not quantised
    """
    parts = [part for part in map(_windows, segments) if len(part)]
    if not parts:
        return Stillness(0.0, np.full(len(resolution), np.nan))
    # Standard deviation, rms step and range, for each window and channel.
    std = np.concatenate([part.std(axis=1, ddof=1) for part in parts])
    step = np.concatenate([np.sqrt(np.mean(np.diff(p, axis=1) ** 2, axis=1)) for p in parts])
    width = np.concatenate([np.ptp(part, axis=1) for part in parts])
    overall = joined(segments).std(axis=0)
    jitters = step**2 >= _WHITE_NOISE * std**2
    floor = np.array(
        [np.median(s[j]) if j.any() else 0.0 for s, j in zip(std.T, jitters.T, strict=True)]
    )
    small = (std <= _SMALL * overall) | (overall <= _ONLY_NOISE * floor)
    still = ((width <= 2.01 * resolution) | (jitters & small)).all(axis=1)
    noise = (
        np.sqrt(np.mean(std[still] ** 2, axis=0)) if still.any() else np.full_like(floor, np.nan)
    )
    return Stillness(float(still.mean()), noise)


def _windows(segment: Segment) -> np.ndarray:
    """Rows in windows without overlap, shape ``(windows, rows, n_obs)``; drops the remainder."""
    length = int(np.clip(round(_SECONDS / segment.dt), _FEWEST, _MOST))
    n = len(segment.obs) // length
    return segment.obs[: n * length].reshape(n, length, segment.obs.shape[1])


def excitation(
    data: Trajectories, stillness: Stillness, obs: Sequence[str], actions: Sequence[str]
) -> list[Finding]:
    """
    :param data: at one interval
    :param stillness: of the same data
    :param obs: names of the observation channels
    :param actions: names of the action channels
    """
    places = all_samples(data)
    found: list[Finding] = []
    if data.n_steps < _NEEDED:
        found.append(TooShort("all channels", places, data.n_steps, _NEEDED))
    episodes = [data.episode(i) for i in range(len(data))]
    x, u = (
        np.concatenate(parts) for parts in zip(*((o[:-1], a) for o, a in episodes), strict=True)
    )
    moves = np.ptp(x, axis=0).any()
    if stillness.share >= _THROUGHOUT or not moves:
        return [*found, StandingStill("all channels", places, stillness.share if moves else 1.0)]
    if stillness.share >= _MOSTLY:
        found.append(MostlyStill("all channels", places, stillness.share))
    std = x.std(axis=0)
    ratios = std / np.maximum(stillness.noise, 1e-300)  # nan where the noise is not known
    if (ratios < _WEAK).all():
        return [*found, WithinNoise("all channels", places, float(ratios.max()))]
    weak = zip(obs, ratios.tolist(), strict=True)
    found += [WeakMotion(name, places, ratio) for name, ratio in weak if ratio < _WEAK]
    strokes = [_count_strokes([o[:, j] for o, _ in episodes]) for j in range(data.n_obs)]
    if max(strokes) < _STROKES:
        busiest = int(np.argmax(strokes))
        found.append(
            PoorExcitation(obs[busiest], places, strokes[busiest], len(set(data.conditions)))
        )
    for j, name in enumerate(actions):
        low, high = float(u[:, j].min()), float(u[:, j].max())
        if high - low <= _CONSTANT * max(abs(low), abs(high)):
            found.append(ConstantCommand(name, places, low, high))
        elif (r2 := _r2(x, u[:, j])) > _DEPENDENT:
            found.append(DependentCommand(name, places, r2))
    return found


def _count_strokes(recordings: Sequence[np.ndarray]) -> int:
    """Number of strokes (monotonic motions) of a channel, up to the required number."""
    least = _STROKE * (max(x.max() for x in recordings) - min(x.min() for x in recordings))
    n = 0
    for x in recordings:
        # Range since the last turning point, and direction of the stroke: 0 before the first one.
        low = high = float(x[0])
        direction = 0
        for value in x.tolist():
            low, high = min(low, value), max(high, value)
            if (direction < 1 and value - low > least) or (direction > -1 and high - value > least):
                direction = 1 if value - low > least and direction < 1 else -1
                low = high = value
                n += 1
                if n >= _STROKES:
                    return n
    return n


def _r2(x: np.ndarray, u: np.ndarray) -> float:
    """Share of the variance of u that is a linear function of x."""
    if len(x) < 10 * x.shape[1]:
        return 0.0
    regressors = np.column_stack([(x - x.mean(0)) / np.maximum(x.std(0), 1e-300), np.ones(len(x))])
    fitted = regressors @ np.linalg.lstsq(regressors, u, rcond=None)[0]
    return float(1.0 - np.var(u - fitted) / np.var(u))
