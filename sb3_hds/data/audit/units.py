"""Channels in other units than declared, and swapped positions and velocities."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np

from sb3_hds.core.declarations import Channel
from sb3_hds.core.trajectories import Trajectories
from sb3_hds.core.twin import Twin
from sb3_hds.data.audit.finding import Finding
from sb3_hds.data.audit.replay import position_channels, replay, windows_of
from sb3_hds.data.audit.segments import all_samples
from sb3_hds.data.audit.velocity import VelocityPair
from sb3_hds.data.wording import percent

# Factors between 0.1 and 10 are explained by `effects.SensorScale`, except for that of rpm.
_LARGE_FACTOR = 10.0
_RPM_NEAR = 0.05  # relative
_LONGEST_LAG = 4.0  # samples: a pair with a longer lag may be a sine and its second derivative
_SAME_SLOPE = 0.3  # largest relative difference of the slope of half of the blocks from the total
_FEWEST = 3  # blocks
_SMOOTH = 0.2  # smallest correlation of successive velocities


RPM = 30.0 / np.pi
"""Revolutions per minute of one radian per second."""
_FEWEST_WINDOWS = 6
# Unexplained share of the acceleration: at least this in the declared unit, and at most this in the
# other unit.
_MIN_UNEXPLAINED, _MAX_UNEXPLAINED = 0.6, 0.3
# For a suspicion, simulated over measured acceleration: at most this in the declared unit, and
# within these bounds in the other unit.
_TOO_SMALL, _ABOUT_RIGHT = 0.1, (0.4, 2.5)
_NEAR = 0.15  # relative error of the factor due to the central difference and noise


class _Unit(NamedTuple):
    name: str
    symbol: str
    of: str  # unit of the twin
    factor: float  # to the unit of the twin
    span: float  # of the measurements, in the unit of the twin, above which this unit is tried


_UNITS = (
    _Unit("degrees", "deg", "rad", np.pi / 180.0, 2.0 * np.pi),
    _Unit("millimetres", "mm", "m", 1e-3, 5.0),
    _Unit("centimetres", "cm", "m", 1e-2, 5.0),
)


@dataclasses.dataclass(frozen=True)
class OtherUnits(Finding):
    """
    A velocity that equals the derivative of a position times an implausibly large factor.

    :param position: name of the channel whose derivative it is
    :param factor: ratio of that derivative to the velocity
    """

    blocks = True
    position: str
    factor: float

    @property
    def sentence(self) -> str:
        return (
            f"'{self.position}' changes {self.factor:.3g} times as fast as '{self.channel}' says "
            f"({self.recordings}): one of them is in other units{self._likely}."
        )

    @property
    def _likely(self) -> str:
        for unit in _UNITS:
            for name, ratio in ((self.position, 1.0 / unit.factor), (self.channel, unit.factor)):
                if abs(self.factor / ratio - 1.0) < _NEAR:
                    return f", as if '{name}' were in {unit.name}"
        if abs(self.factor * RPM - 1.0) < _NEAR:
            return f", as if '{self.channel}' were in revolutions per minute"
        return ""

    remedy = (
        "Declare the unit of that channel in columns, as {column: NAME, unit: deg}, or rpm or mm, "
        "or its scale: 0.0174533 for degrees, 0.104720 for revolutions per minute, 0.001 for "
        "millimetres."
    )


@dataclasses.dataclass(frozen=True)
class MistakenUnits(Finding):
    """
    A position whose motion the twin only explains in another unit.

    :param column: its name in the log
    :param span: of its measurements
    :param unit: unit of the twin's channel
    :param other: name of the unit that fits
    :param symbol: symbol of that unit
    :param factor: from that unit to the twin's
    :param explained: share of the acceleration that the twin explains in that unit
    :param times: ratio of the measured to the simulated acceleration in the twin's unit
    """

    blocks = True
    column: str
    span: float
    unit: str
    other: str
    symbol: str
    factor: float
    explained: float
    times: float

    @property
    def sentence(self) -> str:
        return (
            f"'{self.channel}' spans {self.span:.3g} {self.unit}, and {self._why} "
            f"({self.recordings}). Write {{column: {self.column}, unit: {self.symbol}}}, "
            f"or scale it by {self.factor:.6g}."
        )

    @property
    def _why(self) -> str:
        return (
            f"the twin explains hardly any of its acceleration, but {percent(self.explained)} if "
            f"it is in {self.other}"
        )

    remedy = "Any effect that is identified from such data compensates for the factor."


@dataclasses.dataclass(frozen=True)
class LikelyUnits(MistakenUnits):
    """A position whose acceleration fits another unit in size, but not in shape."""

    blocks = False

    @property
    def _why(self) -> str:
        return (
            f"it accelerates {self.times:.2g} times as much as the twin, as if it were in "
            f"{self.other}"
        )


@dataclasses.dataclass(frozen=True)
class Swapped(Finding):
    """:param derivative_of: name of the channel that this one is the derivative of"""

    blocks = True
    derivative_of: str

    @property
    def sentence(self) -> str:
        return (
            f"'{self.channel}' should be a position and is the derivative of "
            f"'{self.derivative_of}', which should be its velocity ({self.recordings})."
        )

    remedy = "They are swapped: name the columns of obs in the order of the twin's channels."


def other_units(channels: Sequence[Channel], pairs: Sequence[VelocityPair]) -> list[OtherUnits]:
    """
    Velocities that equal the derivative of a position times a large factor, or the factor of
    revolutions per minute.

    Channels that already form a pair of position and velocity are excluded, because in an
    oscillation, every channel is proportional to the derivative of another one. Declared units
    restrict the pairs.

    :param channels: of the observation
    :param pairs: of the data
    """
    possible = [pair for pair in pairs if _is_declared_pair(pair, channels) is not False]
    taken = {j for pair in possible if pair.same_unit for j in pair.channels}
    far = [p for p in possible if not taken & p.channels and _has_large_factor(p)]
    # For each velocity, the position with the highest correlation comes last.
    far.sort(key=lambda pair: pair.scores.peak)
    return [
        OtherUnits(pair.name, pair.places, pair.position, 1.0 / pair.scores.peak_slope)
        for pair in {pair.velocity: pair for pair in far}.values()
    ]


def swapped(channels: Sequence[Channel], pairs: Sequence[VelocityPair]) -> list[Swapped]:
    """
    Pairs in which the channel with the unit of a position is the derivative of the other.

    :param channels: of the observation; those without units are ignored
    :param pairs: of the data
    """
    same = [pair for pair in pairs if pair.same_unit]
    right = {j for pair in same if _is_declared_pair(pair, channels) for j in pair.channels}
    return [
        Swapped(pair.name, pair.places, pair.position)
        for pair in same
        if abs(pair.scores.lag) <= _LONGEST_LAG
        and len(pair.parts) == 1
        and _is_rate(channels[pair.parts[0]].unit, channels[pair.velocity].unit)
        and not right & pair.channels
    ]


def _has_large_factor(pair: VelocityPair) -> bool:
    """Whether the factor is large and consistent over the data."""
    scores = pair.scores
    known = abs(scores.peak_slope / RPM - 1.0) < _RPM_NEAR
    usual = 1.0 / _LARGE_FACTOR <= scores.peak_slope <= _LARGE_FACTOR and not known
    if usual or abs(scores.lag) > _LONGEST_LAG:
        return False
    v = np.concatenate([v - v.mean() for _, v in pair.signals])
    slopes = pair.slopes()
    consistent = np.median(np.abs(slopes / scores.peak_slope - 1.0)) < _SAME_SLOPE
    return bool(len(slopes) >= _FEWEST and consistent and v[1:] @ v[:-1] > _SMOOTH * (v @ v))


def _is_declared_pair(pair: VelocityPair, channels: Sequence[Channel]) -> bool | None:
    """Whether the units are those of a position and its velocity; None if any is unknown."""
    units = [channels[j].unit for j in (pair.velocity, *pair.parts)]
    if not all(units):
        return None
    return _is_rate(units[0], "rad" if len(pair.parts) > 1 else units[1])


def _is_rate(velocity: str, position: str) -> bool:
    return bool(position) and velocity == f"{position}/s"


def mistaken_units(
    data: Trajectories, twin: Twin, channels: Sequence[Channel], columns: Sequence[str]
) -> list[MistakenUnits]:
    """
    Positions that span more than a turn, or 5 m, and whose acceleration the twin explains only in
    degrees, millimetres or centimetres.

    The twin is simulated for 0.3 s from measured states. In the right unit, it explains most of the
    acceleration even if its parameters are off by a third; in a wrong unit, nothing. Linear systems
    without other forces fit any unit and give no finding.

    :param data: at the twin's interval
    :param channels: of the observation, named as in reports
    :param columns: names of the channels in the log
    """
    units = [u for u in _UNITS if _exceeds_span(data, twin, u)]
    windows = windows_of(data) if units and not _has_quaternions(twin) else None
    if windows is None or len(windows.obs) < _FEWEST_WINDOWS:
        return []
    channel_of = position_channels(twin, windows)
    as_is = replay(twin, windows, np.ones(data.n_obs))
    low, high = _ABOUT_RIGHT
    found: dict[int, MistakenUnits] = {}
    for unit in units:
        scale = np.where([_has_unit(c, unit.of) for c in twin.channels], unit.factor, 1.0)
        converted = replay(twin, windows, scale)
        for joint, channel in channel_of.items():
            if twin.channels[channel].unit != unit.of:
                continue
            explained = 1.0 - float(converted.unexplained_share()[joint])
            ratio = as_is.acceleration_ratio()[joint]
            unexplained_as_is = as_is.unexplained_share()[joint]
            sure = unexplained_as_is >= _MIN_UNEXPLAINED and 1.0 - explained <= _MAX_UNEXPLAINED
            likely = ratio < _TOO_SMALL and low < converted.acceleration_ratio()[joint] < high
            best = found[joint].explained if joint in found else -np.inf
            if (sure or likely) and explained > best:
                kind = MistakenUnits if sure else LikelyUnits
                found[joint] = kind(
                    channels[channel].name,
                    all_samples(data),
                    column=columns[channel],
                    span=float(np.ptp(data.obs[..., channel])),
                    unit=unit.of,
                    other=unit.name,
                    symbol=unit.symbol,
                    factor=unit.factor,
                    explained=explained,
                    times=float(1.0 / max(ratio, 1e-6)),
                )
    return list(found.values())


def _exceeds_span(data: Trajectories, twin: Twin, unit: _Unit) -> bool:
    """Whether a position in the twin's unit has too large a span for it."""
    own = [i for i, channel in enumerate(twin.channels) if channel.unit == unit.of]
    return any(np.ptp(data.obs[..., i], axis=1).max() > unit.span for i in own)


def _has_unit(channel: Channel, unit: str) -> bool:
    return channel.unit in (unit, f"{unit}/s")


def _has_quaternions(twin: Twin) -> bool:
    """Whether there are more positions than velocities, so that some have no unit."""
    obs = jax.ShapeDtypeStruct((len(twin.channels),), float)
    state = jax.eval_shape(lambda obs: twin.infer(obs, twin.params), obs)
    return state.q.shape != state.v.shape
