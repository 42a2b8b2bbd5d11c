"""Positions that a twin follows only if they are read in another unit."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np

from sb3_hds.core.signals import Channel
from sb3_hds.core.trajectories import Trajectories
from sb3_hds.core.twin import Twin
from sb3_hds.data.finding import Place
from sb3_hds.data.findings import LikelyUnits, MistakenUnits
from sb3_hds.data.replay import position_channels, replayed, stretches_in

_FEWEST = 6  # stretches
# Share of its acceleration that the twin leaves unexplained, as it is at least, and in the other
# unit at most, to be sure.
_NOTHING, _MOST = 0.6, 0.3
# The twin's acceleration by the measured one, for a suspicion: as it is at most, in the other unit
# within these bounds.
_TOO_SMALL, _ALIKE = 0.1, (0.4, 2.5)


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
    Positions that span more than a turn, or 5 m, and that accelerate as the twin says only if they
    are in degrees, millimetres or centimetres.

    The twin is simulated for 0.3 s from measured states. In another unit than its own, it explains
    nothing of the acceleration; in the right one, most of it, even if its parameters are off by a
    third. Motion without forces, or under forces that are proportional to it, fits any unit: there
    is no finding then.

    :param data: at the twin's interval
    :param channels: of the observation, named as in reports
    :param columns: their names in the log
    """
    units = [u for u in _UNITS if _spans(data, twin, u)]
    stretches = stretches_in(data) if units and not _has_quaternions(twin) else None
    if stretches is None or len(stretches.obs) < _FEWEST:
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
            likely = times < _TOO_SMALL and _ALIKE[0] < then.predicted()[joint] < _ALIKE[1]
            if (sure or likely) and left < found.get(joint, (np.inf,))[0]:
                kind = MistakenUnits if sure else LikelyUnits
                found[joint] = (
                    float(left),
                    kind(
                        channels[channel].name,
                        tuple(
                            Place(f"trajectory {i}", 0, int(n), i)
                            for i, n in enumerate(data.lengths)
                        ),
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
