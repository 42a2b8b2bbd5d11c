"""The search for causes: proposed on half of the recordings, confirmed on the others."""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, TypeVar

import numpy as np
from jaxtyping import Float

from sb3_hds.sysid.comparison.halves import Base, Effort, Half, Ranking, Tried
from sb3_hds.sysid.comparison.held_out import LEAST_BIC, Comparison, passes
from sb3_hds.sysid.comparison.inference import aliased_with
from sb3_hds.sysid.comparison.starts import Here, guesses
from sb3_hds.sysid.estimation.candidates import Candidate
from sb3_hds.sysid.estimation.evidence import Evidence, Point, in_threads
from sb3_hds.sysid.estimation.hypotheses import Hypotheses
from sb3_hds.sysid.estimation.shooting import Shots
from sb3_hds.sysid.progress import Bar

# Candidates that others are tried beside.
_MOST_FIRSTS = 4
# Steps of fits to the end and of rough ones, and of start states alone: to the end, and for a rough
# comparison.
_ALL_STEPS, _FEW_STEPS, _HELD_OUT_STEPS, _ROUGH_STEPS = 25, 8, 6, 1
_Given = TypeVar("_Given")
_Told = TypeVar("_Told")


class Place(NamedTuple):
    """
    Where a fit of a candidate ended, or may begin.

    :param theta: all parameters, shape ``(p,)``
    :param offsets: of the start states of the windows that it was fitted to, shape ``(n, free)``
    :param free: what was refitted beside it; beside another model, only its own values count
    :param blind: whether the slope at the null is no guide to the candidate
    :param start: of several starts, the best one
    """

    theta: np.ndarray
    offsets: np.ndarray
    free: tuple[int, ...]
    blind: bool = False
    start: Mapping[str, float] | None = None


class Rough(NamedTuple):
    """
    A candidate beside a model, fitted roughly on a sample of windows, or guessed only.

    :param cost: of the sample; infinite where it was only guessed
    """

    candidate: Candidate
    place: Place
    cost: float


class Search(NamedTuple):
    """
    Candidates on two halves of the evidence. What it answers depends on nothing that it was asked
    before: where fits begin is an argument.

    :param select: on which candidates are fitted and ranked
    :param confirm: on which the best is confirmed
    :param effort: how long to search
    :param bar: shows how far it is
    :param places: of candidates by key, where fits beside the nominal model ended
    """

    select: Half
    confirm: Half
    effort: Effort
    bar: Bar
    places: Mapping[str, Place] = {}

    @property
    def hypotheses(self) -> Hypotheses:
        return self.select.evidence.hypotheses

    @property
    def noise(self) -> Float[np.ndarray, " obs"]:
        return self.select.evidence.noise

    @property
    def ranking(self) -> Ranking:
        return Ranking(self.select, self.confirm)

    def with_noise(self, noise: Float[np.ndarray, " obs"]) -> "Search":
        select, confirm = (
            half._replace(evidence=half.evidence.with_noise(noise))
            for half in (self.select, self.confirm)
        )
        return self._replace(select=select, confirm=confirm)

    def from_places(self, rough: Sequence[Rough], fitted: Sequence[Tried]) -> "Search":
        """
        :param rough: candidates beside the nominal model
        :param fitted: those of them that were fitted to the end
        :return: a search whose fits begin there
        """
        places = {one.candidate.key: one.place for one in rough}
        for tried in fitted:
            key, point = tried.candidate.key, tried.point
            places[key] = places[key]._replace(theta=point.theta, offsets=point.offsets)
        return self._replace(places=places)

    def base(
        self,
        theta: Float[np.ndarray, " p"],
        free: Sequence[int],
        near: Base | None = None,
        rival: Base | None = None,
    ) -> Base:
        """
        :param near: from whose start states to begin; default: as measured
        :param rival: fits that are far from it are given up
        :return: a model, ``free`` refitted from ``theta``
        """
        begin = (None, None) if near is None else (near.point.offsets, near.held_out.offsets)
        most = (np.inf, np.inf) if rival is None else (rival.point.cost, rival.held_out.cost)
        point = self.select.evidence.fit(theta, free, begin[0], rival=most[0])
        held_out = self.confirm.evidence.fit(point.theta, (), begin[1], rival=most[1])
        return Base(point, held_out, tuple(free))

    def believing(self, tried: Tried, base: Base) -> Base:
        """:return: the model with this candidate"""
        own = self.hypotheses.indices(tried.candidate)
        return Base(tried.point, tried.held_out, (*base.free, *own))

    def without(
        self,
        base: Base,
        *candidates: Candidate,
        near: Base | None = None,
        rival: Base | None = None,
    ) -> Base:
        """
        :param near: from whose start states to begin; default: as measured
        :param rival: fits that are far from it are given up
        :return: the model without these candidates; the rest refitted
        """
        own = [i for candidate in candidates for i in self.hypotheses.indices(candidate)]
        theta = base.point.theta.copy()
        theta[own] = self.hypotheses.null[own]
        return self.base(theta, [i for i in base.free if i not in own], near, rival)

    def refit(self, base: Base) -> Base:
        """:return: the same model, refitted with the current noise"""
        point, held_out = base.point, base.held_out
        point = self.select.evidence.fit(point.theta, base.free, point.offsets)
        held_out = self.confirm.evidence.fit(point.theta, (), held_out.offsets)
        return Base(point, held_out, base.free)

    def pooled(self, base: Base) -> tuple[Half, Point]:
        """:return: all windows, and the model fitted to them"""
        pair = self.select, self.confirm
        shots = (half.evidence.shots for half in pair)
        shots = Shots(*map(np.concatenate, zip(*shots, strict=True)))
        cluster = np.concatenate([half.cluster for half in pair])
        whole = Half(self.select.evidence.on(shots), cluster, self.select.irrelevant)
        offsets = np.concatenate([base.point.offsets, base.held_out.offsets])
        return whole, whole.evidence.fit(base.point.theta, base.free, offsets)

    def fit_roughly(self, base: Base, accepted: Sequence[str]) -> list[Rough]:
        """
        :param accepted: keys of candidates that the model contains
        :return: promising candidates, fitted roughly on a sample of windows, best first; then the
            others
        """
        left = [c for c in self.hypotheses.candidates if c.key not in accepted]
        here = self._on_a_sample(base)
        same = {k: p.start for k, p in self.places.items() if p.start and p.free == base.free}
        guessed = guesses(here, left, same)
        places = {
            c.key: Place(guess.theta, guess.offsets, base.free, guess.blind, guess.start)
            for c, guess in zip(left, guessed, strict=True)
        }
        blind = [c for c in left if places[c.key].blind]
        seen = [(guess.gain, c) for c, guess in zip(left, guessed, strict=True) if not guess.blind]
        seen = sorted(seen, key=lambda pair: -pair[0])[: self.effort.guessed]
        likely = [*blind, *(candidate for _, candidate in seen)]

        def roughly(candidate: Candidate) -> Rough:
            place, earlier = places[candidate.key], self.places.get(candidate.key)
            blind = place.blind or (earlier is not None and earlier.blind)
            nearby = [place] if earlier is None else [place, earlier]
            theta, offsets = self._begin(candidate, here.point, base.free, here.evidence, nearby)
            moving = [*base.free, *self.hypotheses.indices(candidate)]
            # The way is longer for what began elsewhere.
            steps = self.effort.steps * (2 if blind else 1)
            point = here.evidence.fit(theta, moving, offsets, steps)
            place = place._replace(theta=point.theta, offsets=point.offsets, blind=blind)
            return Rough(candidate, place, point.cost)

        ranked = sorted(self._each(roughly, likely), key=lambda one: one.cost)
        rest = [c for c in left if c not in likely]
        return ranked + [Rough(c, self.places.get(c.key, places[c.key]), np.inf) for c in rest]

    def finalists(
        self, base: Base, accepted: Sequence[str], rough: Sequence[Rough] | None = None
    ) -> list[Tried]:
        """
        :param accepted: keys of candidates that the model contains
        :param rough: candidates beside this model, if they were fitted roughly already
        :return: the most promising candidates, fitted to the end, best first
        """
        rough = self.fit_roughly(base, accepted) if rough is None else rough
        best = [one for one in rough[: self.effort.finalists] if np.isfinite(one.cost)]
        near = {one.candidate.key: one.place for one in best}
        return self.fit([one.candidate for one in best], base, near)

    def fit(
        self,
        candidates: Sequence[Candidate],
        base: Base,
        near: Mapping[str, Place] | None = None,
        rival: float = np.inf,
        n_steps: int = _ALL_STEPS,
    ) -> list[Tried]:
        """
        :param near: where fits begin, of candidates by key; default: where those beside the nominal
            model ended, and of others where a Newton step leads
        :param rival: cost to come below; what does not is given up
        :param n_steps: at most
        :return: these candidates, fitted to the end, best first
        """
        places = {**self.places, **(near or {})}
        places |= self._guessed([c for c in candidates if c.key not in places], base)

        def finish(candidate: Candidate) -> Tried:
            place = places[candidate.key]
            point = self._continued(candidate, base, place, rival, n_steps)
            if point.cost >= rival:
                return Tried(candidate, point, base.held_out, -np.inf)
            held_out = self._held_out(place, point.theta, base.held_out.offsets, _HELD_OUT_STEPS)
            return Tried(
                candidate, point, held_out, self.ranking.criterion([candidate], point, base.point)
            )

        tried = self._each(finish, candidates)
        return sorted(tried, key=lambda t: -t.criterion)

    def fit_nameless(self, base: Base, roughly: bool = False) -> list[Tried]:
        """:return: flexible forces beside the model, fitted to the end or roughly, best first"""
        n_steps = _FEW_STEPS if roughly else _ALL_STEPS
        return self.fit(self.hypotheses.nameless, base, n_steps=n_steps)

    def _guessed(self, candidates: Sequence[Candidate], base: Base) -> dict[str, Place]:
        """Where fits of candidates begin."""
        if not candidates:
            return {}
        guessed = guesses(self._on_a_sample(base), candidates, {})
        return {
            c.key: Place(guess.theta, guess.offsets, base.free)
            for c, guess in zip(candidates, guessed, strict=True)
        }

    def fit_aliased(self, best: Tried, tried: Sequence[Tried], base: Base) -> list[Tried]:
        """
        :return: candidates that are aliased with the best one, by declaration or in these windows,
            and were not fitted to the end yet
        """
        done = {t.candidate.key for t in tried}
        slopes = self.select.evidence.slopes(best.point)
        alike = aliased_with(self.hypotheses, best.point, slopes, best.candidate, base.free)
        names = {c.key for c in self.hypotheses.related(best.candidate)} | set(alike)
        left = [c for c in self.hypotheses.candidates if c.key in names - done]
        return self.fit([c for c in left if not self.part_of(c, base)], base)

    def part_of(self, candidate: Candidate, base: Base) -> bool:
        """:return: whether the model has this candidate already"""
        return set(self.hypotheses.indices(candidate)) <= set(base.free)

    def compare_rest(
        self, base: Base, tried: Sequence[Tried]
    ) -> list[tuple[Candidate, Comparison]]:
        """
        :param tried: finalists beside the nominal model
        :return: candidates that were none, with their rough fits, compared on the other half
        """
        done = [t.candidate.key for t in tried]
        rest = [c for c in self.hypotheses.candidates if c.key not in done]

        def compared(candidate: Candidate) -> Comparison:
            place = self.places[candidate.key]
            held_out = self._held_out(place, place.theta, base.held_out.offsets, _ROUGH_STEPS)
            return self.ranking.compare_nested(held_out, base.held_out)

        return list(zip(rest, self._each(compared, rest), strict=True))

    def pairs(
        self, firsts: Sequence[Tried], base: Base, known: Candidate
    ) -> list[tuple[Tried, list[Tried]]]:
        """
        :param firsts: candidates beside the model, best first
        :param known: the one beside which others have been tried already
        :return: of each pair the first cause, and what was tried beside it, best first; the pair
            that selection prefers comes first
        """
        likely = [t for t in firsts if t.criterion >= LEAST_BIC and t.candidate != known]
        pairs = []
        for first in likely[:_MOST_FIRSTS]:
            seconds = self.finalists(self.believing(first, base), [first.candidate.key])
            if not seconds:
                continue
            both = [first.candidate, seconds[0].candidate]
            pairs.append(
                (self.ranking.criterion(both, seconds[0].point, base.point), first, seconds)
            )
        pairs.sort(key=lambda pair: -pair[0])
        return [(first, seconds) for _, first, seconds in pairs]

    def needed(self, candidate: Candidate, base: Base) -> bool:
        """:return: whether the model is significantly worse without this candidate"""
        return passes(
            self.ranking.compare_nested(base.held_out, self.without(base, candidate).held_out)
        )

    def _continued(
        self, candidate: Candidate, base: Base, place: Place, rival: float, n_steps: int
    ) -> Point:
        evidence = self.select.evidence
        moving = [*base.free, *self.hypotheses.indices(candidate)]
        theta, offsets = self._begin(candidate, base.point, base.free, evidence, [place])
        point = evidence.fit(theta, moving, offsets, n_steps, rival)
        return min(base.point, point, key=lambda p: p.cost)

    def _begin(
        self,
        candidate: Candidate,
        point: Point,
        free: tuple[int, ...],
        evidence: Evidence,
        places: Sequence[Place],
    ) -> tuple[np.ndarray, np.ndarray]:
        """
        :return: the one of several places that explains most, with the start states that explain
            each window best there
        """
        blind = any(place.blind for place in places)
        tried = []
        for place in places:
            theta, moving = point.theta.copy(), list(self.hypotheses.indices(candidate))
            offsets = [point.offsets]
            if place.free == free:
                moving += free
                if len(place.offsets) == evidence.shots.n:
                    offsets.append(place.offsets)
            theta[moving] = place.theta[moving]
            tried.append((theta, *evidence.nearest(theta, offsets, measured=blind)))
        theta, offsets, _ = min(tried, key=lambda one: one[2])
        return theta, offsets

    def _held_out(
        self, place: Place, theta: np.ndarray, offsets: np.ndarray, n_steps: int
    ) -> Point:
        """
        The start states of the half that confirms. Far from the model, they may be those of another
        motion.
        """
        half = self.confirm.evidence
        if place.blind:
            offsets = half.nearest(theta, [offsets], measured=True)[0]
        return half.fit(theta, (), offsets, n_steps)

    def _on_a_sample(self, base: Base) -> Here:
        """Of the windows that select, at most so many as the effort allows."""
        evidence, point, most = self.select.evidence, base.point, self.effort.windows
        if evidence.shots.n > most:
            rng = np.random.default_rng(0)
            sample = np.sort(rng.choice(evidence.shots.n, most, replace=False))
            evidence = evidence.on(evidence.shots.rows(sample))
            point = point._replace(offsets=point.offsets[sample])
        return Here(evidence, point, base.free, self.effort.steps)

    def _each(self, work: Callable[[_Given], _Told], given: Sequence[_Given]) -> list[_Told]:
        return list(self.bar.over(in_threads(work, given), len(given)))


def places_of(fitted: Sequence[Tried]) -> dict[str, Place]:
    """:return: where fits of these candidates ended, by key"""
    return {t.candidate.key: Place(t.point.theta, t.point.offsets, ()) for t in fitted}
