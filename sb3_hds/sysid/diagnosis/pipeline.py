"""How a diagnosis goes: propose on some recordings, confirm once on others, see what is left."""

import dataclasses
import hashlib
from collections.abc import Mapping, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from sb3_hds.core import AnalyticTwin, Effect, Trajectories, Twin
from sb3_hds.core.twin import plant_of
from sb3_hds.data import Audit, audit
from sb3_hds.data.audit.differences import BackwardDifference
from sb3_hds.data.audit.outliers import Glitches, Outliers
from sb3_hds.effects import NAMELESS as NAMELESS_EFFECTS
from sb3_hds.sysid.belief.opened import nothing_known, open_answers
from sb3_hds.sysid.checks.adequacy import distances, far_in_words, noise_of
from sb3_hds.sysid.checks.conventions import Convention, other_convention
from sb3_hds.sysid.checks.divergence import divergence_rate
from sb3_hds.sysid.checks.leapfrog import in_step_with_the_log, stepping_by
from sb3_hds.sysid.checks.parameter_stability import Change, change
from sb3_hds.sysid.checks.timing import in_step
from sb3_hds.sysid.comparison.held_out import Comparison, split
from sb3_hds.sysid.comparison.scales import sized
from sb3_hds.sysid.comparison.search import Base, Effort, Half, Search, Tried, as_good
from sb3_hds.sysid.comparison.several import confirmed_set, proposed_set
from sb3_hds.sysid.comparison.unexplained import (
    MissingForce,
    Remainder,
    ShortWindows,
    missing_force,
    remainder,
    short_windows,
    weighed,
)
from sb3_hds.sysid.diagnosis.account import by_horizon, detectable, pictures_of
from sb3_hds.sysid.diagnosis.findings import (
    NO_CONSTANT,
    SMALL,
    Accepted,
    contradiction,
    errs_more,
    finding,
    in_words,
    look_alike,
    nameless_in_words,
    nearest_in_words,
    out_of_reach,
    stuck_in_words,
    to_tell_apart,
    why,
)
from sb3_hds.sysid.diagnosis.naming import Naming, keys_of
from sb3_hds.sysid.diagnosis.progress import Bar
from sb3_hds.sysid.equation.motion import Motion, motion
from sb3_hds.sysid.equation.screening import SMALL_MACHINE, Screened, screen
from sb3_hds.sysid.estimation.calibrate import spread_of
from sb3_hds.sysid.estimation.evidence import Evidence, Point, portion_for
from sb3_hds.sysid.estimation.hypotheses import Candidate, Hypotheses
from sb3_hds.sysid.estimation.priors import Belief, at_limit
from sb3_hds.sysid.estimation.shooting import Shots, evenly, shots_of
from sb3_hds.sysid.estimation.thinning import thinned
from sb3_hds.sysid.reporting.diagnosis import MANY, Diagnosis
from sb3_hds.sysid.reporting.finding import Rejected

# Length of a window in periods of the motion, within these numbers of steps; it is half as long
# where there would be fewer windows than that.
_WINDOW, _SHORTEST, _LONGEST, _FEW = 0.75, 8, 200, 24
# Logarithm of how much an error of a start state may grow within a window: where it grows more,
# some windows are fitted by another motion than the one that was measured.
_GROWTH = 4.0
# Several causes that explain less than this share of what can be explained are not believed.
_LEAST_OF_SEVERAL = 0.5
# A cause that explains less than this share of what can be explained is not the cause.
_LEAST_SHARE = 0.9
# The same of a cause and of how its size changes with time: a force whose form is a little wrong
# seems to change with position or speed, but not with time.
_LEAST_SHARE_IN_TIME = 0.95
# Windows of each half that are simulated, where machines have more joints than a few: each joint
# makes each more expensive.
_WINDOWS_OF_ALL_JOINTS, _ALL_WINDOWS = 240, 1_000_000
# Candidates that are fitted to the end to settle the noise.
_FOR_NOISE = 3
# How long to search.
EFFORTS = {"full": Effort(12, 8, 256, 4, True), "quick": Effort(8, 4, 64, 2, False)}
# Errors that nobody minds, in shares of a channel's spread: no simulation is exact, and a finding
# must matter.
_IRRELEVANT = 5e-3
# A force that moves a short window by a smaller share of that is no remainder.
_OF_IRRELEVANT = 0.18
# Errors count as noise up to here: what runs away says nothing of it.
_WORST = 10.0
# Noise before it is known, in the same units.
_FIRST_NOISE = 0.05
# Parameters that a cause has at most, and fewer units of evidence than these cannot say anything.
_WIDEST, _FEWEST_UNITS = 3, 6


class _Left(NamedTuple):
    """
    What a twin leaves.

    :param remainder: what can be predicted of it
    :param predicted: mean square of that, in units of the force's error under the search's noise
    :param power: mean square of all of it, likewise
    :param missing: all of it
    :param short: windows that ask for it
    """

    remainder: Remainder | None
    predicted: float
    power: float
    missing: MissingForce
    short: ShortWindows


class Inquiry:
    """
    One diagnosis on its way.

    :param twin: as it is believed
    :param data: measured
    :param effects: classes of what may be wrong
    :param calibrate: names of nuisances, or what is believed of each
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
        self.believed, self.seed = twin, seed
        self.bar = progress if isinstance(progress, Bar) else Bar(progress)
        self.bar.stage("reading the log")
        self.data_hash = _hash(data)
        data, self.audit, corrected = _without_glitches(twin, data)
        data, in_time = in_step(twin, data)
        self.sensor_noise = noise_of(data)
        twin, data, as_logged = in_step_with_the_log(twin, data)
        self.corrected = (*corrected, *in_time, *as_logged)
        moved = motion(twin, data)
        coarse, self.data, self.every = thinned(twin, data, moved.fastest)
        self.period = moved.typical_period
        self.convention = self.screened = None
        if not self.audit.reason:
            self.bar.stage("trying conventions")
            self.convention = other_convention(twin, moved, tuple(calibrate))
        if not self.audit.reason and self.convention is None:
            self.bar.stage("equation of motion")
            self.screened = screen(twin, moved, effects, calibrate)
        only = self.screened and self.screened.keys
        where = self.screened and self.screened.nameless_at
        self.hypotheses = Hypotheses.about(
            coarse, effects, calibrate, only, where, moved.typical_period, tuple(moved.speed)
        )
        self.spread = spread_of(self.data)
        self.shots, self.origin = shots_of(
            self.data,
            self._window(twin, moved),
            self.hypotheses.twin,
            period=self.period,
        )
        self.most_windows = _ALL_WINDOWS
        if len(twin.joints) > SMALL_MACHINE:
            self.most_windows = _WINDOWS_OF_ALL_JOINTS // len(twin.joints)
            some = evenly(len(self.origin), 2 * self.most_windows)
            self.shots, self.origin = _rows_of(self.shots, some), self.origin[some]
        self.parts = split(self.data, self.origin, seed)
        self.effort = EFFORTS[budget]
        self.turned_down: dict[str, str] = {}

    def _window(self, twin: Twin, moved: Motion) -> int:
        """:return: steps of the windows that are simulated"""
        rate = divergence_rate(twin, moved)
        span = _WINDOW * self.period
        return _window_of(self.data, min(span, _GROWTH / rate) if rate else span)

    def poor(self) -> str:
        """:return: why these data cannot support a verdict; empty if they may"""
        if self.audit.reason:
            return self.audit.reason
        rows = ~self.parts.confirm, self.parts.confirm
        units = [len(np.unique(self.parts.unit[own])) for own in rows]
        if min(units) < _FEWEST_UNITS // 2:
            return (
                f"{sum(units)} pieces of evidence are too few to propose on some and confirm on "
                "others. Record at least four times as long, or several recordings."
            )
        return ""

    def prepare(self) -> None:
        """Two halves of the evidence, and sizes of parameters that suit the machine."""
        rows = ~self.parts.confirm, self.parts.confirm
        shots = [_rows_of(self.shots, own) for own in rows]
        evidence = Evidence(
            self.hypotheses,
            shots[0],
            self.spread,
            width=len(self.hypotheses.nuisances) + max(_WIDEST, self._n_proposed()),
            portion=portion_for(max(own.n for own in shots)),
        )
        if self.screened:
            evidence = dataclasses.replace(
                evidence, hypotheses=self.hypotheses.scaled(self.screened.scales)
            )
        self.hypotheses = sized(evidence, self.data)
        evidence = dataclasses.replace(
            evidence, hypotheses=self.hypotheses, noise=_FIRST_NOISE * self.spread
        )
        halves = [
            Half(evidence.on(own), self.parts.unit[chosen], _IRRELEVANT * self.spread)
            for own, chosen in zip(shots, rows, strict=True)
        ]
        self.search = Search(halves[0], halves[1], self.effort, self.bar)

    def run(self) -> Diagnosis:
        if self.convention is not None:
            return self.in_other_words(self.convention)
        self.prepare()
        if self.screened and len(self.screened.members) > 1:
            several = self._several(self.screened)
            if several is not None:
                return several
        self.settle_noise()
        start = self.search.base(self.hypotheses.null, self.hypotheses.nuisances)
        self.bar.stage("comparing causes")
        naming = Naming(self.search, start, self.seed, family=self._family())
        firsts = self.search.finalists(start, [])
        rejected = self._weighed(firsts, start)
        found, base = naming.one_by_one(firsts)
        self.bar.stage("confirming causes")
        before = left = self._left(start)
        nearest = ""
        if found:
            found, base, left, nearest = self._constant(found, base)
        if len(found) == 1 and left.remainder is not None and self.screened is None:
            pair = naming.pair(found[0], base, firsts) or naming.several_as_confirmed(firsts)
            if pair is not None and (rest := self._left_by(*pair)) is not None:
                found, base, left = *pair, rest
        self.bar.stage("what is left")
        found, base, force = naming.outdone(found, base)
        if force is not None:
            left = self._left(base)
        elif not found or left.remainder is not None:
            force = naming.nameless(base, keys_of(found))
        if force is not None:
            words = nameless_in_words(*force, self.hypotheses)
            nearest = " ".join(filter(None, (nearest, words)))
        self.turned_down = naming.turned_down | self.turned_down
        if found and self._explained(found, start, base, before, left) < _LEAST_SHARE:
            # Something is there, and this is not it.
            found, base = [], start
            left = before if before.remainder is not None else left
        rejected = [pair for pair in rejected if pair[0].key not in keys_of(found)]
        if not (found or nearest) and left.remainder is None:
            nearest = contradiction(rejected)
        self._set_noise(base.point)
        start, base = map(self.search.again, (start, base))
        if stuck := self._stuck(base):
            found, base, left, nearest = [], start, before, stuck
        elif not (found or nearest) and left.remainder is None:
            nearest = self._far_off(base)
        return self._told(found, rejected, start, base, before, left, nearest)

    def _n_proposed(self) -> int:
        members = self.screened.members if self.screened else ()
        return sum(len(self.screened.problem.items[m.item].candidate.parameters) for m in members)  # type: ignore[union-attr]

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
        start, whole = map(self.search.again, (start, whole))
        self.bar.stage("confirming causes")
        found, base = confirmed_set(self.search, screened, start, whole)
        if len(found) < 2 or self._outdone_by_a_candidate(start, base):
            return None
        self.bar.stage("what is left")
        before, left = self._left(start), self._left(base)
        if self._explained(found, start, base, before, left) < _LEAST_OF_SEVERAL:
            return None
        nearest = ""
        naming = Naming(self.search, start, self.seed, family=self._family())
        confirmed = found
        found, base, force = naming.outdone(found, base)
        if force is not None:
            left, nearest = self._left(base), nameless_in_words(*force, self.hypotheses)
        beaten = [(c.tried.candidate, c.verdict) for c in confirmed if c not in found]
        self._set_noise(base.point)
        start, base = map(self.search.again, (start, base))
        if stuck := self._stuck(base):
            found, base, left, nearest = [], start, before, stuck
        self.turned_down = naming.turned_down | {key: SMALL for key in screened.hints}
        return self._told(found, beaten, start, base, before, left, nearest)

    def _outdone_by_a_candidate(self, start: Base, base: Base) -> bool:
        """Whether a force without a name that somebody asked for does better than the set."""
        names = {kind.name for kind in NAMELESS_EFFECTS}
        asked = [c for c in self.hypotheses.candidates if c.name in names]
        return any(
            t.point.cost < base.point.cost and not as_good(self.search.better(t.kept, base.kept))
            for t in self.search.finished(asked, start)
        )

    def _weighed(self, firsts: Sequence[Tried], start: Base) -> list[tuple[Candidate, Comparison]]:
        """:return: every candidate alone, on the half that confirms"""
        weighed = [(t.candidate, self.search.confirmed(t.kept, start.kept)) for t in firsts]
        return weighed + self.search.others(start, firsts)

    def refused(self, reason: str) -> Diagnosis:
        return Diagnosis(
            verdict="not_identifiable",
            believed=self.believed,
            caveats=(
                reason,
                *(str(found) for found in self.audit.findings if not found.blocks),
                *self.corrected,
            ),
            twin=self.believed,
            data_hash=self.data_hash,
            seed=self.seed,
            opened=partial(nothing_known, self.believed, self._least_errors(), self.data),
        )

    def _least_errors(self) -> np.ndarray:
        """:return: errors of each channel that nobody minds, or its sensor's noise"""
        least = np.maximum(_IRRELEVANT * self.spread, self.sensor_noise)
        return np.maximum(least, _IRRELEVANT)

    def in_other_words(self, convention: Convention) -> Diagnosis:
        """:return: that the log is not written in the model's conventions"""
        return Diagnosis(
            verdict="unknown",
            believed=self.believed,
            convention=convention.key,
            unexplained=(
                f"{convention.words} The equation of motion then leaves {convention.after:.1f} "
                f"times the noise, not {convention.before:.0f} times. No cause was looked for."
            ),
            caveats=(*map(str, self.audit.findings), *self.corrected),
            twin=self.believed,
            data_hash=self.data_hash,
            seed=self.seed,
        )

    def settle_noise(self) -> None:
        """What is left under the best explanation, of whatever kind, is the noise."""
        self.bar.stage("settling the noise")
        base = self.search.base(self.hypotheses.null, self.hypotheses.nuisances)
        self._set_noise(base.point)
        base = self.search.base(self.hypotheses.null, self.hypotheses.nuisances)
        likely = [candidate for candidate, _ in self.search.glances(base, [])[:_FOR_NOISE]]
        tried = self.search.finished(likely, base)
        self._set_noise(min((base.point, *(t.point for t in tried)), key=lambda p: p.cost))

    def _set_noise(self, point: Point) -> None:
        most = _WORST * self.spread
        error = np.minimum(np.where(np.isfinite(point.raw), np.abs(point.raw), np.inf), most)
        noise = np.mean(error**2, (0, 1)) + (_IRRELEVANT * self.spread) ** 2
        self.search.set_noise(np.sqrt(noise))

    def _constant(
        self, found: list[Accepted], base: Base
    ) -> tuple[list[Accepted], Base, _Left, str]:
        """
        A cause whose size is no constant is not the cause, but what comes nearest. What remembers
        is not asked, as windows so short hardly see it.

        :return: the causes before the first that is none, what is believed and left with them, and
            a sentence on that one
        """
        left = self._left(base)
        for n, one in enumerate(found):
            if (changes := self._varies(one, base, left)) is None:
                continue
            key = one.tried.candidate.key
            self.turned_down[key] = NO_CONSTANT
            for later in found[n:]:
                base = self.search.without(later.tried.candidate, base)
            return found[:n], base, self._left(base), nearest_in_words(key, changes)
        return found, base, left, ""

    def _varies(self, one: Accepted, base: Base, left: _Left) -> Change | None:
        """:return: how the size of a cause changes, if to follow that would explain much"""
        candidate = one.tried.candidate
        if self.hypotheses.remembers(candidate):
            return None
        own = self.hypotheses.indices(candidate)
        changes = change(left.short, left.missing, own, base.free)
        if changes is None:
            return None
        gone = max(self._gone(one, base, left), 0.0)
        least = _LEAST_SHARE_IN_TIME if changes.goes_with == "time" else _LEAST_SHARE
        return changes if gone < least * (gone + changes.gain) else None

    def _left_by(self, found: Sequence[Accepted], base: Base) -> _Left | None:
        """:return: what is left beside these causes; None: the size of one of them changes"""
        left = self._left(base)
        return None if any(self._varies(one, base, left) for one in found) else left

    def _gone(self, one: Accepted, base: Base, left: _Left) -> float:
        """:return: by which a cause lowers the cost of short windows"""
        theta = self.search.without(one.tried.candidate, base).point.theta
        without = self._short(theta)
        return without.point.cost - left.short.point.cost

    def _short(self, theta: np.ndarray) -> ShortWindows:
        half = self.search.select
        return short_windows(half.evidence, theta, self.data, self.period, 2 * self.most_windows)

    def _left(self, base: Base) -> _Left:
        """:return: what the twin leaves as it is believed now"""
        short = self._short(base.point.theta)
        missing = missing_force(short, self.data)
        joints = tuple(joint.name for joint in self.hypotheses.twin.joints)
        power = float(np.mean(np.sum(weighed(missing) ** 2, 1)))
        mind = float(np.mean((_IRRELEVANT * self.spread / missing.noise) ** 2))
        least = _OF_IRRELEVANT**2 * mind * missing.numbers
        found = remainder(missing, self.data, joints, self.seed, least)
        # Errors of forces are known better the less is missing: two twins need one unit.
        unit = float(np.mean((missing.noise / self.search.noise) ** 2))
        predicted = 0.0 if found is None else unit * found.power
        return _Left(found, predicted, unit * power, missing, short)

    def _detectable(self, start: Base) -> dict[str, dict[str, float]]:
        """:return: by candidate; where there is no equation of motion, by simulation"""
        simulated = detectable(self.search.select, start.point)
        return {**simulated, **(self.screened.detectable if self.screened else {})}

    def _extended(self, causes: Sequence[str], theta: np.ndarray) -> Twin:
        """:return: the twin as it came, at its own interval, with these causes in it"""
        twin = self.hypotheses.extended_by(causes, theta)
        plant, own = plant_of(twin), plant_of(self.believed)
        if isinstance(own, AnalyticTwin) and plant.structure()[-1] != own.structure()[-1]:
            twin = stepping_by(twin, own.integrator)
        return twin.at_interval(self.believed.dt, self.believed.substeps)

    def _stuck(self, base: Base) -> str:
        """:return: a sentence on nuisances that end at a bound, if any does"""
        h, (_, point) = self.hypotheses, self.search.whole(base)
        ends = [
            i for i in h.nuisances if at_limit(point.theta[i], h.lower[i], h.upper[i], h.null[i])
        ]
        units = {name: p.unit for name, p in h.twin.parameters.items()}
        return stuck_in_words(
            [(h.names[i], point.theta[i], h.null[i], units[h.names[i]]) for i in ends]
        )

    def _far_off(self, base: Base) -> str:
        """:return: a sentence on how far held-out windows are from what is believed, if they are"""
        raw = self.search.confirm.evidence.fit(base.point.theta, (), base.kept.offsets).raw
        found = distances(self.believed.channels, raw, self.sensor_noise, self.spread)
        return far_in_words(found)

    def _explained(
        self,
        found: Sequence[Accepted],
        start: Base,
        base: Base,
        before: _Left,
        left: _Left,
    ) -> float:
        """
        How much of what is wrong is explained: of the missing force, or, if a cause remembers, of
        the error of whole windows, as windows so short hardly see what went on in it before.
        """
        share = _share(before, left)
        if any(self.hypotheses.remembers(one.tried.candidate) for one in found):
            half, noise = self.search.confirm, left.missing.noise / self.search.noise
            floor = float(np.mean(noise**2)) * half.evidence.shots.n
            wrong, rest = (half.total(point) - floor for point in (start.kept, base.kept))
            share = max(share, 1.0 - rest / wrong if 0.0 < rest < wrong else float(rest <= 0.0))
        return share

    def _told(
        self,
        found: Sequence[Accepted],
        rejected: Sequence[tuple[Candidate, Comparison]],
        start: Base,
        base: Base,
        before: _Left,
        left: _Left,
        nearest: str,
    ) -> Diagnosis:
        self.bar.stage("sizes and intervals")
        select, confirm = self.search.select, self.search.confirm
        every, point = self.search.whole(base)
        findings = tuple(
            finding(one, every, point, base.free, self.effort.profiles) for one in found
        )
        remains = "" if left.remainder is None else in_words(left.remainder)
        unexplained = " ".join(filter(None, (nearest, remains)))
        verdict = "none"
        if findings:
            open_ = sum(bool(one.alternatives) for one in findings)
            most = 2 * open_ > len(findings) if len(findings) > MANY else findings[0].alternatives
            verdict = "ambiguous" if most else "named"
        elif unexplained:
            verdict = "unknown"
        gain = by_horizon(confirm, start.kept, base.kept, self.every)
        return Diagnosis(
            verdict=verdict,
            believed=self.believed,
            findings=findings,
            unexplained=unexplained,
            gain=gain,
            explained=self._explained(found, start, base, before, left) if findings else 0.0,
            detectable=self._detectable(start),
            rejected=tuple(
                Rejected(one.key, c.gain, c.p_value, why(c, self.turned_down.get(one.key)))
                for one, c in sorted(rejected, key=lambda pair: -pair[1].gain)
            ),
            caveats=(
                *map(str, self.audit.findings),
                *self.corrected,
                *to_tell_apart(found, self.hypotheses),
                *look_alike([one for one in found if not one.sizes], select, base),
                *out_of_reach(confirm, base.kept, self.origin[self.parts.confirm]),
                *(errs_more(gain) if findings else ()),
            ),
            twin=self._extended(keys_of(found), point.theta),
            data_hash=self.data_hash,
            seed=self.seed,
            pictures=pictures_of(
                confirm, start.kept, base.kept, self.every, before.missing, left.missing
            ),
            opened=partial(
                open_answers,
                self.search,
                found,
                [one for one, _ in sorted(rejected, key=lambda pair: -pair[1].gain)],
                base,
                self._extended,
                self.data,
                self.every,
                unexplained,
            ),
        )


def _without_glitches(
    twin: Twin, data: Trajectories
) -> tuple[Trajectories, Audit, tuple[str, ...]]:
    """:return: the data without single samples far off, what is found in these, what was cut out"""
    found = _audited(twin, data)
    far = [finding for finding in found.findings if isinstance(finding, Outliers)]
    if not far or not all(isinstance(finding, Glitches) for finding in far):
        return data, found, ()
    data = found.corrected(data)
    words = tuple(f"{finding.sentence} Cut out." for finding in far)
    return data, _audited(twin, data), words


def _audited(twin: Twin, data: Trajectories) -> Audit:
    """Without backward differences: they are moved to where they belong."""
    found = audit(data, twin=twin)
    left = tuple(one for one in found.findings if not isinstance(one, BackwardDifference))
    return dataclasses.replace(found, findings=left)


def _share(before: _Left, left: _Left) -> float:
    """:return: of the missing force that can be predicted, how much is not missing any more"""
    gone = max(before.power - left.power, 0.0)
    return gone / (gone + left.predicted) if gone + left.predicted else 1.0


def _window_of(data: Trajectories, span: float) -> int:
    """
    :param span: that is aimed at [s]
    :return: steps of a window, so that windows fill a typical recording
    """
    rows = int(np.median(data.lengths)) + 1
    steps = min(int(np.clip(round(span / data.dt), _SHORTEST, _LONGEST)), rows - 1)

    def filling(steps: int) -> int:
        return rows // max(round(rows / (steps + 1)), 1) - 1

    whole = filling(steps)
    few = np.sum((data.lengths + 1) // (whole + 1)) < _FEW
    return filling(steps // 2) if few and steps >= 2 * _SHORTEST else whole


def _rows_of(shots: Shots, rows: np.ndarray) -> Shots:
    return Shots(*(np.asarray(leaf)[rows] for leaf in shots))


def _hash(data: Trajectories) -> str:
    digest = hashlib.sha256()
    for leaf in (data.obs, data.actions, data.mask):
        digest.update(np.ascontiguousarray(leaf).tobytes())
    return digest.hexdigest()[:16]
