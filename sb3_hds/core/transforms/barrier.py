"""A control barrier function for the limits of velocity-controlled joints."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float

from sb3_hds.core.declarations import Channel
from sb3_hds.core.transforms.base import (
    InnerAction,
    InnerObs,
    MemoryVector,
    OuterAction,
    Signals,
    StatefulTransform,
    like,
    namespace,
)
from sb3_hds.errors import ParameterError


@dataclasses.dataclass(frozen=True, kw_only=True)
class Barrier(StatefulTransform):
    r"""
    A velocity-controlled joint approaches a limit no faster than

    .. math:: u \le \frac{\gamma\,(q_\text{max} - q) - \varepsilon}{\Delta t}

    and likewise for the lower limit. With :math:`q_{k+1} = q_k + u\,\Delta t + e`,
    :math:`|e| \le \varepsilon`, a joint that starts within its limits stays there: this is the
    closed form of the discrete-time control barrier function :math:`h = q_\text{max} - q`,
    :math:`h_{k+1} \ge (1 - \gamma) h_k`. It does not protect torque-controlled joints, which
    cannot stop at once.

    Source: Agrawal and Sreenath, *Discrete control barrier functions for safety-critical control of
    discrete systems*, RSS 2017, section III.

    :param low: lower limits :math:`q_\text{min}` [rad] or [m], one per guarded joint
    :param high: upper limits :math:`q_\text{max}`
    :param position: where each joint's position is in the observation: its index or, for an angle,
        the indices of its cosine and its sine
    :param action: index of each joint's command
    :param gain: speed per unit of the command [rad/s] or [m/s]
    :param share: :math:`\gamma`, above 0 and at most 1
    :param tolerance: :math:`\varepsilon`, largest error of a step [rad] or [m]
    :param dt: control interval :math:`\Delta t` [s]
    :raises ParameterError: if a number is out of its range, or limits are closer than the tolerance
        allows
    """

    name: ClassVar[str] = "barrier"

    low: Sequence[float]
    high: Sequence[float]
    position: Sequence[int | Sequence[int]]
    action: Sequence[int]
    gain: float = 1.0
    share: float = 0.5
    tolerance: float = 0.0
    dt: float

    def __post_init__(self) -> None:
        super().__post_init__()
        n = len(self.low)
        for field in ("low", "high", "position", "action"):
            self.refuse_unless(field, len(getattr(self, field)) == n >= 1, f"one per joint ({n})")
        bounds = np.array([self.low, self.high], float)
        self.refuse_unless("low", bool(np.isfinite(bounds).all()), "finite, as high")
        self.refuse_unless("share", 0.0 < self.share <= 1.0, "above 0 and at most 1")
        self.refuse_unless("gain", 0.0 < self.gain < math.inf, "positive")
        self.refuse_unless("dt", 0.0 < self.dt < math.inf, "positive [s]")
        self.refuse_unless("tolerance", 0.0 <= self.tolerance < math.inf, "at least 0")
        for place, ends in zip(self.position, bounds.T, strict=True):
            turns = isinstance(place, int) or bool(np.all(np.abs(ends) < math.pi))
            self.refuse_unless("position", turns, "an index where a limit is half a turn or more")
        room = 2.0 * self.tolerance / self.share
        wide = bool(np.all(bounds[1] - bounds[0] > room))
        self.refuse_unless("high", wide, f"above low by more than {room:g} (2 tolerance / share)")

    def remembers(self, below: Signals) -> tuple[Channel, ...]:
        low, high = below.limits()
        for i in self.action:
            if not 0 <= i < len(below.actuators) or not low[i] < 0.0 < high[i]:
                raise ParameterError(
                    f"Barrier needs speeds of either sign; the limits of command {i} do not allow "
                    f"that: {low.tolist()} to {high.tolist()}."
                )
        if not below.channels:
            raise ParameterError(
                "A barrier reads positions from observations that are a Box with one axis: wrap "
                "the environment in gymnasium.wrappers.FlattenObservation first."
            )
        indices = [i for place in self.position for i in _indices(place)]
        if not all(0 <= i < len(below.channels) for i in indices):
            raise ParameterError(
                f"Barrier reads positions from the entries {list(self.position)}, but an "
                f"observation has {len(below.channels)}."
            )
        return ()

    def start(self, obs: InnerObs, below: Signals) -> MemoryVector:
        return obs[:0]

    def act(
        self, action: OuterAction, obs: InnerObs, memory: MemoryVector, below: Signals
    ) -> tuple[InnerAction, MemoryVector]:
        q, step = self.positions(obs), self.gain * self.dt
        slowest = (self.share * (like(q, self.low) - q) + self.tolerance) / step
        fastest = (self.share * (like(q, self.high) - q) - self.tolerance) / step
        # The guarded joint of each command; the last entry stands for none.
        joints = [self.action.index(i) if i in self.action else -1 for i in range(len(action))]
        free = like(q, [math.inf])
        concatenate, order = namespace(q).concatenate, np.array(joints)
        lower, upper = concatenate([slowest, -free])[order], concatenate([fastest, free])[order]
        return below.clip(below.clip(action).clip(lower, upper)), memory

    def positions(self, obs: InnerObs) -> Float[Any, " joints"]:
        """:return: the positions of the guarded joints [rad] or [m]"""
        first, last = np.array([(_indices(p)[0], _indices(p)[-1]) for p in self.position]).T
        if np.all(first == last):
            return obs[first]
        xp = namespace(obs)
        return xp.where(first == last, obs[first], xp.arctan2(obs[last], obs[first]))

    def violation(self, obs: InnerObs) -> Any:
        """:return: the sum over the guarded joints of how far they are beyond their limits"""
        q = self.positions(obs)
        beyond = (like(q, self.low) - q).clip(0.0) + (q - like(q, self.high)).clip(0.0)
        return beyond.sum()


def _indices(place: int | Sequence[int]) -> Sequence[int]:
    return (place,) if isinstance(place, int) else place
