"""Sets of causes on held-out folds of the data: gains, equivalents, and what is predictable."""

from collections.abc import Iterator, Sequence

import numpy as np

from sb3_hds.sysid.equation.problem import Problem
from sb3_hds.sysid.equation.regression import TINY
from sb3_hds.sysid.equation.regressors import SHARED
from sb3_hds.sysid.equation.weak_form import rich_columns

# An alternative may score worse by this, and predicts held-out data as well to within this t or
# share.
_CLOSE, WORSE, _SAME = 8.0, 2.0, 0.2
# Region of practical equivalence: a loss below this share of the member's gain counts as none.
EQUIVALENT = 0.05
_MOST_ALTERNATIVES = 12
# Simpler members of a family.
_SIMPLER = {
    "stribeck_friction": "coulomb_friction",
    "load_dependent_friction": "coulomb_friction",
    "directional_coulomb_friction": "coulomb_friction",
    "directional_viscous_friction": "viscous_friction",
    "concave_friction": "viscous_friction",
    "directional_gain": "torque_gain",
}
# Least share of a column's power in the training folds: below it, ridge regression overestimates.
_SOME = 0.02


def retune(p: Problem, keys: list[int]) -> list[int]:
    """Choose the nonlinear parameters of each member again, given the other members."""
    for place, i in enumerate(list(keys)):
        if p.items[i].settings and i not in p.always:
            same = [o for o, item in enumerate(p.items) if item.key == p.items[i].key]
            trials = [[*keys[:place], o, *keys[place + 1 :]] for o in same]
            keys = min(
                trials,
                key=lambda t: (
                    t[place] in p.out_of_bounds(t) or not p.leaves_commands(t),
                    p.solve(t).rss,
                ),
            )
    return keys


def enforce_bounds(p: Problem, keys: list[int]) -> list[int]:
    """Replace members out of their bounds by simpler ones of their family, or remove them."""
    while beyond := [i for i in p.out_of_bounds(keys) if i not in p.always]:
        worst = max(beyond, key=lambda i: p.rarity[i])
        rest = [m for m in keys if m != worst]
        trials = [rest, *([*rest, o] for o in simpler_items(p, worst))]
        keys = min(trials, key=lambda t: (len(p.out_of_bounds(t)), p.score(t)))
    return keys


def simpler_items(p: Problem, i: int) -> list[int]:
    """:return: items of the same family and place with fewer parameters"""
    name = _SIMPLER.get(p.items[i].candidate.name)
    return [
        o
        for o, item in enumerate(p.items)
        if item.candidate.name == name and p.family(o) == p.family(i)
    ]


def held_out_gain(p: Problem, without: np.ndarray, held: np.ndarray, i: int) -> tuple[float, float]:
    """
    :param without: held-out squared errors without a member, shape ``(folds, dof)``
    :param held: the same with it
    :return: mean logarithm of their ratio, and its t statistic over folds, at the member's own
        joint; at the one that gains most if it acts at several; over all joints if all actuators
        share it
    """
    ratio = np.log((without + 1e-9) / (held + 1e-9))
    joints = p.joints(i)
    joint = joints[int(np.argmax(ratio.mean(0)[joints]))]
    x = ratio[:, joints].ravel() if p.place(i) == SHARED else ratio[:, joint]
    return float(x.mean()), float(x.mean() / (x.std(ddof=1) / np.sqrt(len(x)) + 1e-9))


def predictable(p: Problem, keys: Sequence[int]) -> np.ndarray:
    """
    Ridge regression of the residual of a set on all linear columns, fold by fold.

    :return: share of each joint's residual variance that it predicts on held-out data
    """
    weights = p.solve(keys).weights
    rich = rich_columns(list(p.items), np.arange(len(weights) - 1))
    return np.array([_predictable(p, weights, rich, j) for j in range(p.dof)])


def _predictable(p: Problem, weights: np.ndarray, rich: np.ndarray, j: int) -> float:
    diagonal = np.diag(p.grams.by_joint[j]) + 1e-300
    rich = rich[diagonal[rich] > 1e-12]
    on = np.union1d(rich, np.flatnonzero(weights))
    rich, weights = np.searchsorted(on, rich), weights[on]
    every = p.grams.by_joint[j][np.ix_(on, on)]
    base = predicted = 0.0
    for fold in (fold[np.ix_(on, on)] for fold in p.grams.folds[:, j]):
        train = every - fold
        # The training folds do not determine what only this fold excites.
        size = np.sqrt(np.maximum(np.diag(train)[rich], _SOME * diagonal[rich])) + TINY
        inner = train[np.ix_(rich, rich)] / np.outer(size, size)
        x = np.linalg.solve(inner + 0.02 * np.eye(len(rich)), (train[rich] @ weights) / size)
        then = weights.copy()
        then[rich] -= x / size
        base += weights @ fold @ weights
        predicted += then @ fold @ then
    return float(1.0 - predicted / base) if base > 0.0 else 0.0


def equivalents(
    p: Problem, keys: Sequence[int], i: int, held: np.ndarray, gained: float
) -> Iterator[int]:
    """
    :param held: held-out errors of the set
    :param gained: mean logarithm of their ratio without the member
    :return: items with which, in place of the member, the set is as good
    """
    own, rest = p.score(keys), [m for m in keys if m != i]
    for other in p.ranking(rest, substitutes(p, keys, i))[:_MOST_ALTERNATIVES]:
        if p.items[other].key == p.items[i].key:
            continue
        trial = [*rest, other]
        if p.score(trial) < own + _CLOSE:
            lost, t = held_out_gain(p, p.held_out(trial), held, i)
            few, surely = lost < EQUIVALENT * gained, t >= WORSE
            if few or (not surely and lost < _SAME * max(gained, 1e-3)):
                yield other


def substitutes(p: Problem, keys: Sequence[int], i: int) -> list[int]:
    """:return: items that could take the place of a member"""
    taken = {p.family(m) for m in keys if m != i}
    own = set(p.joints(i))
    return [
        o
        for o in range(len(p.items))
        if o not in keys and p.family(o) not in taken and own & set(p.joints(o))
    ]
