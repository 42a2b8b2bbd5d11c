"""Half of the recordings propose, the others confirm: models and candidates, ranked on both."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

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
from sb3_hds.sysid.estimation.evidence import Evidence, Point
from sb3_hds.sysid.estimation.normal_equations import DIVERGED

# Candidates that may be confirmed, one after the other.
_MOST_LOOKS = 3
#: mean square error of a window that cannot be simulated, in units of the noise
NOT_FINITE = DIVERGED**2


class Half(NamedTuple):
    """
    :param evidence: windows of one half of the recordings
    :param cluster: cluster of correlated errors that each window belongs to, shape ``(n,)``
    :param irrelevant: region of practical equivalence: error of each channel that is too small to
        matter, shape ``(n_obs,)``
    """

    evidence: Evidence
    cluster: Int[np.ndarray, " n"]
    irrelevant: Float[np.ndarray, " obs"]

    def errors(
        self, point: Point, channels: Sequence[int] | None = None
    ) -> Float[np.ndarray, " n"]:
        """
        :param channels: indices of those that count; default: all
        :return: mean square error of each window, that of practical equivalence added
        """
        own = slice(None) if channels is None else list(channels)
        noise = self.evidence.noise[own]
        errors = np.mean((point.residual[..., own] / noise) ** 2, (1, 2))
        errors = np.nan_to_num(errors, nan=NOT_FINITE, posinf=NOT_FINITE)
        return errors + float(np.mean((self.irrelevant[own] / noise) ** 2))

    def total(self, point: Point) -> float:
        return float(self.errors(point).sum())


class Base(NamedTuple):
    """
    The current model: the nominal one with the causes accepted so far.

    :param point: fitted to the windows for selection
    :param held_out: the same parameters on the other windows, start states refitted
    :param free: indices of the parameters that are refitted under every hypothesis
    """

    point: Point
    held_out: Point
    free: tuple[int, ...]


class Tried(NamedTuple):
    """
    The current model with one more candidate.

    :param candidate: which
    :param point: the best that was found on the windows for selection
    :param held_out: the same parameters on the other windows, start states refitted
    :param criterion: by which the information criterion is lower than without it
    """

    candidate: Candidate
    point: Point
    held_out: Point
    criterion: float


class Accepted(NamedTuple):
    """
    A cause that was confirmed.

    :param alternatives: keys of candidates that the data cannot distinguish from it
    :param family_p_value: family-wise p-value: that the best of all candidates gains as much if
        nothing is wrong
    :param share: of the force at its joint that it carries; None where that is not known
    :param sizes: estimate and interval of the equation of motion by parameter, where there are any
    :param of_equation: whether these are told, rather than those of a simulation
    :param doubts: by parameter, half the width of an interval that comes from not knowing whether
        there is one cause more
    :param rivals: the alternatives as they were fitted, those that were simulated
    """

    tried: Tried
    comparison: Comparison
    alternatives: tuple[str, ...]
    family_p_value: float
    share: float | None = None
    sizes: Mapping[str, tuple[float, float, float]] = {}
    of_equation: bool = False
    doubts: Mapping[str, float] = {}
    rivals: tuple[Tried, ...] = ()


class Effort(NamedTuple):
    """
    :param guessed: candidates that one Newton step must favour to be fitted at all
    :param finalists: candidates that are fitted to the end
    :param windows: most windows on which the others are compared
    :param steps: of the fits that choose the finalists
    :param profiles: whether intervals follow the likelihood, or are symmetric
    """

    guessed: int
    finalists: int
    windows: int
    steps: int
    profiles: bool


class Ranking(NamedTuple):
    """
    Fitted candidates in order of evidence, and what else the data would have in their place.

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
            if _has_more_freedom(simplest, other):
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
                and not _has_more_freedom(first, other)
                and (surely or not _has_more_freedom(other, first))
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
        others = [t for t in tried if t is not best and not _has_more_freedom(t, best)]
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


def _has_more_freedom(one: Tried, other: Tried) -> bool:
    return len(one.candidate.parameters) > len(other.candidate.parameters)
