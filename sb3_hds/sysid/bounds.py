"""Physical bounds as a change of variables, after MINUIT: an unbounded solver cannot leave them."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sb3_hds.core import Parameter

# A search that begins at a bound begins this far inside, in units of the parameter's scale: at the
# bound itself the change of variables has no slope.
_INSIDE = 0.05
# An estimate this close to a bound lies on it, in the same unit.
_AT_BOUND = 1e-3


class Bounds(NamedTuple):
    """
    :param lower: smallest values, minus infinity where there is none, shape ``(p,)``
    :param upper: largest values, shape ``(p,)``
    :param scale: typical deviations, shape ``(p,)``
    """

    lower: np.ndarray
    upper: np.ndarray
    scale: np.ndarray

    def outside(self, free: Float[Array, " p"]) -> Float[Array, " p"]:
        """:return: physical values for unbounded numbers"""
        low_only, both, high_only = self._kinds()
        lower, upper = self._finite()
        bent = jnp.sqrt(free**2 + 1.0) - 1.0
        above = lower + self.scale * bent
        below = upper - self.scale * bent
        between = lower + 0.5 * (upper - lower) * (jnp.sin(free) + 1.0)
        value = self.scale * free
        value = jnp.where(low_only, above, value)
        value = jnp.where(high_only, below, value)
        return jnp.where(both, between, value)

    def inside(self, values: Float[np.ndarray, " p"]) -> Float[np.ndarray, " p"]:
        """:return: unbounded numbers for physical values, moved off the bounds"""
        low_only, both, high_only = self._kinds()
        margin = np.minimum(_INSIDE * self.scale, 0.25 * (self.upper - self.lower))
        values = np.clip(values, self.lower + margin, self.upper - margin)
        lower, upper = self._finite()
        above = np.sqrt((np.maximum(values - lower, 0.0) / self.scale + 1.0) ** 2 - 1.0)
        below = np.sqrt((np.maximum(upper - values, 0.0) / self.scale + 1.0) ** 2 - 1.0)
        width = np.where(both, upper - lower, 1.0)
        between = np.arcsin(np.clip(2.0 * (values - lower) / width - 1.0, -1.0, 1.0))
        free = values / self.scale
        free = np.where(low_only, above, free)
        free = np.where(high_only, below, free)
        return np.where(both, between, free)

    def reached(self, values: Float[np.ndarray, " p"]) -> np.ndarray:
        """:return: which values lie on a bound"""
        near = _AT_BOUND * self.scale
        return (values - self.lower < near) | (self.upper - values < near)

    def _kinds(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        has_low, has_high = self.lower > -math.inf, self.upper < math.inf
        return has_low & ~has_high, has_low & has_high, ~has_low & has_high

    def _finite(self) -> tuple[np.ndarray, np.ndarray]:
        """Zero where there is no bound: what no branch selects must be finite all the same."""
        lower = np.where(self.lower > -math.inf, self.lower, 0.0)
        return lower, np.where(self.upper < math.inf, self.upper, 0.0)


def bounds_of(parameters: Sequence[Parameter]) -> Bounds:
    """:return: the bounds and scales of these parameters"""
    columns = np.array([(p.lower, p.upper, p.scale) for p in parameters], np.float64)
    return Bounds(*columns.reshape(-1, 3).T)
