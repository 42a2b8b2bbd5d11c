"""Transforms of commands: rate limit, low-pass filter, delay, scale, penalty on changes."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any, ClassVar

import jax
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

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

#: lowest cut-off of a low-pass [cycles per step]: 0.1 Hz at 10 kHz
LOWEST_CUTOFF = 1e-5
# Margin of observation bounds for rounding in single precision.
_ROUNDING = 1e-5
# The impulse response of a filter is summed until this share of the initial memory is left.
_NEGLIGIBLE = 1e-12


class LastCommand(StatefulTransform):
    """Abstract: remembers the last command; before an episode, the one nearest to zero."""

    def remembers(self, below: Signals) -> tuple[Channel, ...]:
        return tuple(Channel(f"last {a.name}", *a[1:]) for a in below.actuators)

    def start(self, obs: InnerObs, below: Signals) -> MemoryVector:
        return like(obs, below.rest())


@dataclasses.dataclass(frozen=True, kw_only=True)
class RateLimit(LastCommand):
    r"""
    Commands change by at most :math:`\Delta` from one step to the next:

    .. math:: u_k = \min(\max(a_k, u_{k-1} - \Delta), u_{k-1} + \Delta)

    The memory is :math:`u_{k-1}`; before an episode, the command nearest to zero. Where the limit
    is active, the derivative with respect to the action is zero.

    :param max_change: :math:`\Delta` [command unit], one number or one per actuator
    :raises ParameterError: unless it is positive
    """

    name: ClassVar[str] = "rate_limit"

    max_change: float | Sequence[float]

    def __post_init__(self) -> None:
        super().__post_init__()
        self.refuse_unless("max_change", bool(np.all(np.array(self.max_change) > 0.0)), "positive")

    def remembers(self, below: Signals) -> tuple[Channel, ...]:
        self._per_actuator(below)
        return super().remembers(below)

    def act(
        self, action: OuterAction, obs: InnerObs, memory: MemoryVector, below: Signals
    ) -> tuple[InnerAction, MemoryVector]:
        most = like(action, self._per_actuator(below))
        wanted = below.clip(action)
        command = wanted.clip(memory - most, memory + most)
        return command, command

    def _per_actuator(self, below: Signals) -> np.ndarray:
        values, n = np.atleast_1d(np.asarray(self.max_change, float)), len(below.actuators)
        if values.shape not in ((1,), (n,)):
            raise ParameterError(
                f"RateLimit has {values.size} values of max_change, but there are {n} actuators. "
                "Pass one number, or one for each."
            )
        return np.broadcast_to(values, (n,))


@dataclasses.dataclass(frozen=True, kw_only=True)
class LowPass(StatefulTransform):
    r"""
    A Butterworth low-pass of each command, by the bilinear transform: cascaded second-order
    sections of two trapezoidal integrators each, with :math:`g = \tan(\pi f)`, and a first-order
    section if the order is odd:

    .. math:: v = \frac{z_1 + g\,(a - z_2)}{1 + g\,(g + k)}, \quad y = z_2 + g v, \quad
        z_1 \leftarrow 2 v - z_1, \quad z_2 \leftarrow 2 y - z_2

    In this form a constant passes unchanged at any cut-off and precision; polynomials of the same
    filter lose it in single precision. The command is :math:`y` of the last section, clipped to
    the limits of the actuator: from second order on, a low-pass overshoots. The memory holds the
    :math:`z`; before an episode, those at rest at the command nearest to zero.

    Source: Zavalishin, *The Art of VA Filter Design*, 2018, chapters 3 to 5.

    :param cutoff: :math:`f`, the -3 dB frequency [cycles per step], below 0.5
    :param order: at least 1
    :raises ParameterError: for a cut-off or an order out of range
    """

    name: ClassVar[str] = "low_pass"

    cutoff: float
    order: int

    def __post_init__(self) -> None:
        super().__post_init__()
        fine = LOWEST_CUTOFF <= self.cutoff < 0.5
        self.refuse_unless("cutoff", fine, f"from {LOWEST_CUTOFF:g} to below 0.5")
        whole = isinstance(self.order, int) and self.order >= 1
        self.refuse_unless("order", whole, "a whole number of at least 1")

    def remembers(self, below: Signals) -> tuple[Channel, ...]:
        low, high = below.limits()
        still, swing = self._at_rest(), self._largest()
        half = 0.5 * (high - low) + _ROUNDING * np.maximum(np.abs(low), np.abs(high))
        return tuple(
            Channel(f"filter {i + 1} of {a.name}", a.unit, still[i] * m - w, still[i] * m + w)
            for i in range(self.order)
            for a, m, w in zip(below.actuators, 0.5 * (low + high), swing[i] * half, strict=True)
        )

    def start(self, obs: InnerObs, below: Signals) -> MemoryVector:
        return like(obs, np.outer(self._at_rest(), below.rest()).ravel())

    def act(
        self, action: OuterAction, obs: InnerObs, memory: MemoryVector, below: Signals
    ) -> tuple[InnerAction, MemoryVector]:
        n, wanted = len(below.actuators), below.clip(action)
        y, after = self._passed(wanted, [memory[i * n : (i + 1) * n] for i in range(self.order)])
        return below.clip(y), namespace(action).concatenate(after)

    def _passed(self, y: Any, z: Sequence[Any]) -> tuple[Any, list[Any]]:
        """
        :param y: the input
        :param z: the state of each integrator
        :return: the output, and the states after it
        """
        g, after = math.tan(math.pi * self.cutoff), []
        for i in range(self.order // 2):
            damping = 2.0 * math.sin((2 * i + 1) * math.pi / (2 * self.order))
            first, second = z[2 * i : 2 * i + 2]
            v = (first + g * (y - second)) / (1.0 + g * (g + damping))
            y = second + g * v
            after += [2.0 * v - first, 2.0 * y - second]
        if self.order % 2:
            v = (y - z[-1]) * (g / (1.0 + g))
            y = v + z[-1]
            after.append(y + v)
        return y, after

    def _at_rest(self) -> np.ndarray:
        """The states after a constant command of one, shape ``(order,)``."""
        return np.array([0.0, 1.0] * (self.order // 2) + [1.0] * (self.order % 2))

    def _largest(self) -> np.ndarray:
        """The largest states under commands within [-1, 1], shape ``(order,)``."""
        step = np.array(self._passed(0.0, list(np.eye(self.order)))[1])
        answers = np.array(self._passed(1.0, [0.0] * self.order)[1])[:, None]
        while np.abs(step).max() > _NEGLIGIBLE:
            answers, step = np.concatenate([answers, step @ answers], 1), step @ step
        return np.abs(answers).sum(1)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Delay(StatefulTransform):
    """
    Delays commands by a whole number of steps; until the first arrives, the command nearest to zero
    acts.

    The memory holds the commands in transit, the oldest first. For a delay that is not a multiple
    of the step, or that is to be estimated, use :class:`sb3_hds.effects.ActionDelay`.

    :param steps: length of the delay [control intervals]
    :raises ParameterError: unless it is a positive whole number
    """

    name: ClassVar[str] = "delay"

    steps: int

    def __post_init__(self) -> None:
        super().__post_init__()
        whole = isinstance(self.steps, int) and self.steps >= 1
        self.refuse_unless("steps", whole, "a whole number of at least 1")

    def remembers(self, below: Signals) -> tuple[Channel, ...]:
        return tuple(
            Channel(f"{a.name} in {i}", *a[1:]) for i in range(self.steps) for a in below.actuators
        )

    def start(self, obs: InnerObs, below: Signals) -> MemoryVector:
        return like(obs, np.tile(below.rest(), self.steps))

    def act(
        self, action: OuterAction, obs: InnerObs, memory: MemoryVector, below: Signals
    ) -> tuple[InnerAction, MemoryVector]:
        n, queue = len(below.actuators), [memory, below.clip(action)]
        return memory[:n], namespace(action).concatenate(queue)[n:]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Scale(StatefulTransform):
    r"""
    Scales commands to a share :math:`s` of their range, around its middle :math:`m`:

    .. math:: u = m + s\,(a - m)

    Actuators that are not among ``axes`` keep their full range. The share follows a schedule,
    piecewise linear and constant beyond its ends. If it changes, the memory is the progress along
    it, from 0 to 1, over all episodes; an episode of a twin starts at a random progress. Without
    ``observed``, a twin infers the beginning of the schedule.

    :param schedule: ``((steps, share), ...)``, steps growing from 0, shares above 0 and at most 1
    :param axes: indices of the scaled actuators; None: all
    :raises ParameterError: for an invalid schedule, or actuators that do not exist
    """

    name: ClassVar[str] = "scale"
    persists: ClassVar[bool] = True

    schedule: Sequence[Sequence[float]]
    axes: Sequence[int] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        points = np.asarray(self.schedule, float)
        fine = points.ndim == 2 and points.shape[1] == 2 and points[0, 0] == 0.0
        fine = fine and bool(np.all(np.diff(points[:, 0]) > 0.0))
        fine = fine and bool(np.all((points[:, 1] > 0.0) & (points[:, 1] <= 1.0)))
        wanted = "pairs of steps, growing from 0, and a share above 0 and at most 1"
        self.refuse_unless("schedule", bool(fine), wanted)

    @property
    def length(self) -> float:
        """Steps until the last point; 0 if the share is constant."""
        return float(self.schedule[-1][0])

    def remembers(self, below: Signals) -> tuple[Channel, ...]:
        n = len(below.actuators)
        fine = self.axes is None or (len(self.axes) > 0 and set(self.axes) <= set(range(n)))
        self.refuse_unless("axes", fine, f"numbers of the {n} actuators, from 0 to {n - 1}")
        return (Channel("progress of the scale", "1", 0.0, 1.0),) if self.length else ()

    def start(self, obs: InnerObs, below: Signals) -> MemoryVector:
        return like(obs, np.zeros(1 if self.length else 0))

    def draw(
        self, key: PRNGKeyArray, obs: Float[Array, " obs"], below: Signals
    ) -> Float[Array, " memory"]:
        return jax.random.uniform(key, (1 if self.length else 0,), obs.dtype)

    def act(
        self, action: OuterAction, obs: InnerObs, memory: MemoryVector, below: Signals
    ) -> tuple[InnerAction, MemoryVector]:
        middle = like(action, 0.5 * np.sum(below.limits(), 0))
        share = self.share(memory, len(below.actuators))
        command = middle + share * (below.clip(action) - middle)
        return command, (memory + 1.0 / self.length).clip(0.0, 1.0) if self.length else memory

    def share(self, memory: MemoryVector, n: int) -> Any:
        """:return: the current share of each of ``n`` commands, or one for all"""
        share = self.schedule[0][1]
        if self.length:
            steps, shares = np.array(self.schedule).T
            at = like(memory, steps), like(memory, shares)
            share = namespace(memory).interp(memory * self.length, *at)
        if self.axes is None:
            return share
        return 1.0 + like(memory, np.isin(np.arange(n), self.axes)) * (share - 1.0)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Continuity(LastCommand):
    r"""
    Subtracts :math:`w\,|a_k - a_{k-1}|^2` from the reward, and does not change actions.

    The memory is :math:`a_{k-1}`; before an episode, the command nearest to zero.

    Source: Raffin, Kober and Stulp, *Smooth exploration for robotic reinforcement learning*, CoRL
    2021, section 4.1, where it is a measure.

    :param weight: :math:`w`
    :raises ParameterError: unless it is finite and at least 0
    """

    name: ClassVar[str] = "continuity"

    weight: float

    def __post_init__(self) -> None:
        super().__post_init__()
        self.refuse_unless("weight", 0.0 <= self.weight < math.inf, "finite and at least 0")

    def act(
        self, action: OuterAction, obs: InnerObs, memory: MemoryVector, below: Signals
    ) -> tuple[InnerAction, MemoryVector]:
        return action, below.clip(action)

    def cost(self, action: OuterAction, obs: InnerObs, memory: MemoryVector, below: Signals) -> Any:
        return self.weight * ((below.clip(action) - memory) ** 2).sum()
