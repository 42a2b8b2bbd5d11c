"""
Subset selection on normal equations: coefficients, residuals and penalties of sets of candidates.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from functools import cached_property

import numpy as np
from jaxtyping import Float

from sb3_hds.sysid.equation.regression import Solution, least_squares, squares
from sb3_hds.sysid.equation.regressors import GAINS, Regressors

# A value close to a node between two pieces of a chain, each a linear approximation, may be outside
# of both by this share of a piece.
_BEYOND_NODE = 0.1
# Variance inflation of a coefficient beyond which columns count as collinear: 1 / (1 - R^2), where
# the others explain 99.5 % of its column.
_MOST_INFLATION = 200.0
# Least share of the commands that a dead zone and a saturation together let pass.
_LEAST_PASSED = 0.1
# Least share of the logged command or the inertia that counts as left by a set.
_LEAST_LEFT = 0.02
# Least ratio of sliding to static friction: a steeper drop stands for a curve of another form.
_LEAST_SLIDING = 0.3
# Iterations for the product of a gain and what else changes the command.
_GAIN_STEPS = 3


@dataclasses.dataclass(frozen=True, eq=False)
class Problem(Regressors):
    """Sets of candidates: coefficients, residuals, and what the sets cost."""

    @cached_property
    def _beside(self) -> list[np.ndarray]:
        """Normal equations of all data but one fold."""
        return [self.total - fold.sum(0) for fold in self.grams.folds]

    def solve(self, keys: Sequence[int], total: np.ndarray | None = None) -> Solution:
        """
        Least squares within bounds: coefficients out of bounds are fixed there, the farthest first.
        What a chain does to a command is multiplied by its gain, which is found by iteration.

        :param total: normal equations; default: those of all data
        """
        gains: dict[int, float] = {}
        found = self._solve(keys, total, gains)
        amplified = self._amplified(keys)
        for _ in range(_GAIN_STEPS if amplified else 0):
            value = found.value
            for columns, changed in amplified:
                change = np.mean([value.get(c, 0.0) for c in changed])
                gains |= dict.fromkeys(columns, max(1.0 + float(change), _LEAST_LEFT))
            found = self._solve(keys, total, gains)
        return found._replace(gains=gains)

    def _amplified(self, keys: Sequence[int]) -> list[tuple[tuple[int, ...], tuple[int, ...]]]:
        """:return: columns of a chain, and those of the gain of the same actuator"""
        chains = [i for i in keys if self.items[i].rule == "chain"]
        if not chains:
            return []
        gains = {self.place(i): i for i in keys if self.items[i].candidate.name in GAINS}
        return [
            (self.items[i].columns, self.items[gains[self.place(i)]].columns)
            for i in chains
            if self.place(i) in gains
        ]

    def _solve(
        self, keys: Sequence[int], total: np.ndarray | None, gains: Mapping[int, float]
    ) -> Solution:
        gram = self.total if total is None else total
        items = [self.items[i] for i in keys]
        free = [c for item in items for c in item.free]
        weights = np.zeros(len(gram))
        weights[-1] = 1.0
        for item in items:
            if item.rule == "chain":
                weights[item.columns[0]] = -gains.get(item.columns[0], 1.0)
        own = np.array([*dict.fromkeys(c for item in items for c in item.columns), len(gram) - 1])
        local = gram[own[:, None], own]
        at = {int(c): k for k, c in enumerate(own)}
        bounded = {c for item in items if item.rule != "chain" for c in item.free}
        held: list[int] = []
        while True:
            inside = [at[c] for c in free]
            theta, inverse = least_squares(local, weights[own], inside, self.prior[free])
            if inverse is None:
                return Solution(np.inf, free, theta, np.zeros((len(free),) * 2), weights, ())
            if not held and (common := self._aliased_nuisance(keys, free, inverse)):
                return self._solve([i for i in keys if i not in common], total, gains)
            beyond = np.maximum(self.lower[free] - theta, theta - self.upper[free])
            beyond = np.where([c in bounded for c in free], beyond, -np.inf)
            beyond = beyond * np.sqrt(np.maximum(self.diagonal[free], 0.0))
            if not len(free) or beyond.max() <= 0.0:
                break
            worst = int(np.argmax(beyond))
            c = free.pop(worst)
            weights[c] = -np.clip(theta[worst], self.lower[c], self.upper[c])
            held.append(c)
        weights[free] = -theta
        rss = float(weights[own] @ local @ weights[own])
        return Solution(rss, free, theta, inverse, weights, tuple(held))

    def _aliased_nuisance(
        self, keys: Sequence[int], free: Sequence[int], inverse: np.ndarray
    ) -> set[int]:
        """:return: the nuisance item that is most collinear with members, which replace it"""
        if not len(free):
            return set()
        inflation = dict(zip(free, self._inflation(free, inverse), strict=True))
        if max(inflation.values()) <= _MOST_INFLATION:
            return set()
        members = [i for i in keys if i not in self.always]
        beyond = {
            i: max(inflation[c] for c in self.items[i].free)
            for i in keys
            if i in self.always and any(set(self.joints(i)) & set(self.joints(m)) for m in members)
        }
        worst = max(beyond, key=lambda i: beyond[i], default=None)
        return set() if worst is None or beyond[worst] <= _MOST_INFLATION else {worst}

    def _inflation(self, free: Sequence[int], inverse: np.ndarray) -> np.ndarray:
        """:return: variance of each coefficient, in units of what it would be alone"""
        own = list(free)
        return np.diag(inverse) * (self.diagonal[own] + self.prior[own])

    def admissible(self, keys: Sequence[int], found: Solution) -> bool:
        """Whether all members are inside their bounds, not collinear, and leave some command."""
        if not np.isfinite(found.rss) or not self.leaves_commands(keys):
            return False
        if found.free and self._inflation(found.free, found.inverse).max() > _MOST_INFLATION:
            return False
        value = found.value
        return all(self._inside(i, found, value) for i in keys)

    def out_of_bounds(self, keys: Sequence[int]) -> list[int]:
        """:return: members at their bounds, or with sizes that are physically impossible"""
        found = self.solve(keys)
        value = found.value
        return [i for i in keys if not self._inside(i, found, value)]

    def _inside(self, i: int, found: Solution, value: Mapping[int, float]) -> bool:
        item = self.items[i]
        if i in self.always or not item.free or not value.keys() >= set(item.free):
            return True
        if item.rule == "chain":
            (c,) = item.free
            least = self.least.get(i, -_BEYOND_NODE)
            return least <= value[c] <= 1.0 + _BEYOND_NODE
        if item.rule == "blend":
            one, two = (value[c] for c in item.free)
            low, high = self.rests.get(i, (-np.inf, np.inf))
            pushes = item.candidate.name != "cogging" and one + two < 0.0
            return not pushes and low * (one + two) <= two <= high * (one + two)
        if all(c in found.held for c in item.free):
            return False
        if not item.candidate.ascending:
            return True
        by_name = dict(zip(item.names, (value[c] for c in item.free), strict=True))
        shorts = (name.rpartition(".")[2] for name in item.candidate.ascending)
        sizes = [by_name.get(short, 0.0) for short in shorts]
        return bool(np.all(np.diff(sizes) >= 0.0) and sizes[0] >= _LEAST_SLIDING * sizes[-1])

    def score(self, keys: Sequence[int], priced: bool = True) -> float:
        """:return: Schwarz's criterion with prior odds; infinite for inadmissible sets"""
        found = self.solve(keys)
        if not self.admissible(keys, found):
            return np.inf
        rss = squares(self._with_measured_accelerations(found.weights), self.grams.by_joint)
        n = self.grams.n_effective
        left = np.log(np.maximum(rss, 1e-9) / n) - self.lost_excitation(keys, found)
        prior = float(np.sum(self.prior[found.free] * found.theta**2))
        prices = sum(map(self.price, keys)) if priced else 0.0
        return float(np.sum(n * left)) + prior + prices

    def _with_measured_accelerations(self, weights: np.ndarray) -> np.ndarray:
        """
        Coefficients are estimated with smoothed accelerations, since noise would bias inertias
        towards zero; residuals use the measured ones: twice the inertia has twice the noise.
        """
        smooth, noisy, judged = list(self.noisy), list(self.noisy.values()), weights.copy()
        judged[noisy], judged[smooth] = weights[smooth], 0.0
        return judged

    def lost_excitation(self, keys: Sequence[int], found: Solution) -> np.ndarray:
        """
        Twice the logarithm of the share of the equation that a set leaves, by joint, at most zero.

        The equation is homogeneous: without torque (a gain of zero, a dead zone as wide as the
        commands, saturation at the level of dry friction) and without inertia it fits trivially,
        0 = 0. So residuals count relative to the remaining command and inertia.
        """
        out, value = np.zeros(self.dof), found.value
        for place, passed in self._passed(keys).items():
            out[list(place)] += 2.0 * np.log(max(passed, _LEAST_LEFT))
        for i in keys:
            item = self.items[i]
            if item.candidate.name in GAINS:
                changes = [value[c] for c in item.free if c in value]
                left = max(1.0 + min(changes), _LEAST_LEFT)
                out[self.joints(i)] += 2.0 * min(0.0, np.log(left))
            elif item.key in self.drives:
                change = value.get(item.columns[0], 0.0) * self.drives[item.key]
                out += 2.0 * np.minimum(0.0, np.log(np.maximum(1.0 + change, _LEAST_LEFT)))
        return out + np.minimum(0.0, self._change_of_noise(keys, value))

    def leaves_commands(self, keys: Sequence[int]) -> bool:
        """Whether a dead zone and a saturation of one actuator together pass some commands."""
        return min(self._passed(keys).values(), default=1.0) >= _LEAST_PASSED

    def _passed(self, keys: Sequence[int]) -> dict[tuple[int, ...], float]:
        """By joints, the share of commands that a dead zone and a saturation let pass together."""
        found: dict[tuple[int, ...], float] = {}
        for i in (i for i in keys if i in self.passes):
            place = tuple(map(int, self.joints(i)))
            found[place] = found.get(place, 1.0) + self.passes[i] - 1.0
        return found

    def _change_of_noise(self, keys: Sequence[int], value: dict[int, float]) -> np.ndarray:
        """
        :return: twice the logarithm of the force of the accelerations' noise at each joint,
            relative to that with the nominal inertia
        """
        changes = [
            value.get(self.items[i].columns[0], 0.0) * self.slopes[self.items[i].key]
            for i in keys
            if self.items[i].key in self.slopes
        ]
        if not changes:
            return np.zeros(self.dof)
        change = sum(changes)
        if (np.linalg.det(self.mass + change) <= 0.0).any():
            return np.full(self.dof, -np.inf)
        before, after = (
            np.mean(np.square(inertia * self.noise).sum(-1), axis=0)
            for inertia in (self.effective_inertia, self.effective_inertia + change)
        )
        return np.log(after / before)

    def held_out(self, keys: Sequence[int]) -> Float[np.ndarray, "folds dof"]:
        """:return: residual sum of squares of each fold, coefficients from the others"""
        out = []
        for fold, beside in zip(self.grams.folds, self._beside, strict=True):
            found = self.solve(keys, beside)
            rss = squares(self._with_measured_accelerations(found.weights), fold)
            taken = np.maximum(self.lost_excitation(keys, found), -6.0)
            out.append(rss * np.exp(-taken))
        return np.array(out)

    @cached_property
    def _columns_by_item(self) -> tuple[np.ndarray, np.ndarray]:
        """Items without those that are chains, each as often as it has columns, and the columns."""
        pairs = [
            (i, c)
            for i, item in enumerate(self.items)
            if item.rule != "chain"
            for c in item.columns
        ]
        found = np.array(pairs, int).reshape(-1, 2)
        return found[:, 0], found[:, 1]

    @cached_property
    def _chains(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Items that are chains, their first columns, and their second ones."""
        found = [(i, *item.columns) for i, item in enumerate(self.items) if item.rule == "chain"]
        chains, whole, part = np.array(found, int).reshape(-1, 3).T
        return chains, whole, part

    def ranking(self, keys: Sequence[int], among: Sequence[int] | None = None) -> list[int]:
        """:return: items by how much they would lower the residual, best first"""
        found = self.solve(keys)
        if not np.isfinite(found.rss):
            return []
        pool = np.full(len(self.items), among is None)
        pool[list(keys if among is None else among)] = among is not None
        items, columns = (x[pool[self._columns_by_item[0]]] for x in self._columns_by_item)
        chains, whole, part = (x[pool[self._chains[0]]] for x in self._chains)
        own = np.unique(np.concatenate([columns, whole, part]))
        columns, first, second = (np.searchsorted(own, x) for x in (columns, whole, part))
        on = np.flatnonzero(found.weights)
        r = (found.weights[on] @ self.total[on])[own]
        cross = self.total[found.free][:, own].T
        taken = cross @ found.inverse
        diagonal = self.diagonal[own]
        left = np.maximum(diagonal - (taken * cross).sum(1), 1e-9)
        drop = np.where(left > 1e-5 * diagonal, r**2 / left, 0.0)
        gains = np.bincount(items, drop[columns], len(self.items)).astype(float)
        mixed = self.total[whole, part] - (taken[first] * cross[second]).sum(1)
        share = np.clip((r[second] - mixed) / left[second], 0.0, 1.0)
        gains[chains] = 2.0 * r[first] - left[first]
        gains[chains] += 2.0 * share * (r[second] - mixed) - share**2 * left[second]
        order = np.argsort(gains)[::-1]
        return [int(i) for i in order if gains[i] > 0.5 * self.cost]

    def force_shares(self, keys: Sequence[int]) -> np.ndarray:
        """:return: of each member, the largest share of a joint's force that it carries"""
        found = self.solve(keys)
        return np.array([float(np.max(self.force_of(i, found) / self.force)) for i in keys])

    def force_of(self, i: int, found: Solution) -> np.ndarray:
        """:return: root mean square force of a member at each joint"""
        item, value = self.items[i], found.value
        if item.rule == "chain":
            value = {item.columns[0]: 1.0} | value
        return np.sqrt(sum((value.get(c, 0.0) * self.shares[:, c]) ** 2 for c in item.columns))
