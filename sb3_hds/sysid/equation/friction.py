"""Friction against velocity, as the equation of motion has it."""

from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np

from sb3_hds.sysid.equation.plausibility import plausibility
from sb3_hds.sysid.equation.problem import Problem
from sb3_hds.sysid.equation.regression import Equation

# Groups of intervals of similar velocity, and the fewest intervals of a group.
_GROUPS, _LEAST = 48, 5
_FAMILIES = ("viscous", "dry", "drag")


class ByVelocity(NamedTuple):
    """
    The equation of one joint, averaged over intervals of similar velocity.

    :param velocity: mean of each group, ascending, shape ``(groups,)``
    :param forces: mean of what each column adds, and of the missing force, shape
        ``(groups, used + 1)``
    :param used: indices of the columns
    """

    velocity: np.ndarray
    forces: np.ndarray
    used: np.ndarray


class FrictionCurve(NamedTuple):
    """
    Resistance of a joint against its velocity.

    :param joint: index
    :param velocity: of groups of intervals, ascending, shape ``(groups,)`` [rad/s] or [m/s]
    :param measured: mean resistance of each group, with all other causes taken off [N m] or [N]
    :param found: mean of the friction that was named, likewise
    """

    joint: int
    velocity: np.ndarray
    measured: np.ndarray
    found: np.ndarray


def by_velocity(equation: Equation) -> tuple[ByVelocity, ...]:
    """:return: of each joint"""
    return tuple(_of_joint(equation, j) for j in range(equation.missing.shape[1]))


def _of_joint(equation: Equation, j: int) -> ByVelocity:
    pairs = [(i, values) for i, c in enumerate(equation.columns) if (values := c.at(j)) is not None]
    order = np.argsort(equation.v[:, j], kind="stable")
    n = max(min(_GROUPS, len(order) // _LEAST), 1)
    begins = np.arange(n) * len(order) // n
    sizes = np.diff(begins, append=len(order))
    mean = lambda values: np.add.reduceat(values[order], begins) / sizes  # noqa: E731
    forces = [mean(values) for values in (*(v for _, v in pairs), equation.missing[:, j])]
    return ByVelocity(
        mean(equation.v[:, j]), np.stack(forces, 1), np.array([i for i, _ in pairs], int)
    )


def friction_curves(
    p: Problem, groups: Sequence[ByVelocity], items: Sequence[int]
) -> tuple[FrictionCurve, ...]:
    """
    :param groups: the equation of each joint, averaged
    :param items: of a set of causes
    :return: of each joint with friction in the set
    """
    found = p.solve(items)
    own = [i for i in items if _is_friction(p, i)]
    curves = []
    for j in sorted({int(p.items[i].candidate.index) for i in own}):
        columns = {c for i in own if p.items[i].candidate.index == j for c in p.items[i].columns}
        curves.append(_curve(j, groups[j], found.weights, columns))
    return tuple(curves)


def _is_friction(p: Problem, i: int) -> bool:
    candidate = p.items[i].candidate
    return candidate.slot == "joint" and plausibility(candidate.name).family in _FAMILIES


def _curve(j: int, own: ByVelocity, weights: np.ndarray, columns: Collection[int]) -> FrictionCurve:
    left = own.forces @ weights[[*own.used, -1]]
    inside = np.isin(own.used, list(columns))
    found = own.forces[:, :-1][:, inside] @ weights[own.used[inside]]
    return FrictionCurve(j, own.velocity, found - left, found)
