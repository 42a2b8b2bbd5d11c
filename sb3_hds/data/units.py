"""Positions and velocities that cannot be what they are taken for: other units, or swapped."""

from collections.abc import Sequence

import numpy as np

from sb3_hds.core.signals import Channel
from sb3_hds.core.trajectories import Trajectories
from sb3_hds.data.finding import Place
from sb3_hds.data.findings import RPM, OtherUnits, Swapped
from sb3_hds.data.velocity import Match

# Factor: up to here `effects.SensorScale`, which is bounded to 0.1 to 10, gives it a name.
_BEYOND = 10.0
_RPM_NEAR = 0.05  # relative: a factor within those bounds that has a name of its own
_LATEST = 4.0  # samples: a pair whose lag is longer may be a sine and its second derivative
_ALIKE = 0.3  # largest difference of a block's slope from that of all data, for half of the blocks
_FEWEST = 3  # blocks
_SMOOTH = 0.2  # correlation of successive velocities: below, differences of positions are too small


def other_units(
    data: Trajectories, channels: Sequence[Channel], matches: Sequence[Match]
) -> list[OtherUnits]:
    """
    Velocities that are the derivative of a position but for a large factor, or that of revolutions
    per minute.

    Only of channels that belong to no other one as position or velocity: in an oscillation,
    everything is the derivative of something, but for a factor. Where units are known, they say
    what may be a velocity of what.

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
        OtherUnits(channels[v].name, _whole(data), match.position, 1.0 / match.scores.slope_there)
        for v, match in found.items()
    ]


def swapped(
    data: Trajectories, channels: Sequence[Channel], matches: Sequence[Match]
) -> list[Swapped]:
    """
    Channels that are a velocity by their unit, and of which a position is the derivative.

    :param data: at one interval
    :param channels: of the observation; nothing is found where they have no units
    :param matches: of the data
    """
    right = {j for m in matches if m.agrees and _known(m, channels) for j in (m.velocity, *m.parts)}
    return [
        Swapped(channels[m.velocity].name, _whole(data), channels[m.parts[0]].name)
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


def _whole(data: Trajectories) -> tuple[Place, ...]:
    return tuple(Place(f"trajectory {i}", 0, int(n), i) for i, n in enumerate(data.lengths))
