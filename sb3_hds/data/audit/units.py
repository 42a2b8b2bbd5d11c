"""Channels in other units than declared, and swapped positions and velocities."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np

from sb3_hds.core.declarations import Channel
from sb3_hds.core.trajectories import Trajectories
from sb3_hds.core.twin import Twin
from sb3_hds.data.audit.finding import Finding, percent, recordings
from sb3_hds.data.audit.replay import position_channels, replayed, stretches_in
from sb3_hds.data.audit.stretches import all_samples
from sb3_hds.data.audit.velocity import Match

# Factor: up to here `effects.SensorScale`, which is bounded to 0.1 to 10, gives it a name.
_BEYOND = 10.0
_RPM_NEAR = 0.05  # relative: a factor within those bounds that has a name of its own
_LATEST = 4.0  # samples: a pair whose lag is longer may be a sine and its second derivative
_ALIKE = 0.3  # largest difference of a block's slope from that of all data, for half of the blocks
_FEWEST = 3  # blocks
_SMOOTH = 0.2  # correlation of successive velocities: below, differences of positions are too small


_FACTORS = {"degrees": 57.29578, "millimetres": 1000.0, "centimetres": 100.0}
RPM = 30.0 / 3.1415926536
"""Revolutions per minute of one radian per second."""
_NEAR = 0.15  # what a central difference and noise may change of the factor


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
        fast = f"changes {self.factor:.3g} times as fast as '{self.channel}' says"
        return (
            f"'{self.position}' {fast} ({recordings(self.places)}): one of them is in other units"
            f"{self._likely}."
        )

    @property
    def _likely(self) -> str:
        for unit, factor in _FACTORS.items():
            for name, ratio in ((self.position, factor), (self.channel, 1.0 / factor)):
                if abs(self.factor / ratio - 1.0) < _NEAR:
                    return f", as if '{name}' were in {unit}"
        if abs(self.factor * RPM - 1.0) < _NEAR:
            return f", as if '{self.channel}' were in revolutions per minute"
        return ""

    remedy = (
        "Give that one its unit in columns, as {column: NAME, unit: deg}, or rpm or mm, or its "
        "scale: 0.0174533 if it is in degrees, 0.104720 if it is in revolutions per minute, 0.001 "
        "if it is in millimetres."
    )


@dataclasses.dataclass(frozen=True)
class MistakenUnits(Finding):
    """
    A position that the twin can only follow in another unit.

    :param column: its name in the log
    :param span: of its measurements
    :param unit: unit of the twin's channel
    :param other: unit that fits, in words
    :param symbol: symbol of that unit
    :param factor: from that unit to the twin's
    :param explained: share of the acceleration that the twin then explains
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
            f"({recordings(self.places)}). Write {{column: {self.column}, unit: {self.symbol}}}, "
            f"or scale it by {self.factor:.6g}."
        )

    @property
    def _why(self) -> str:
        return (
            f"the twin explains hardly any of its acceleration, but {percent(self.explained)} if "
            f"it is in {self.other}"
        )

    remedy = "Whatever is named from such data makes up for the factor."


@dataclasses.dataclass(frozen=True)
class LikelyUnits(MistakenUnits):
    """The size of its acceleration fits another unit, but its course does not."""

    blocks = False

    @property
    def _why(self) -> str:
        return (
            f"it accelerates {self.times:.2g} times as much as the twin says, as if it were in "
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
            f"'{self.derivative_of}', which should be its velocity ({recordings(self.places)})."
        )

    remedy = "They are swapped: name the columns of obs in the order of the twin's channels."


def other_units(
    data: Trajectories, channels: Sequence[Channel], matches: Sequence[Match]
) -> list[OtherUnits]:
    """
    Velocities that equal the derivative of a position times a large factor, or the factor of
    revolutions per minute.

    Channels that already form a pair of position and velocity are excluded: in an oscillation,
    every channel is proportional to the derivative of some other. Known units restrict the pairs.

    :param data: at one interval
    :param channels: of the observation
    :param matches: of the data
    """
    own = [match for match in matches if match.agrees and _known(match, channels) is not False]
    taken = {j for match in own for j in (match.velocity, *match.parts)}
    far = [
        match
        for match in matches
        if not taken & {match.velocity, *match.parts}
        and _known(match, channels) is not False
        and _far(match, data.dt)
    ]
    # Of each velocity, the position that it follows best comes last.
    far.sort(key=lambda match: match.scores.highest)
    found = {match.velocity: match for match in far}
    return [
        OtherUnits(
            channels[v].name, all_samples(data), match.position, 1.0 / match.scores.slope_there
        )
        for v, match in found.items()
    ]


def swapped(
    data: Trajectories, channels: Sequence[Channel], matches: Sequence[Match]
) -> list[Swapped]:
    """
    Pairs in which the channel with the unit of a position is the derivative of the other.

    :param data: at one interval
    :param channels: of the observation; nothing is found where they have no units
    :param matches: of the data
    """
    right = {j for m in matches if m.agrees and _known(m, channels) for j in (m.velocity, *m.parts)}
    return [
        Swapped(channels[m.velocity].name, all_samples(data), channels[m.parts[0]].name)
        for m in matches
        if m.agrees
        and abs(m.scores.lag) <= _LATEST
        and len(m.parts) == 1
        and _is_rate(channels[m.parts[0]].unit, channels[m.velocity].unit)
        and not right & {m.velocity, *m.parts}
    ]


def _far(match: Match, dt: float) -> bool:
    """Whether the factor is large, beyond doubt, and about the same everywhere."""
    scores = match.scores
    known = abs(scores.slope_there / RPM - 1.0) < _RPM_NEAR
    usual = 1.0 / _BEYOND <= scores.slope_there <= _BEYOND and not known
    if usual or abs(scores.lag) > _LATEST:
        return False
    v = np.concatenate([v - v.mean() for _, v in match.pairs])
    slopes = match.slopes(dt)
    alike = np.median(np.abs(slopes / scores.slope_there - 1.0)) < _ALIKE
    return bool(len(slopes) >= _FEWEST and alike and v[1:] @ v[:-1] > _SMOOTH * (v @ v))


def _known(match: Match, channels: Sequence[Channel]) -> bool | None:
    """Whether the units are those of a position and its velocity; None: not all are known."""
    units = [channels[j].unit for j in (match.velocity, *match.parts)]
    if not all(units):
        return None
    return _is_rate(units[0], "rad" if len(match.parts) > 1 else units[1])


def _is_rate(velocity: str, position: str) -> bool:
    return bool(position) and velocity == f"{position}/s"


_FEWEST_STRETCHES = 6  # stretches
# Share of its acceleration that the twin leaves unexplained, as it is at least, and in the other
# unit at most, to be sure.
_NOTHING, _MOST = 0.6, 0.3
# The twin's acceleration by the measured one, for a suspicion: as it is at most, in the other unit
# within these bounds.
_TOO_SMALL, _ABOUT_RIGHT = 0.1, (0.4, 2.5)


class _Unit(NamedTuple):
    name: str
    symbol: str
    of: str  # unit of the twin
    factor: float
    span: float  # of the measurements from which the other unit comes to mind


_UNITS = (
    _Unit("degrees", "deg", "rad", np.pi / 180.0, 2.0 * np.pi),
    _Unit("millimetres", "mm", "m", 1e-3, 5.0),
    _Unit("centimetres", "cm", "m", 1e-2, 5.0),
)


def mistaken_units(
    data: Trajectories, twin: Twin, channels: Sequence[Channel], columns: Sequence[str]
) -> list[MistakenUnits]:
    """
    Positions that span more than a turn, or 5 m, and whose acceleration the twin explains only in
    degrees, millimetres or centimetres.

    The twin is simulated for 0.3 s from measured states. In the right unit it explains most of the
    acceleration even if its parameters are off by a third, in a wrong one nothing. Linear systems
    without other forces fit any unit and give no finding.

    :param data: at the twin's interval
    :param channels: of the observation, named as in reports
    :param columns: names of the channels in the log
    """
    units = [u for u in _UNITS if _spans(data, twin, u)]
    stretches = stretches_in(data) if units and not _has_quaternions(twin) else None
    if stretches is None or len(stretches.obs) < _FEWEST_STRETCHES:
        return []
    channel_of = position_channels(twin, stretches)
    as_is = replayed(twin, stretches, np.ones(data.n_obs))
    found: dict[int, tuple[float, MistakenUnits]] = {}
    for unit in units:
        scale = np.where([_is_of(c, unit.of) for c in twin.channels], unit.factor, 1.0)
        then = replayed(twin, stretches, scale)
        for joint, channel in channel_of.items():
            if twin.channels[channel].unit != unit.of:
                continue
            left, times = then.unexplained()[joint], as_is.predicted()[joint]
            sure = as_is.unexplained()[joint] >= _NOTHING and left <= _MOST
            low, high = _ABOUT_RIGHT
            likely = times < _TOO_SMALL and low < then.predicted()[joint] < high
            if (sure or likely) and left < found.get(joint, (np.inf,))[0]:
                kind = MistakenUnits if sure else LikelyUnits
                found[joint] = (
                    float(left),
                    kind(
                        channels[channel].name,
                        all_samples(data),
                        column=columns[channel],
                        span=float(np.ptp(data.obs[..., channel])),
                        unit=unit.of,
                        other=unit.name,
                        symbol=unit.symbol,
                        factor=unit.factor,
                        explained=float(1.0 - left),
                        times=float(1.0 / max(times, 1e-6)),
                    ),
                )
    return [finding for _, finding in found.values()]


def _spans(data: Trajectories, twin: Twin, unit: _Unit) -> bool:
    """Whether some position of that unit spans so much that another one comes to mind."""
    own = [i for i, channel in enumerate(twin.channels) if channel.unit == unit.of]
    return any(np.ptp(data.obs[..., i], axis=1).max() > unit.span for i in own)


def _is_of(channel: Channel, unit: str) -> bool:
    return channel.unit in (unit, f"{unit}/s")


def _has_quaternions(twin: Twin) -> bool:
    """Whether positions are longer than velocities, so that they have no unit of their own."""
    obs = jax.ShapeDtypeStruct((len(twin.channels),), float)
    state = jax.eval_shape(lambda obs: twin.infer(obs, twin.params), obs)
    return state.q.shape != state.v.shape
