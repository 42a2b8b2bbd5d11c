"""The regressors of all candidates: what is known of them besides their normal equations."""

import dataclasses
from collections.abc import Sequence
from functools import cached_property

import numpy as np

from sb3_hds.sysid.equation.plausibility import plausibility
from sb3_hds.sysid.equation.regression import Item
from sb3_hds.sysid.equation.weak_form import Grams
from sb3_hds.sysid.estimation.candidates import PARAMETER

# Nonlinear parameters that cost as much as coefficients: a speed, a period.
_HIDDEN = {"stribeck_friction": 1, "concave_friction": 1, "cogging": 1}
#: friction that nearly every joint has
VISCOUS, DRY = "viscous_friction", "coulomb_friction"
#: effects that make commands late
LATE = ("action_delay", "motor_lag")
#: effects that multiply commands
GAINS = ("torque_gain", "directional_gain")
#: place of effects that all actuators share
SHARED = ("actuator", -1)


@dataclasses.dataclass(frozen=True, eq=False)
class Regressors:
    """
    :param items: candidates, several with different settings
    :param grams: normal equations
    :param lower: smallest coefficient of each column
    :param upper: largest
    :param prior: of each column, the inverse variance of the prior of its coefficient
    :param force: typical force of each joint [N m] or [N]
    :param shares: of each column, its root mean square at each joint, shape ``(dof, columns)``
    :param passes: of saturations and dead zones, the share of commands that they pass
    :param mass: some mass matrices, shape ``(n, dof, dof)``
    :param noisy: of columns that contain the smoothed acceleration, the one with the measured one
    :param effective_inertia: over an interval, in the same rows
    :param noise: of each joint's acceleration, in any unit, shape ``(dof,)``
    :param slopes: of these by inertial parameters, by key
    :param drives: share of each joint's actuator force by parameters, by key
    :param rests: of springs, shares of their second column that are admissible
    :param least: of what makes commands late, the smallest admissible coefficient
    :param always: items of every set: the nuisance parameters
    :param rarity: of each item, minus the logarithm of its prior odds
    """

    items: tuple[Item, ...]
    grams: Grams
    lower: np.ndarray
    upper: np.ndarray
    prior: np.ndarray
    force: np.ndarray
    shares: np.ndarray
    passes: dict[int, float]
    mass: np.ndarray
    effective_inertia: np.ndarray
    noise: np.ndarray
    noisy: dict[int, int]
    slopes: dict[str, np.ndarray]
    drives: dict[str, np.ndarray]
    rests: dict[int, tuple[float, float]]
    least: dict[int, float]
    always: tuple[int, ...]
    rarity: tuple[float, ...]

    @property
    def dof(self) -> int:
        return len(self.grams.n_effective)

    @cached_property
    def total(self) -> np.ndarray:
        """Normal matrix over all joints, shape ``(columns + 1, columns + 1)``."""
        return self.grams.by_joint.sum(0)

    @cached_property
    def cost(self) -> float:
        """Penalty of one parameter: the logarithm of the effective number of rows."""
        return float(np.log(self.grams.n_effective.mean()))

    def place(self, i: int) -> tuple[str, int]:
        """:return: slot and index"""
        candidate = self.items[i].candidate
        return candidate.slot, candidate.index

    def family(self, i: int) -> tuple:
        """A set contains at most one item of each family."""
        return self._families[i]

    @cached_property
    def _families(self) -> tuple[tuple, ...]:
        return tuple(
            (c.key,) if c.slot == PARAMETER else (plausibility(c.name).family, c.slot, c.index)
            for c in (item.candidate for item in self.items)
        )

    def clashes(self, keys: Sequence[int]) -> bool:
        """Whether two items exclude each other."""
        families = [self.family(i) for i in keys]
        if len(set(families)) < len(families):
            return True
        common = {f[0] for f in families if f[1:] == SHARED}
        return any(f[0] in common and f[1:2] == ("actuator",) and f[2] >= 0 for f in families)

    def hardly_told_from(self, i: int) -> list[str]:
        """
        :return: keys of candidates that differ from an item by what the equation hardly shows: of
            what makes commands late the other kind, and for a dead zone dry friction, which holds a
            joint that sticks with an unknown force
        """
        candidate = self.items[i].candidate
        if candidate.name in LATE:
            return [f"{name}.{candidate.place}" for name in LATE if name != candidate.name]
        if candidate.name != "dead_zone":
            return []
        acting = [*self.joints(i)]
        dry = (item.candidate for item in self.items if item.candidate.name == DRY)
        return [c.key for c in dry if [c.index] == acting]

    def joints(self, i: int) -> np.ndarray:
        """:return: where an item acts"""
        return self._joints[i]

    @cached_property
    def _joints(self) -> tuple[np.ndarray, ...]:
        return tuple(
            np.flatnonzero(self.shares[:, list(item.columns)].max(1) > 0.0) for item in self.items
        )

    @cached_property
    def diagonal(self) -> np.ndarray:
        """Of the normal equations, shape ``(columns + 1,)``."""
        return np.diag(self.total).copy()

    def price(self, i: int, each: float | None = None) -> float:
        """
        :param each: of a parameter; default: Schwarz's
        :return: penalty of an item in the criterion: its parameters and its prior odds
        """
        if i in self.always:
            return 0.0
        item = self.items[i]
        count = len(item.free) + _HIDDEN.get(item.candidate.name, 0)
        return count * (self.cost if each is None else each) + 2.0 * self.rarity[i]
