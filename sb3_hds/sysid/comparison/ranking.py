"""Fitted candidates in order of evidence, and what else the data would have in their place."""

from collections.abc import Sequence
from typing import NamedTuple

from sb3_hds.sysid.comparison.halves import Base, Half, Tried, has_more_freedom
from sb3_hds.sysid.comparison.held_out import (
    LEAST_BIC,
    LEAST_GAIN,
    LEVEL,
    Comparison,
    as_good,
    by_scores,
    effective_size,
    information_gain,
    passes,
    t_or_rank_test,
)
from sb3_hds.sysid.estimation.candidates import Candidate
from sb3_hds.sysid.estimation.evidence import Point

# Candidates that may be confirmed, one after the other.
_MOST_LOOKS = 3


class Ranking(NamedTuple):
    """
    :param select: half of the recordings, on which candidates were fitted
    :param confirm: the other half
    """

    select: Half
    confirm: Half

    def best(self, tried: Sequence[Tried], base: Base, n_found: int = 0) -> Tried | None:
        """
        :param tried: best first
        :param n_found: causes and comparisons before this one: each makes the level stricter
        :return: the candidate that selection prefers, if the other recordings confirm it; of two
            that they confirm and that predict equally well, the one with fewer parameters. Where
            they do not, the next ones may be confirmed, each at half the level of the one before.
        """
        likely = [t for t in tried if t.criterion >= LEAST_BIC]
        if not likely:
            return None
        simplest = likely[0]
        for other in likely[1:]:
            if has_more_freedom(simplest, other):
                simplest = (
                    other if as_good(self.compare(simplest.held_out, other.held_out)) else simplest
                )
        level = LEVEL / (1 + n_found)
        for one in [simplest, *(t for t in likely if t is not simplest)][:_MOST_LOOKS]:
            if passes(self.compare_nested(one.held_out, base.held_out), level):
                return one
            level *= 0.5
        return None

    def best_on_pooled_data(
        self, first: Tried, tried: Sequence[Tried], base: Base, n_found: int = 0
    ) -> Tried:
        """
        :param first: confirmed
        :param tried: it, and what else may be
        :param n_found: as in :meth:`best`
        :return: of all that are confirmed and have no fewer parameters, the one that both halves
            together prefer; what has more has to be as far ahead as a cause has to be of none
        """
        error_of_first, ahead_of_first = self._of_all(first, base)
        best, most = first, ahead_of_first
        for other in (t for t in tried if t.criterion >= LEAST_BIC):
            error, ahead = self._of_all(other, base)
            surely = (
                error <= (1.0 - LEAST_GAIN) * error_of_first and ahead >= ahead_of_first + LEAST_BIC
            )
            if (
                ahead > most
                and not has_more_freedom(first, other)
                and (surely or not has_more_freedom(other, first))
                and passes(
                    self.compare_nested(other.held_out, base.held_out), LEVEL / (1 + n_found)
                )
            ):
                best, most = other, ahead
        return best

    def alternatives(self, best: Tried, tried: Sequence[Tried], base: Base) -> tuple[str, ...]:
        """
        :return: candidates that are not significantly worse than the best and have no more
            parameters
        """
        others = [t for t in tried if t is not best and not has_more_freedom(t, best)]
        equal = [t for t in others if as_good(self.compare(best.held_out, t.held_out))]
        return tuple(
            t.candidate.key for t in equal if passes(self.compare_nested(t.held_out, base.held_out))
        )

    def criterion(self, candidates: Sequence[Candidate], point: Point, base: Point) -> float:
        """:return: by which the information criterion is lower with these candidates"""
        n = effective_size(base.residual / self.select.evidence.noise)
        before, after = map(self.select.total, (base, point))
        return information_gain(before, after, n, sum(len(c.parameters) for c in candidates))

    def compare(self, new: Point, old: Point) -> Comparison:
        """:return: comparison of two models on the half that confirms"""
        half = self.confirm
        return t_or_rank_test(half.errors(new), half.errors(old), half.cluster)

    def compare_nested(self, new: Point, old: Point) -> Comparison:
        """:return: as :meth:`compare`, of nested models"""
        comparison = self.compare(new, old)
        by_score = by_scores(
            new.residual / self.select.evidence.noise,
            old.residual / self.select.evidence.noise,
            self.confirm.cluster,
        )
        return comparison._replace(p_value=min(comparison.p_value, by_score))

    def _of_all(self, tried: Tried, base: Base) -> tuple[float, float]:
        """
        :return: error on both halves, with the parameters fitted to the first; and the criterion
        """
        n = sum(
            effective_size(point.residual / self.select.evidence.noise)
            for point in (base.point, base.held_out)
        )
        before, after = (
            self.select.total(one.point) + self.confirm.total(one.held_out) for one in (base, tried)
        )
        return after, information_gain(before, after, n, len(tried.candidate.parameters))
