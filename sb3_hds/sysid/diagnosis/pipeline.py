"""The course of a diagnosis: propose on half of the recordings, confirm on the others."""

import math
from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np

from sb3_hds.core import AnalyticTwin, Effect, Trajectories, Twin
from sb3_hds.core.twin import plant_of
from sb3_hds.sysid.belief.opened import nothing_known, open_answers
from sb3_hds.sysid.checks.adequacy import distances, far_in_words
from sb3_hds.sysid.checks.conventions import Convention
from sb3_hds.sysid.checks.timing import stepping_by
from sb3_hds.sysid.comparison.halves import Accepted, Base, Effort, Tried
from sb3_hds.sysid.comparison.held_out import Comparison
from sb3_hds.sysid.comparison.inference import detectable_sizes
from sb3_hds.sysid.comparison.search import Search
from sb3_hds.sysid.comparison.several import confirmed_set, one_does_as_well, proposed_set
from sb3_hds.sysid.diagnosis.findings import (
    SMALL,
    bounds_in_words,
    by_horizon,
    contradiction,
    errs_more,
    finding,
    in_words,
    look_alike,
    nameless_in_words,
    out_of_reach,
    to_tell_apart,
    verdict_of,
    why,
)
from sb3_hds.sysid.diagnosis.naming import Naming, keys_of
from sb3_hds.sysid.diagnosis.preparation import IRRELEVANT, hash_of, prepare
from sb3_hds.sysid.diagnosis.residuals import LEAST_SHARE, Left, Residuals
from sb3_hds.sysid.equation.screening import Screened
from sb3_hds.sysid.estimation.candidates import Candidate
from sb3_hds.sysid.estimation.evidence import Point
from sb3_hds.sysid.estimation.parameters import Belief, at_limit
from sb3_hds.sysid.progress import Bar
from sb3_hds.sysid.reporting.diagnosis import Diagnosis
from sb3_hds.sysid.reporting.finding import Rejected
from sb3_hds.sysid.reporting.pictures import pictures_of

# Several causes that explain less than this share of what can be explained are not named.
_LEAST_OF_SEVERAL = 0.5
# Candidates that are fitted to the end to settle the noise.
_FOR_NOISE = 3
# How long to search.
EFFORTS = {
    "full": Effort(guessed=12, finalists=8, windows=256, steps=4, profiles=True),
    "quick": Effort(guessed=8, finalists=4, windows=64, steps=2, profiles=False),
}
# Errors count as noise up to here: what runs away says nothing of it.
_WORST = 10.0


class Inquiry:
    """
    One run of :func:`~sb3_hds.sysid.diagnose`, step by step.

    :param twin: nominal model
    :param data: measured
    :param effects: classes of what may be wrong
    :param calibrate: names of nuisance parameters, or a prior for each
    :param seed: of the split
    :param budget: how long to search: a key of ``EFFORTS``
    :param progress: whether a bar shows how far it is, or that bar
    """

    def __init__(
        self,
        twin: Twin,
        data: Trajectories,
        effects: tuple[type[Effect], ...],
        calibrate: Sequence[str] | Mapping[str, Belief],
        seed: int,
        budget: str,
        progress: bool | Bar,
    ) -> None:
        self.seed = seed
        self.bar = progress if isinstance(progress, Bar) else Bar(progress)
        self.data_hash = hash_of(data)
        self.given = prepare(twin, data, effects, calibrate, seed, self.bar)
        self.nominal = self.given.nominal
        self.hypotheses, self.screened = self.given.hypotheses, self.given.screened
        self.effort = EFFORTS[budget]

    def split_halves(self) -> None:
        """Set up both halves of the data, and typical sizes of the parameters on this machine."""
        select, confirm = self.given.halves()
        self.hypotheses = select.evidence.hypotheses
        self._use(Search(select, confirm, self.effort, self.bar))

    def _use(self, search: Search) -> None:
        self.search, self.residuals = search, Residuals(self.given, search, self.seed)

    def run(self) -> Diagnosis:
        if self.given.convention is not None:
            return self.wrong_convention(self.given.convention)
        self.split_halves()
        if self.screened and len(self.screened.members) > 1:
            several = self._several(self.screened)
            if several is not None:
                return several
        self.settle_noise()
        start = self.search.base(self.hypotheses.null, self.hypotheses.nuisances)
        self.bar.stage("comparing causes")
        rough = self.search.fit_roughly(start, [])
        firsts = self.search.finalists(start, [], rough)
        self._use(self.search.from_places(rough, firsts))
        naming = Naming(self.search, start, self.seed, family=self._family())
        rejected = self._each_alone(firsts, start)
        found, base = naming.one_by_one(firsts)
        self.bar.stage("confirming causes")
        before = left = self.residuals.left(start)
        nearest = ""
        if found:
            found, base, left, nearest = self.residuals.constant(found, base)
        if len(found) == 1 and left.predictable is not None and self.screened is None:
            pair = naming.pair(found[0], base, firsts) or naming.without_reranking(firsts)
            if pair is not None and (rest := self.residuals.left_by(*pair)) is not None:
                found, base, left = *pair, rest
        self.bar.stage("what is left")
        found, base, force = naming.replaced_by_forces(found, base)
        if force is not None:
            left = self.residuals.left(base)
        elif not found or left.predictable is not None:
            force = naming.nameless(base, keys_of(found))
        if force is not None:
            words = nameless_in_words(*force, self.hypotheses)
            nearest = " ".join(filter(None, (nearest, words)))
        self.rejected_for = naming.rejected_for | self.residuals.rejected_for
        if found and self.residuals.explained(found, start, base, before, left) < LEAST_SHARE:
            # Something is there, and this is not it.
            found, base = [], start
            left = before if before.predictable is not None else left
        rejected = [pair for pair in rejected if pair[0].key not in keys_of(found)]
        if not (found or nearest) and left.predictable is None:
            nearest = contradiction(rejected)
        self._set_noise(base.point)
        start, base = map(self.search.refit, (start, base))
        if at_bounds := self._at_bounds(base):
            found, base, left, nearest = [], start, before, at_bounds
        elif not (found or nearest) and left.predictable is None:
            nearest = self._far_off(base)
        return self._result(found, rejected, start, base, before, left, nearest)

    def _family(self) -> float:
        """:return: candidates that there were, for each that is simulated"""
        if not self.screened:
            return 1.0
        return len(self.screened.hypotheses.candidates) / max(len(self.hypotheses.candidates), 1)

    def _several(self, screened: Screened) -> Diagnosis | None:
        """:return: a diagnosis of several causes at once, if held-out recordings confirm them"""
        self.bar.stage("settling the noise")
        start = self.search.base(self.hypotheses.null, self.hypotheses.nuisances)
        self._set_noise(start.point)
        whole = proposed_set(self.search, screened, start)
        self._set_noise(min((start.point, whole.point), key=lambda point: point.cost))
        start, whole = map(self.search.refit, (start, whole))
        self.bar.stage("confirming causes")
        found, base = confirmed_set(self.search, screened, start, whole)
        naming = Naming(self.search, start, self.seed, family=self._family())
        if len(found) == 1:
            found, base = naming.beside(found, base)
        if len(found) < 2 or one_does_as_well(self.search, screened, found, start, base):
            return None
        self.bar.stage("what is left")
        before, left = self.residuals.left(start), self.residuals.left(base)
        if self.residuals.explained(found, start, base, before, left) < _LEAST_OF_SEVERAL:
            return None
        nearest = ""
        confirmed = found
        found, base, force = naming.replaced_by_forces(found, base)
        if force is not None:
            left, nearest = self.residuals.left(base), nameless_in_words(*force, self.hypotheses)
        beaten = [(c.tried.candidate, c.comparison) for c in confirmed if c not in found]
        self._set_noise(base.point)
        start, base = map(self.search.refit, (start, base))
        if at_bounds := self._at_bounds(base):
            found, base, left, nearest = [], start, before, at_bounds
        self.rejected_for = naming.rejected_for | {key: SMALL for key in screened.hints}
        return self._result(found, beaten, start, base, before, left, nearest)

    def _each_alone(
        self, firsts: Sequence[Tried], start: Base
    ) -> list[tuple[Candidate, Comparison]]:
        """:return: every candidate alone, on the half that confirms"""
        weighed = [
            (t.candidate, self.search.ranking.compare_nested(t.held_out, start.held_out))
            for t in firsts
        ]
        return weighed + self.search.compare_rest(start, firsts)

    def refused(self, reason: str) -> Diagnosis:
        return Diagnosis(
            verdict="not_identifiable",
            believed=self.nominal,
            caveats=(
                reason,
                *(str(found) for found in self.given.audit.findings if not found.blocks),
                *self.given.corrected,
            ),
            twin=self.nominal,
            data_hash=self.data_hash,
            seed=self.seed,
            opened=partial(nothing_known, self.nominal, self._least_errors(), self.given.data),
        )

    def _least_errors(self) -> np.ndarray:
        """:return: region of practical equivalence of each channel, or its sensor's noise"""
        return np.maximum(IRRELEVANT * self.given.std, self.given.sensor_noise)

    def wrong_convention(self, convention: Convention) -> Diagnosis:
        """:return: the verdict that the log does not follow the conventions of the model"""
        return Diagnosis(
            verdict="unknown",
            believed=self.nominal,
            convention=convention.key,
            unexplained=f"{convention.words} No cause was looked for.",
            caveats=(*map(str, self.given.audit.findings), *self.given.corrected),
            twin=self.nominal,
            data_hash=self.data_hash,
            seed=self.seed,
        )

    def settle_noise(self) -> None:
        """Estimate the noise from the residuals of the best explanation, of whatever kind."""
        self.bar.stage("settling the noise")
        base = self.search.base(self.hypotheses.null, self.hypotheses.nuisances)
        self._set_noise(base.point)
        base = self.search.base(self.hypotheses.null, self.hypotheses.nuisances)
        rough = self.search.fit_roughly(base, [])
        tried = self.search.finalists(base, [], rough[:_FOR_NOISE])
        self._use(self.search.from_places(rough, tried))
        self._set_noise(min((base.point, *(t.point for t in tried)), key=lambda p: p.cost))

    def _set_noise(self, point: Point) -> None:
        most = _WORST * self.given.std
        error = np.minimum(
            np.where(np.isfinite(point.residual), np.abs(point.residual), np.inf), most
        )
        noise = np.mean(error**2, (0, 1)) + (IRRELEVANT * self.given.std) ** 2
        self._use(self.search.with_noise(np.sqrt(noise)))

    def _extended(self, causes: Sequence[str], theta: np.ndarray) -> Twin:
        """:return: the twin as it came, at its own interval, with these causes in it"""
        twin = self.hypotheses.extended_by(causes, theta)
        plant, own = plant_of(twin), plant_of(self.nominal)
        if isinstance(own, AnalyticTwin) and plant.structure()[-1] != own.structure()[-1]:
            twin = stepping_by(twin, own.integrator)
        return twin.at_interval(self.nominal.dt, self._substeps)

    @property
    def _substeps(self) -> int:
        """Of the extended twin: its own, or as short ones as dry friction needs."""
        own, simulated = self.nominal, self.hypotheses.nominal
        if not self.screened or simulated.substeps <= self.given.least_substeps:
            return own.substeps
        inner = simulated.dt / simulated.substeps
        return max(own.substeps, math.ceil(own.dt / inner - 1e-9))

    def _beside_the_equation(self, found: Sequence[Accepted]) -> list[Accepted]:
        """
        :return: several causes with what the equation of motion says of their sizes, where it does;
            a single one is known by simulation to a fraction of what that is off by
        """
        if not self.screened or len(found) < 2 or all(one.sizes for one in found):
            return list(found)
        told = self.screened.estimates(keys_of(found))
        return [
            one
            if one.sizes or one.tried.candidate.key not in told
            else one._replace(**told[one.tried.candidate.key]._asdict())
            for one in found
        ]

    def _finer(self) -> list[str]:
        more, own = self._substeps, self.nominal.substeps
        if more == own:
            return []
        return [
            f"Dry friction is so strong that the twin's own sub-steps smooth it: the extended one "
            f"takes {more} in an interval, not {own}."
        ]

    def _at_bounds(self, base: Base) -> str:
        """:return: a sentence on nuisances that end at a bound, if any does"""
        h, (_, point) = self.hypotheses, self.search.pooled(base)
        ends = [
            i for i in h.nuisances if at_limit(point.theta[i], h.lower[i], h.upper[i], h.null[i])
        ]
        units = {name: p.unit for name, p in h.twin.parameters.items()}
        return bounds_in_words(
            [(h.names[i], point.theta[i], h.null[i], units[h.names[i]]) for i in ends]
        )

    def _far_off(self, base: Base) -> str:
        """:return: a sentence on how far held-out windows are from the model, if they are"""
        residual = self.search.confirm.evidence.fit(
            base.point.theta, (), base.held_out.offsets
        ).residual
        found = distances(self.nominal.channels, residual, self.given.sensor_noise, self.given.std)
        return far_in_words(found)

    def _result(
        self,
        found: Sequence[Accepted],
        rejected: Sequence[tuple[Candidate, Comparison]],
        start: Base,
        base: Base,
        before: Left,
        left: Left,
        nearest: str,
    ) -> Diagnosis:
        self.bar.stage("sizes and intervals")
        select, confirm = self.search.select, self.search.confirm
        whole, point = self.search.pooled(base)
        findings = tuple(
            finding(one, whole, point, base.free, self.effort.profiles)
            for one in self._beside_the_equation(found)
        )
        remains = "" if left.predictable is None else in_words(left.predictable)
        unexplained = " ".join(filter(None, (nearest, remains)))
        gain = by_horizon(confirm, start.held_out, base.held_out, self.given.thinning)
        return Diagnosis(
            verdict=verdict_of(findings, unexplained),
            believed=self.nominal,
            findings=findings,
            unexplained=unexplained,
            gain=gain,
            explained=self.residuals.explained(found, start, base, before, left)
            if findings
            else 0.0,
            detectable=detectable_sizes(
                self.search.select, start.point, self.screened.detectable if self.screened else {}
            ),
            rejected=tuple(
                Rejected(one.key, c.gain, c.p_value, why(c, self.rejected_for.get(one.key)))
                for one, c in sorted(rejected, key=lambda pair: -pair[1].gain)
            ),
            caveats=(
                *map(str, self.given.audit.findings),
                *self.given.corrected,
                *self._finer(),
                *to_tell_apart(found, self.hypotheses),
                *look_alike([one for one in found if not one.of_equation], select, base),
                *out_of_reach(confirm, base.held_out, self.given.origin[self.given.parts.held_out]),
                *(errs_more(gain) if findings else ()),
            ),
            twin=self._extended(keys_of(found), point.theta),
            data_hash=self.data_hash,
            seed=self.seed,
            pictures=pictures_of(
                confirm,
                start.held_out,
                base.held_out,
                self.given.thinning,
                before.residual,
                left.residual,
                self.screened.friction_curves(keys_of(found)) if self.screened else (),
            ),
            opened=partial(
                open_answers,
                self.search,
                found,
                [one for one, _ in sorted(rejected, key=lambda pair: -pair[1].gain)],
                base,
                self._extended,
                self.given.data,
                self.given.thinning,
                unexplained,
            ),
        )
