"""The gaits that a search may visit, as points of an unbounded space."""

import dataclasses
import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from sb3_hds.core.transforms.oscillators import advance_phase

Point = Float[np.ndarray, " dim"]
PerJoint = Float[np.ndarray, " act"]

_TURN = 2.0 * math.pi
# A gait at the edge of the space would be infinitely far out.
_EDGE = 1e-3


class Constants(NamedTuple):
    """
    What a policy consists of: the oscillators of
    :class:`~sb3_hds.core.transforms.oscillators.Gait`, and the gains of the loop that tracks them.

    :param amplitude: per joint [rad]
    :param offset: per joint [rad]
    :param phase: per joint [rad]
    :param omega_swing: [rad/s]
    :param omega_stance: [rad/s]
    :param kp: per joint, command per rad
    :param kd: per joint, command per rad/s
    """

    amplitude: PerJoint
    offset: PerJoint
    phase: PerJoint
    omega_swing: np.ndarray
    omega_stance: np.ndarray
    kp: PerJoint
    kd: PerJoint


@dataclasses.dataclass(frozen=True)
class GaitSpace:
    """
    Amplitudes, offsets and logarithms of frequencies and gains are squashed into their ranges by a
    logistic function; phases count turns, are not bounded, and that of the first joint is 0.

    :param amplitude: largest amplitude of each joint
    :param offset: range of the offset of each joint, shape ``(act, 2)``
    :param frequency: range of both frequencies [Hz]
    :param kp: gain of the tracking; searched up and down by ``gain_factor``
    :param kd: gain of the tracking of velocities; searched up and down by ``gain_factor``
    :param gain_factor: 1: gains are not searched
    :param same_frequency: whether swing and stance have one
    :param phases: whether joints have phases of their own; otherwise they move together
    :param leads: phase of each leg [rad], where all legs do the same and joints come leg by leg:
        amplitudes, offsets and phases are searched for one of them
    """

    amplitude: PerJoint
    offset: Float[np.ndarray, "act 2"]
    frequency: tuple[float, float]
    kp: float
    kd: float
    gain_factor: float = 1.0
    same_frequency: bool = False
    phases: bool = True
    leads: tuple[float, ...] = (0.0,)

    @property
    def sizes(self) -> tuple[int, ...]:
        """How many coordinates stand for amplitudes, offsets, phases, frequencies and gains."""
        n = len(self.amplitude) // len(self.leads)
        n_phases = n - 1 if self.phases else 0
        return n, n, n_phases, 1 if self.same_frequency else 2, 2 if self.gain_factor > 1.0 else 0

    @property
    def dim(self) -> int:
        """How many numbers are searched."""
        return sum(self.sizes)

    def decode(self, point: Point) -> Constants:
        """:return: the gait that a point stands for"""
        n, legs = len(self.amplitude), len(self.leads)
        a, b, turns, f, gains = np.split(point, np.cumsum(self.sizes)[:-1])
        low, high = self.offset.T
        within = np.zeros(n // legs)
        within[1:] = np.mod(_TURN * turns, _TURN) if self.phases else 0.0
        first, last = np.log(self.frequency)
        omega = _TURN * np.exp(first + (last - first) * _squashed(f))
        factors = self.gain_factor ** (2.0 * _squashed(gains) - 1.0) if len(gains) else (1.0, 1.0)
        return Constants(
            amplitude=self.amplitude * np.tile(_squashed(a), legs),
            offset=low + (high - low) * np.tile(_squashed(b), legs),
            phase=self._led(within, omega[0], omega[-1]),
            omega_swing=np.asarray(omega[0]),
            omega_stance=np.asarray(omega[-1]),
            kp=np.full(n, self.kp * factors[0]),
            kd=np.full(n, self.kd * factors[1]),
        )

    def encode(self, gait: Constants) -> Point:
        """
        :return: the point that stands for a gait, from the moment when the phase of its first joint
            is 0, with gains that are one for all; clipped to the space. A negative amplitude
            becomes a phase of half a turn, which is the same only where both frequencies are. Where
            all legs do the same, they do the mean, with the phases of the first.
        """
        low, high = self.offset.T
        frequencies = np.log([gait.omega_swing, gait.omega_stance]) - math.log(_TURN)
        first, last = np.log(self.frequency)
        f = (frequencies - first) / (last - first)
        parts = [
            _spread(self._of_legs(np.abs(gait.amplitude) / self.amplitude)),
            _spread(self._of_legs((gait.offset - low) / (high - low))),
            _from_first(gait)[: self.sizes[2]] / _TURN,
            _spread(f.mean(keepdims=True) if self.same_frequency else f),
        ]
        if self.gain_factor > 1.0:
            ratios = np.array([np.mean(gait.kp) / self.kp, np.mean(gait.kd) / self.kd])
            parts.append(_spread(0.5 + 0.5 * np.log(ratios) / math.log(self.gain_factor)))
        return np.concatenate(parts)

    def _of_legs(self, values: PerJoint) -> np.ndarray:
        return values.reshape(len(self.leads), -1).mean(axis=0)

    def _led(self, within: np.ndarray, swing: float, stance: float) -> PerJoint:
        """Legs are ahead in time: a lead of half a turn is half of a cycle."""
        if len(self.leads) == 1:
            return within
        cycle = math.pi / swing + math.pi / stance
        times = np.mod(self.leads, _TURN) / _TURN * cycle
        return np.concatenate([advance_phase(within, time, swing, stance) for time in times])


def _from_first(gait: Constants) -> PerJoint:
    """Phases of all joints but the first, when that of the first is 0."""
    phase = np.mod(gait.phase + math.pi * (gait.amplitude < 0.0), _TURN)
    swing, stance = float(gait.omega_swing), float(gait.omega_stance)
    half = math.pi / swing
    gone = phase[0] / swing if phase[0] < math.pi else half + (phase[0] - math.pi) / stance
    left = float(half + math.pi / stance - gone)
    return advance_phase(phase, left, swing, stance)[1:]


def _squashed(x: np.ndarray) -> np.ndarray:
    return 1.0 / (1.0 + np.exp(-x))


def _spread(share: np.ndarray) -> np.ndarray:
    share = np.clip(share, _EDGE, 1.0 - _EDGE)
    return np.log(share / (1.0 - share))
