"""Linear rescaling of observations and actions, as Gymnasium's wrappers do it."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sb3_hds.core.signals import Actuator, Channel
from sb3_hds.core.transforms.base import ActionTransform, ObservationTransform
from sb3_hds.errors import ParameterError


@dataclasses.dataclass(frozen=True)
class RescaleAction(ActionTransform):
    """
    Gymnasium's ``RescaleAction``: ``[low, high]`` maps linearly onto the limits of each actuator.

    As there, a command beyond the limits is not clipped: that is left to the twin below.

    :param low: smallest command, one number or one per actuator
    :param high: largest command, one number or one per actuator
    :raises ParameterError: unless ``low < high``
    """

    name: ClassVar[str] = "rescale_action"

    low: float | Sequence[float] = -1.0
    high: float | Sequence[float] = 1.0

    def __post_init__(self) -> None:
        _store_bounds(self, self.low, self.high)

    def actuators(self, below: tuple[Actuator, ...]) -> tuple[Actuator, ...]:
        lows, highs = _spread(self, len(below), "actuators")
        _refuse_unbounded(self, below)
        pairs = zip(below, lows, highs, strict=True)
        return tuple(a._replace(unit="1", low=float(lo), high=float(hi)) for a, lo, hi in pairs)

    def apply(
        self, action: Float[Array, " outer"], below: tuple[Actuator, ...]
    ) -> Float[Array, " inner"]:
        low, high = _spread(self, len(below), "actuators")
        return _affine(action, low, high, *_limits(below))


@dataclasses.dataclass(frozen=True)
class RescaleObservation(ObservationTransform):
    """
    Gymnasium's ``RescaleObservation``: limits of each channel map linearly onto ``[low, high]``.

    :param low: smallest observation, one number or one per channel
    :param high: largest observation, one number or one per channel
    :raises ParameterError: unless ``low < high``
    """

    name: ClassVar[str] = "rescale_observation"

    low: float | Sequence[float] = -1.0
    high: float | Sequence[float] = 1.0

    def __post_init__(self) -> None:
        _store_bounds(self, self.low, self.high)

    def channels(self, below: tuple[Channel, ...]) -> tuple[Channel, ...]:
        lows, highs = _spread(self, len(below), "channels")
        _refuse_unbounded(self, below)
        pairs = zip(below, lows, highs, strict=True)
        return tuple(c._replace(unit="1", low=float(lo), high=float(hi)) for c, lo, hi in pairs)

    def observe(
        self, obs: Float[Array, " inner"], below: tuple[Channel, ...]
    ) -> Float[Array, " outer"]:
        low, high = _spread(self, len(below), "channels")
        return _affine(obs, *_limits(below), low, high)

    def invert(
        self, obs: Float[Array, " outer"], below: tuple[Channel, ...]
    ) -> Float[Array, " inner"]:
        low, high = _spread(self, len(below), "channels")
        return _affine(obs, low, high, *_limits(below))


def _store_bounds(transform: RescaleAction | RescaleObservation, low: Any, high: Any) -> None:
    """Keep bounds as hashable plain data: a float, or a tuple of floats."""
    low, high = np.asarray(low, float), np.asarray(high, float)
    for name, value in (("low", low), ("high", high)):
        object.__setattr__(transform, name, tuple(value.tolist()) if value.ndim else float(value))
    if not (np.all(np.isfinite(low)) and np.all(np.isfinite(high)) and np.all(low < high)):
        raise ParameterError(
            f"{type(transform).__name__} needs finite bounds with low < high, "
            f"got low={low}, high={high}."
        )


def _spread(
    transform: RescaleAction | RescaleObservation, n: int, places: str
) -> tuple[np.ndarray, np.ndarray]:
    """One bound for each of ``n`` places."""
    low, high = np.atleast_1d(transform.low), np.atleast_1d(transform.high)
    if not {low.size, high.size} <= {1, n}:
        raise ParameterError(
            f"{type(transform).__name__} has bounds for {max(low.size, high.size)} {places}, "
            f"but the twin has {n}."
        )
    return np.broadcast_to(low, (n,)), np.broadcast_to(high, (n,))


def _refuse_unbounded(
    transform: RescaleAction | RescaleObservation, below: Sequence[Actuator | Channel]
) -> None:
    unbounded = [p.name for p in below if not (math.isfinite(p.low) and math.isfinite(p.high))]
    if unbounded:
        raise ParameterError(
            f"{type(transform).__name__} needs limits to scale by, "
            f"but these have none: {', '.join(unbounded)}."
        )


def _limits(places: Sequence[Actuator | Channel]) -> tuple[np.ndarray, np.ndarray]:
    return np.array([p.low for p in places]), np.array([p.high for p in places])


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
