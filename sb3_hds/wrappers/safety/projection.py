"""Projection of commands onto linear constraints."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeAlias

import daqp
import numpy as np

from sb3_hds.errors import ParameterError
from sb3_hds.wrappers.by_name import function_of

#: ``(G, h)`` with ``G u <= h``; or a function of the observation that returns them; or its name
Constraints: TypeAlias = (
    tuple[Sequence[Sequence[float]], Sequence[float]]
    | Callable[[np.ndarray], tuple[Any, Any]]
    | str
)

# What rounding a command to single precision can move it, as a share of its largest value.
_ROUNDING = 1.2e-7
# More than any constraint asks for: what DAQP takes for no bound.
_NO_BOUND = -1e30
# By how much DAQP may miss a constraint whose coefficients have length one, as a share of the
# largest command, or of the bound if that is more.
_MISS = 1e-5


def nearest(
    wanted: np.ndarray, G: np.ndarray, h: np.ndarray, low: np.ndarray, high: np.ndarray
) -> np.ndarray | None:
    r"""
    .. math:: \min_u |u - u_\text{wanted}|^2 \quad \text{s.t.}\quad G u \le h,\ l \le u \le r

    by the dual active-set method of DAQP, which is exact after finitely many steps. Constraints are
    tightened by what rounding to single precision can take, so two of them that leave a single
    value count as contradictory.

    Source: Arnström, Bemporad and Axehill, *A dual active-set solver for embedded quadratic
    programming using recursive LDL updates*, IEEE Transactions on Automatic Control 67(8), 2022.

    :param wanted: shape ``(n,)``
    :param G: shape ``(m, n)``; constraints mean the same whatever a row is multiplied by
    :param h: shape ``(m,)``
    :return: the command, shape ``(n,)``, or None where no command is allowed
    """
    wanted, largest = np.clip(wanted, low, high), np.maximum(np.abs(low), np.abs(high))
    length = np.linalg.norm(G, axis=1)
    if np.any(h[length == 0.0] < 0.0):
        return None
    kept, unit = length > 0.0, largest.max() or 1.0
    G = G[kept] / length[kept, None]
    # In units of the largest command from here on, as DAQP's tolerances are absolute.
    h = h[kept] / (length[kept] * unit)
    wanted, low, high, largest = (x / unit for x in (wanted, low, high, largest))
    tight = h - _ROUNDING * (np.abs(G) @ largest)
    if np.all(G @ wanted <= tight):
        return wanted * unit
    n, m = len(wanted), len(h)
    found, _, flag, _ = daqp.solve(
        np.eye(n),
        -wanted,
        np.ascontiguousarray(G, float),
        np.concatenate([high, tight]).astype(float),
        np.concatenate([low, np.full(m, _NO_BOUND)]).astype(float),
        np.zeros(n + m, np.int32),
    )
    found = np.clip(found, low, high)
    kept_to = np.all(G @ found <= h + _MISS * np.maximum(1.0, np.abs(h)))
    return found * unit if flag > 0 and kept_to else None


class ConstraintSet:
    """
    Linear constraints on commands, constant or a function of the observation.

    :param layer: name of the layer, for messages
    :param given: see :data:`Constraints`
    :param n: size of a command
    :raises ParameterError: for anything else, or a constant pair of the wrong shape
    """

    def __init__(self, layer: str, given: Any, n: int) -> None:
        self._layer, self._n = layer, n
        self._function = function_of(given) if isinstance(given, str) else given
        self._constant: tuple[np.ndarray, np.ndarray] | None = None
        if not callable(self._function):
            self._constant = self._checked(given, ParameterError)

    @property
    def is_constant(self) -> bool:
        """Whether they are the same for every observation."""
        return self._constant is not None

    def at(self, obs: Any) -> tuple[np.ndarray, np.ndarray]:
        """
        :return: ``G`` of shape ``(m, n)`` and ``h`` of shape ``(m,)``
        :raises ValueError: if the function returns anything else
        """
        return self._constant or self._checked(self._function(obs), ValueError)

    def _checked(self, pair: Any, error: type[Exception]) -> tuple[np.ndarray, np.ndarray]:
        try:
            G, h = (np.asarray(part, float) for part in pair)
        except (TypeError, ValueError):
            G = h = np.empty(())
        shaped = G.ndim == 2 and h.ndim == 1 and G.shape == (len(h), self._n)
        if not shaped or not (np.isfinite(G).all() and np.isfinite(h).all()):
            raise error(
                f"{self._layer} takes constraints (G, h) with G u <= h, finite, G of shape "
                f"(m, {self._n}) and h of shape (m,), or a function of the observation that "
                f"returns them, or its name 'package.module.function'; got {pair!r}."
            )
        return G, h


def condition_of(given: Any, n_obs: int) -> Callable[[Any], Any]:
    """
    :param given: a function of the observation, its name, or ``{"channel": 0, "above": 0.5}`` with
        ``above``, ``below`` or both
    :raises ParameterError: for anything else
    """
    if isinstance(given, str):
        return function_of(given)
    if not isinstance(given, Mapping) and callable(given):
        return given
    known = isinstance(given, Mapping) and {"channel"} < set(given) <= {"channel", "above", "below"}
    if not known or given["channel"] not in range(n_obs):
        raise ParameterError(
            "A condition is a function of the observation, its name, or {'channel': INDEX, "
            f"'above': VALUE}} (or 'below') with an index below {n_obs}; got {given!r}."
        )
    return Threshold(
        given["channel"], float(given.get("above", -math.inf)), float(given.get("below", math.inf))
    )


class Threshold:
    """Whether an entry of the observation lies between two values."""

    def __init__(self, channel: int, above: float, below: float) -> None:
        self.channel, self.above, self.below = channel, above, below

    def __call__(self, obs: Any) -> bool:
        return bool(self.above < obs[self.channel] < self.below)
