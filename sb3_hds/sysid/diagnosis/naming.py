"""Forward selection: which causes are named, one after the other, or two at once."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sb3_hds.sysid.comparison.halves import Accepted, Base, Tried
from sb3_hds.sysid.comparison.held_out import Comparison, as_good, passes
from sb3_hds.sysid.comparison.inference import family_p_value, margin, standard_errors
from sb3_hds.sysid.comparison.search import Search, places_of
from sb3_hds.sysid.diagnosis.findings import (
    ANOTHER,
    CHANCE,
    NAMELESS,
    SMALL,
    UNCERTAIN,
)

# Causes that are looked for.
_MOST = 3
# A later cause that takes away a smaller share of the error than this, of what the ones before took
# away, may be no more than what their model is off by.
_LEAST_OF_EARLIER = 0.01
# Family-wise level of what selection proposes.
_FAMILY_LEVEL = 0.05


class Nameless(NamedTuple):
    """
    A flexible force that predicts better than the named causes, or than none.

    :param tried: the force
    :param better: how much better
    :param causes: keys of the causes in whose place it is; none: it is beside them
    """

    tried: Tried
    better: Comparison
    causes: tuple[str, ...]


class Naming:
    """
    :param search: candidates on two halves of the evidence
    :param start: the model at the start
    :param seed: of the bootstrap
    :param family: number of all candidates per candidate that is simulated, for family-wise
        p-values
    :param by_all: whether confirmed candidates are re-ranked on all data; otherwise, the first one
        is named
    """

    def __init__(
        self, search: Search, start: Base, seed: int, by_all: bool = True, family: float = 1.0
    ) -> None:
        self.search, self.start, self.seed, self.by_all = search, start, seed, by_all
        self.family = family
        self.rejected_for: dict[str, str] = {}
        # Whether re-ranking on all data ever replaced the candidate that was confirmed first.
        self._reranked = False

    def one_by_one(self, firsts: Sequence[Tried]) -> tuple[list[Accepted], Base]:
        """
        :param firsts: candidates beside the model at the start, best first
        :return: causes, each confirmed beside those before it, and the model with them
        """
        return self._grown([], self.start, firsts)

    def beside(self, found: Sequence[Accepted], base: Base) -> tuple[list[Accepted], Base]:
        """
        :param found: causes that are confirmed already
        :param base: the model with them
        :return: these and more, each confirmed beside those before it, and the model with them
        """
        return self._grown(list(found), base, self.search.finalists(base, keys_of(found)))

    def _grown(
        self, found: list[Accepted], base: Base, tried: Sequence[Tried]
    ) -> tuple[list[Accepted], Base]:
        while (one := self._next(tried, base, keys_of(found))) is not None:
            found.append(one)
            base = self.search.believing(one.tried, base)
            found, base = self._pruned(found, base)
            if len(found) == _MOST:
                break
            tried = self.search.finalists(base, keys_of(found))
        if len(found) > 1:
            again = [self._beside_the_others(one, base) for one in found]
            pairs = zip(found, again, strict=True)
            found = [new if passes(new.comparison) else old for old, new in pairs]
        return found, base

    def pair(
        self, alone: Accepted, base: Base, firsts: Sequence[Tried]
    ) -> tuple[list[Accepted], Base] | None:
        """
        The first cause can absorb a part of a second one, which is then not confirmed. So the other
        candidates are tried as the first cause.

        :param alone: the cause beside which no second one was confirmed
        :param base: the model with it
        :param firsts: candidates beside the model at the start, best first
        :return: the pair that selection prefers among those of which both causes are confirmed
            beside each other and predict better than the one alone, and the model with it
        """
        chosen = self.search.pairs(firsts, self.start, alone.tried.candidate)
        for n_tests, (first, tried) in enumerate(chosen):
            confirmed = self._confirmed(first, tried, n_tests, base, firsts)
            if confirmed is not None:
                return confirmed
        return None

    def without_reranking(self, firsts: Sequence[Tried]) -> tuple[list[Accepted], Base] | None:
        """
        Re-ranking on all data can absorb a second cause into the first, so that no pair is
        significantly better: repeat without re-ranking.

        :param firsts: candidates beside the model at the start, best first
        :return: causes, if that makes them several, and the model with them
        """
        if not self._reranked:
            return None
        plain = Naming(self.search, self.start, self.seed, False, self.family)
        found, base = plain.one_by_one(firsts)
        if len(found) == 1:
            return plain.pair(found[0], base, firsts)
        return (found, base) if found else None

    def replaced_by_forces(
        self, found: Sequence[Accepted], base: Base
    ) -> tuple[list[Accepted], Base, Nameless | None]:
        """
        The best of the named candidates may still be wrong. If a flexible force predicts
        significantly better in the place of all causes, or of one, these are not named. A force
        that gains nothing beside all causes cannot replace one, so that is fitted first.

        :return: the remaining causes, the model with them, and the flexible force; None if none is
            better
        """
        if not found or not self.search.hypotheses.nameless:
            return list(found), base, None
        forces = [
            f
            for f in self.search.fit_nameless(base, roughly=True)
            if self._predicts_better(f, base)
        ]
        places = (tuple(found), *((one,) for one in found if len(found) > 1))
        for place in places if forces else ():
            taken = [one.tried.candidate for one in place]
            without = self.search.without(base, *taken, rival=base)
            candidates = [force.candidate for force in forces]
            fits = self.search.fit(candidates, without, places_of(forces), base.point.cost)
            best = fits[0]
            if self._predicts_better(best, base):
                self.rejected_for |= dict.fromkeys(keys_of(place), NAMELESS)
                rest = [one for one in found if one not in place]
                better = self.search.ranking.compare(best.held_out, base.held_out)
                return (
                    rest,
                    self.search.refit(without),
                    Nameless(best, better, tuple(keys_of(place))),
                )
        return list(found), base, None

    def _predicts_better(self, force: Tried, base: Base) -> bool:
        better = self.search.ranking.compare(force.held_out, base.held_out)
        return force.point.cost < base.point.cost and not as_good(better)

    def nameless(self, base: Base, known: Sequence[str]) -> Nameless | None:
        """
        :param known: keys of causes that the model contains
        :return: a flexible force beside the model, as significant as a cause has to be
        """
        tried = self.search.fit_nameless(base)
        sure = [t for t in tried if self._determined(t, base)]
        best = self._best(sure, base, len(known))
        if best is None or self._family_p_value(best, base, known) >= _FAMILY_LEVEL / (
            1 + len(known)
        ):
            return None
        return Nameless(best, self.search.ranking.compare_nested(best.held_out, base.held_out), ())

    def _confirmed(
        self,
        first: Tried,
        tried: Sequence[Tried],
        n_tests: int,
        base: Base,
        firsts: Sequence[Tried],
    ) -> tuple[list[Accepted], Base] | None:
        """
        :param first: of a pair
        :param tried: beside it, best first
        :param n_tests: pairs that were not confirmed: each makes the level stricter
        """
        belief = self.search.believing(first, self.start)
        second = self._next(tried, belief, [first.candidate.key], n_tests)
        if second is None:
            return None
        both = self.search.believing(second.tried, belief)
        if not passes(self.search.ranking.compare(both.held_out, base.held_out)):
            return None
        p_value = self._family_p_value(first, self.start, [])
        found, both = self._pruned(
            [self._accepted(first, firsts, self.start, p_value), second], both
        )
        found = [self._beside_the_others(one, both) for one in found]
        if len(found) < 2 or not all(passes(one.comparison) for one in found):
            return None
        return found, both

    def _next(
        self, tried: Sequence[Tried], base: Base, known: Sequence[str], n_tests: int = 0
    ) -> Accepted | None:
        """
        :param n_tests: pairs that were not confirmed
        :return: the best of what was tried, if it is a cause beside those that are known
        """
        sure = [t for t in tried if self._fits_its_name(t) and self._determined(t, base)]
        best = self._best(sure, base, len(known) + n_tests)
        if best is None:
            return None
        if self._is_small(best, base):
            self.rejected_for[best.candidate.key] = SMALL
            return None
        if (p_value := self._family_p_value(best, base, known)) >= _FAMILY_LEVEL / (
            1 + len(known) + n_tests
        ):
            self.rejected_for[best.candidate.key] = CHANCE
            return None
        return self._accepted(best, tried, base, p_value)

    def _best(self, sure: Sequence[Tried], base: Base, n_tests: int) -> Tried | None:
        """:return: what is confirmed, or what all the data prefer to that"""
        first = self.search.ranking.best(sure, base, n_tests)
        if first is None or not self.by_all:
            return first
        best = self.search.ranking.best_on_pooled_data(first, sure, base, n_tests)
        self._reranked |= best is not first
        return best

    def _accepted(
        self, best: Tried, tried: Sequence[Tried], base: Base, p_value: float
    ) -> Accepted:
        """:param base: the model without it"""
        rivals = [*tried, *self.search.fit_aliased(best, tried, base)]
        others = self.search.ranking.alternatives(best, rivals, base)
        comparison = self.search.ranking.compare_nested(best.held_out, base.held_out)
        fitted = tuple(t for t in rivals if t.candidate.key in others)
        return Accepted(best, comparison, others, p_value, rivals=fitted)

    def _beside_the_others(self, one: Accepted, base: Base) -> Accepted:
        """Refit a cause and its alternatives beside all other causes."""
        without = self.search.without(base, one.tried.candidate)
        names = (one.tried.candidate.key, *one.alternatives)
        named = [c for c in self.search.hypotheses.candidates if c.key in names]
        named = [c for c in named if not self.search.part_of(c, without)]
        tried = self.search.fit(named, without, places_of([one.tried, *one.rivals]))
        same = next(t for t in tried if t.candidate is one.tried.candidate)
        return self._accepted(same, tried, without, one.family_p_value)

    def _determined(self, tried: Tried, base: Base) -> bool:
        """Whether the interval of some parameter excludes its null."""
        half, own = self.search.select, list(self.search.hypotheses.indices(tried.candidate))
        free = [*base.free, *own]
        stderr = standard_errors(half, tried.point, free)[own]
        moved = np.abs(tried.point.theta - self.search.hypotheses.null)[own]
        if not (sure := bool((moved > margin(len(np.unique(half.cluster)), stderr)).any())):
            self.rejected_for[tried.candidate.key] = UNCERTAIN
        return sure

    def _fits_its_name(self, tried: Tried) -> bool:
        """Whether the fitted sizes are in the order that the name implies."""
        names = self.search.hypotheses.names
        sizes = tried.point.theta[[names.index(name) for name in tried.candidate.ascending]]
        if not (meant := bool(np.all(np.diff(sizes) >= 0.0))):
            self.rejected_for[tried.candidate.key] = ANOTHER
        return meant

    def _is_small(self, best: Tried, base: Base) -> bool:
        """Whether the cause is negligible beside the earlier ones, whose model is not exact."""
        first, now, then = map(
            self.search.confirm.total, (self.start.held_out, base.held_out, best.held_out)
        )
        return now - then < _LEAST_OF_EARLIER * (first - now)

    def _family_p_value(self, best: Tried, base: Base, known: Sequence[str]) -> float:
        """:return: family-wise p-value on the half that selects"""
        h = self.search.hypotheses
        left = [c for c in (*h.candidates, *h.nameless) if c.key not in known]
        slopes = self.search.select.evidence.slopes(best.point)
        own = [h.indices(c) for c in left]
        fitted = (*base.free, *h.indices(best.candidate))
        gain = base.point.cost - best.point.cost
        p_value = family_p_value(slopes, own, base.free, fitted, gain, self.seed)
        return min(1.0, self.family * p_value)

    def _pruned(self, found: list[Accepted], base: Base) -> tuple[list[Accepted], Base]:
        """Remove causes that later ones have made superfluous."""
        for one in found[:-1]:
            if not self.search.needed(one.tried.candidate, base):
                base = self.search.without(base, one.tried.candidate)
                found = [other for other in found if other is not one]
        return found, base


def keys_of(found: Sequence[Accepted]) -> list[str]:
    return [one.tried.candidate.key for one in found]
