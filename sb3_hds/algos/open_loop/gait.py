"""The search space of gaits, whose points are unbounded vectors."""

import dataclasses
import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from sb3_hds.core.transforms.oscillators import advance_phase

Point = Float[np.ndarray, " dim"]
PerJoint = Float[np.ndarray, " act"]

_TURN = 2.0 * math.pi
# Gaits at the limits would be infinitely far: encoded shares of a range keep this distance.
_EDGE = 1e-3


class Constants(NamedTuple):
    """
    Constants of a policy: those of :class:`~sb3_hds.core.transforms.oscillators.Gait`, and the
    gains of the tracking loop.

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
    A logistic function squashes amplitudes, offsets and logarithms of frequencies and gains into
    their ranges; phases are unbounded, in turns, with 0 for the first joint.

    :param amplitude: largest amplitude of each joint
    :param offset: range of the offset of each joint, shape ``(act, 2)``
    :param frequency: range of both frequencies [Hz]
    :param kp: proportional gain, searched within ``gain_factor`` up and down
    :param kd: derivative gain, searched within ``gain_factor`` up and down
    :param gain_factor: 1: gains are not searched
    :param same_frequency: whether swing and stance have the same frequency
    :param phases: whether joints have their own phases; otherwise they move in phase
    :param leads: phase of each leg [rad], for legs that move alike and joints sorted by leg:
        amplitudes, offsets and phases of one leg are searched
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
        """Numbers of coordinates for amplitudes, offsets, phases, frequencies and gains."""
        n = len(self.amplitude) // len(self.leads)
        n_phases = n - 1 if self.phases else 0
        return n, n, n_phases, 1 if self.same_frequency else 2, 2 if self.gain_factor > 1.0 else 0

    @property
    def dim(self) -> int:
        """Dimension of the search space."""
        return sum(self.sizes)

    def decode(self, point: Point) -> Constants:
        """:return: the gait of a point"""
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
        :return: the point of a gait, clipped to the space: it starts when the phase of the first
            joint is 0, and gains are averaged over joints. A negative amplitude becomes a phase of
            half a turn, which is equivalent only if both frequencies are equal. For legs that move
            alike, amplitudes and offsets are averaged, and phases are those of the first leg.
        """
        low, high = self.offset.T
        frequencies = np.log([gait.omega_swing, gait.omega_stance]) - math.log(_TURN)
        first, last = np.log(self.frequency)
        f = (frequencies - first) / (last - first)
        parts = [
            _unsquashed(self._of_legs(np.abs(gait.amplitude) / self.amplitude)),
            _unsquashed(self._of_legs((gait.offset - low) / (high - low))),
            _from_first(gait)[: self.sizes[2]] / _TURN,
            _unsquashed(f.mean(keepdims=True) if self.same_frequency else f),
        ]
        if self.gain_factor > 1.0:
            ratios = np.array([np.mean(gait.kp) / self.kp, np.mean(gait.kd) / self.kd])
            parts.append(_unsquashed(0.5 + 0.5 * np.log(ratios) / math.log(self.gain_factor)))
        return np.concatenate(parts)

    def _of_legs(self, values: PerJoint) -> np.ndarray:
        return values.reshape(len(self.leads), -1).mean(axis=0)

    def _led(self, within: np.ndarray, swing: float, stance: float) -> PerJoint:
        """Leads are times: half a turn is half of a cycle."""
        if len(self.leads) == 1:
            return within
        cycle = math.pi / swing + math.pi / stance
        times = np.mod(self.leads, _TURN) / _TURN * cycle
        return np.concatenate([advance_phase(within, time, swing, stance) for time in times])


def _from_first(gait: Constants) -> PerJoint:
    """:return: phases of all joints but the first, at the time when that of the first is 0"""
    phase = np.mod(gait.phase + math.pi * (gait.amplitude < 0.0), _TURN)
    swing, stance = float(gait.omega_swing), float(gait.omega_stance)
    half = math.pi / swing
    elapsed = phase[0] / swing if phase[0] < math.pi else half + (phase[0] - math.pi) / stance
    remaining = float(half + math.pi / stance - elapsed)
    return advance_phase(phase, remaining, swing, stance)[1:]


def _squashed(x: np.ndarray) -> np.ndarray:
    return 1.0 / (1.0 + np.exp(-x))


def _unsquashed(share: np.ndarray) -> np.ndarray:
    share = np.clip(share, _EDGE, 1.0 - _EDGE)
    return np.log(share / (1.0 - share))
