"""A shield: commands are projected onto coupled linear constraints."""

from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import daqp
import gymnasium
import numpy as np

from sb3_hds.errors import ParameterError, SafetyError
from sb3_hds.wrappers.action_layer import ActionLayer
from sb3_hds.wrappers.by_name import function_of
from sb3_hds.wrappers.safety.barrier import check_on_breach, refuse_layers_below, report_breach

#: ``(G, h)`` with ``G u <= h``; or a function of the observation that returns them; or its name
Constraints: TypeAlias = (
    tuple[Sequence[Sequence[float]], Sequence[float]]
    | Callable[[np.ndarray], tuple[Any, Any]]
    | str
)

# Rounding error of a command in single precision, relative to its largest value.
_COMMAND_ROUNDING = 1.2e-7
# DAQP takes this for no bound.
_NO_BOUND = -1e30
# Violation by DAQP to accept, of a constraint with coefficients of length one, relative to the
# largest command, or to the bound if that is larger.
_VIOLATION = 1e-5
# Rounding error of a guard in single precision: no violation down to minus this value.
_GUARD_ROUNDING = 1e-5


class ActionShield(ActionLayer):
    r"""
    Projects the action onto the commands that satisfy linear constraints:

    .. math:: \min_u |u - a|^2 \quad \text{s.t.}\quad G(o)\,u \le h(o),\ u \in \text{Box}

    With :math:`G = -\partial b / \partial q\,\Delta t` and :math:`h = \gamma\, b(o)`, this keeps
    :math:`b \ge 0` for velocity-controlled joints, exactly if :math:`b` is linear: several limits,
    walls and combinations of joints at once. For limits of single joints,
    :class:`JointLimitBarrier` is the closed form.

    Assumes that the constraints are feasible at every observation and sufficient for safety. The
    first is checked at construction if constraints are constant, and at every step; the second at
    every reset and step, if a ``guard`` defines safety. The shield must be next to the environment:
    a layer below it would change its commands.

    ``info["constraint_cost"]`` is the sum of negative guards, or without a guard, the violation of
    the constraints by the executed command; ``info["infeasible"]`` is whether no command was
    allowed.

    Source: Ames et al., *Control barrier functions: theory and applications*, ECC 2019, section II.

    :param env: with a bounded Box of one axis as action space
    :param constraints: ``(G, h)``; or a function of the observation that returns them, or its name
        ``"package.module.function"``
    :param guard: function of the observation whose values, shape ``(k,)``, must not be negative; or
        its name
    :param fallback: the command if none is allowed, for example the one that stops; None: raise
    :param on_breach: what to do if a guard is negative: ``"raise"``, ``"warn"`` or ``"ignore"``
    :param store: ``"executed"``: learners store the command
    :raises ParameterError: for constraints of the wrong shape, constant ones that contradict each
        other, or another layer below
    """

    def __init__(
        self,
        env: gymnasium.Env,
        constraints: Constraints,
        *,
        guard: Callable[[Any], Any] | str | None = None,
        fallback: Sequence[float] | None = None,
        on_breach: str = "raise",
        store: str = "raw",
    ) -> None:
        refuse_layers_below(type(self), env)
        super().__init__(
            env,
            store,
            constraints=constraints,
            guard=guard,
            fallback=fallback,
            on_breach=on_breach,
        )
        self._low, self._high = (x.astype(float) for x in (self.commands.low, self.commands.high))
        self._constraints = ConstraintSet(type(self).__name__, constraints, self._low.size)
        self._guard = function_of(guard) if isinstance(guard, str) else guard
        self._on_breach = check_on_breach(type(self), on_breach)
        self._fallback = None if fallback is None else self._checked(fallback)
        self._margins, self._violated, self._infeasible = np.zeros(0), 0.0, False
        self._seen: Any = None
        if self._constraints.is_constant and self._project(self._low, None) is None:
            raise ParameterError(
                "ActionShield has constraints that no command within the limits satisfies: "
                f"{constraints!r}."
            )

    def decide(self, action: np.ndarray) -> np.ndarray:
        command = self._project(action, self._seen)
        self._infeasible = command is None
        if command is not None:
            return command
        if self._fallback is None:
            raise SafetyError(
                f"No command satisfies the constraints at the observation {self._seen}. Loosen "
                "them, or pass a fallback: the command that is executed then."
            )
        return self._fallback

    def begin(self, obs: Any) -> None:
        super().begin(obs)
        self._violated, self._infeasible = 0.0, False
        self._check_guard(obs)

    def observe(self, obs: Any, command: np.ndarray) -> None:
        super().observe(obs, command)
        G, h = self._constraints.at(self._seen)
        self._violated = float(np.clip(G @ command - h, 0.0, None).sum())
        self._check_guard(obs)

    def cost(self) -> float:
        return float(-self._margins.clip(None, 0.0).sum()) if self._guard else self._violated

    def extra_info(self) -> dict[str, Any]:
        return {"infeasible": self._infeasible}

    def _check_guard(self, obs: Any) -> None:
        self._seen = obs
        if self._guard is None:
            return
        self._margins = np.atleast_1d(np.asarray(self._guard(obs), float))
        if not np.all(self._margins >= -_GUARD_ROUNDING):
            report_breach(
                self._on_breach,
                f"The guard of ActionShield is {self._margins.min():.3g}, below zero, at the "
                f"observation {obs}: the constraints do not ensure it, or the episode began there.",
            )

    def _project(self, action: np.ndarray, obs: Any) -> np.ndarray | None:
        return nearest(action, *self._constraints.at(obs), self._low, self._high)

    def _checked(self, fallback: Sequence[float]) -> np.ndarray:
        command = np.asarray(fallback, float)
        if not self.commands.contains(command.astype(self.commands.dtype)):
            raise ParameterError(f"fallback must be a command within {self.commands}: {fallback}.")
        return command


def nearest(
    wanted: np.ndarray, G: np.ndarray, h: np.ndarray, low: np.ndarray, high: np.ndarray
) -> np.ndarray | None:
    r"""
    .. math:: \min_u |u - u_\text{wanted}|^2 \quad \text{s.t.}\quad G u \le h,\ l \le u \le r

    by the dual active-set method of DAQP, which is exact after finitely many steps. Constraints are
    tightened by the rounding error of single precision, so two that leave a single value count as
    contradictory.

    Source: Arnström, Bemporad and Axehill, *A dual active-set solver for embedded quadratic
    programming using recursive LDL updates*, IEEE Transactions on Automatic Control 67(8), 2022.

    :param wanted: shape ``(n,)``
    :param G: shape ``(m, n)``; the scale of a row and its bound does not matter
    :param h: shape ``(m,)``
    :return: the command, shape ``(n,)``; None if no command is allowed
    """
    wanted, largest = np.clip(wanted, low, high), np.maximum(np.abs(low), np.abs(high))
    length = np.linalg.norm(G, axis=1)
    if np.any(h[length == 0.0] < 0.0):
        return None
    nonzero, unit = length > 0.0, largest.max() or 1.0
    G = G[nonzero] / length[nonzero, None]
    # In units of the largest command from here on, since DAQP's tolerances are absolute.
    h = h[nonzero] / (length[nonzero] * unit)
    wanted, low, high, largest = (x / unit for x in (wanted, low, high, largest))
    tight = h - _COMMAND_ROUNDING * (np.abs(G) @ largest)
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
    feasible = np.all(G @ found <= h + _VIOLATION * np.maximum(1.0, np.abs(h)))
    return found * unit if flag > 0 and feasible else None


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
