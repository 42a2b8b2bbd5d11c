"""Linear rescaling of observations and actions, as Gymnasium's wrappers do it."""

import dataclasses
import math
from collections.abc import Sequence
from typing import ClassVar, TypeVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sb3_hds.core.declarations import Actuator, Channel
from sb3_hds.core.transforms.base import ActionTransform, ObservationTransform
from sb3_hds.errors import ParameterError

_Signal = TypeVar("_Signal", Actuator, Channel)


@dataclasses.dataclass(frozen=True)
class _Bounds:
    """
    :param low: lower bound, one number or one for each signal
    :param high: upper bound, one number or one for each signal
    :raises ParameterError: unless both are finite and ``low < high``
    """

    low: float | Sequence[float] = -1.0
    high: float | Sequence[float] = 1.0

    def __post_init__(self) -> None:
        low, high = np.asarray(self.low, float), np.asarray(self.high, float)
        for name, value in (("low", low), ("high", high)):
            plain = tuple(value.tolist()) if value.ndim else float(value)
            object.__setattr__(self, name, plain)
        if not (np.all(np.isfinite(low)) and np.all(np.isfinite(high)) and np.all(low < high)):
            raise ParameterError(
                f"{type(self).__name__} needs finite bounds with low < high, "
                f"got low={low}, high={high}."
            )

    def each(self, n: int, kind: str) -> tuple[np.ndarray, np.ndarray]:
        """:return: the bounds of each of ``n`` signals"""
        low, high = np.atleast_1d(self.low), np.atleast_1d(self.high)
        if not {low.size, high.size} <= {1, n}:
            raise ParameterError(
                f"{type(self).__name__} has bounds for {max(low.size, high.size)} {kind}, "
                f"but the twin has {n}."
            )
        return np.broadcast_to(low, (n,)), np.broadcast_to(high, (n,))

    def rescaled(self, below: tuple[_Signal, ...], kind: str) -> tuple[_Signal, ...]:
        """:return: the signals with these bounds, without a unit"""
        lows, highs = self.each(len(below), kind)
        unbounded = [s.name for s in below if not (math.isfinite(s.low) and math.isfinite(s.high))]
        if unbounded:
            raise ParameterError(
                f"{type(self).__name__} needs limits to scale by, "
                f"but these have none: {', '.join(unbounded)}."
            )
        pairs = zip(below, lows.tolist(), highs.tolist(), strict=True)
        return tuple(s._replace(unit="1", low=low, high=high) for s, low, high in pairs)


@dataclasses.dataclass(frozen=True)
class RescaleAction(_Bounds, ActionTransform):
    """
    Gymnasium's ``RescaleAction``: maps ``[low, high]`` linearly onto the limits of each actuator.

    As there, commands beyond the limits are not clipped here, but by the wrapped twin.

    :param low: smallest command, one number or one per actuator
    :param high: largest command, one number or one per actuator
    :raises ParameterError: unless ``low < high``
    """

    name: ClassVar[str] = "rescale_action"

    def actuators(self, below: tuple[Actuator, ...]) -> tuple[Actuator, ...]:
        return self.rescaled(below, "actuators")

    def apply(
        self, action: Float[Array, " outer"], below: tuple[Actuator, ...]
    ) -> Float[Array, " inner"]:
        return _affine(action, *self.each(len(below), "actuators"), *_limits(below))


@dataclasses.dataclass(frozen=True)
class RescaleObservation(_Bounds, ObservationTransform):
    """
    Gymnasium's ``RescaleObservation``: maps the limits of each channel linearly onto
    ``[low, high]``.

    :param low: smallest observation, one number or one per channel
    :param high: largest observation, one number or one per channel
    :raises ParameterError: unless ``low < high``
    """

    name: ClassVar[str] = "rescale_observation"

    def channels(self, below: tuple[Channel, ...]) -> tuple[Channel, ...]:
        return self.rescaled(below, "channels")

    def observe(
        self, obs: Float[Array, " inner"], below: tuple[Channel, ...]
    ) -> Float[Array, " outer"]:
        return _affine(obs, *_limits(below), *self.each(len(below), "channels"))

    def invert(
        self, obs: Float[Array, " outer"], below: tuple[Channel, ...]
    ) -> Float[Array, " inner"]:
        return _affine(obs, *self.each(len(below), "channels"), *_limits(below))


def _limits(signals: Sequence[Actuator | Channel]) -> tuple[np.ndarray, np.ndarray]:
    return np.array([s.low for s in signals]), np.array([s.high for s in signals])


def _affine(
    x: Float[Array, " n"],
    low: np.ndarray,
    high: np.ndarray,
    new_low: np.ndarray,
    new_high: np.ndarray,
) -> Float[Array, " n"]:
    """Map ``[low, high]`` linearly onto ``[new_low, new_high]``, in the dtype of ``x``."""
    slope = jnp.asarray((new_high - new_low) / (high - low), x.dtype)
    return jnp.asarray(new_low, x.dtype) + slope * (x - jnp.asarray(low, x.dtype))
