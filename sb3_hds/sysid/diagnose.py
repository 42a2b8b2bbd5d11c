"""Find out what a simulation gets wrong: propose on some recordings, confirm once on others."""

import hashlib
import importlib.metadata
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
from rich.progress import track
from scipy import stats

from sb3_hds.core import Effect, Trajectories, Twin
from sb3_hds.data import audit
from sb3_hds.effects import ALL
from sb3_hds.errors import CalibrationError
from sb3_hds.sysid.calibrate import check_fits, spread_of
from sb3_hds.sysid.comparison import Comparison, Split, compare, effective_size, split
from sb3_hds.sysid.diagnosis import Diagnosis, Finding, HorizonGain, Rejected
from sb3_hds.sysid.evidence import Evidence, Point
from sb3_hds.sysid.hypotheses import PARAMETER, Candidate, Hypotheses
from sb3_hds.sysid.pictures import Pictures, replay_of
from sb3_hds.sysid.remainder import MissingForce, Remainder, missing_force, remainder, weighed
from sb3_hds.sysid.results import Estimate
from sb3_hds.sysid.shooting import Shots, shots_of

# Length of a window [s], within these numbers of steps.
_WINDOW, _SHORTEST, _LONGEST = 1.0, 8, 40
# What confirms a candidate: by which share the mean square error of held-out recordings falls, at
# which level, and by how much the information criterion of the others.
_LEAST_GAIN, _LEVEL, _LEAST_BIC = 0.05, 0.025, 10.0
# Another candidate belongs into the set unless it is worse than the best at this level.
_LEVEL_OF_SET = 0.05
# Errors that differ by a smaller share are the same, however surely they differ.
_SAME = 0.01
# A cause that leaves more than this share of what it explains, in a way that can be predicted, is
# not the cause.
_MOST_LEFT = 0.2
# Causes that are looked for.
_MOST = 3
# Where searches begin, in units of each parameter's scale from its null.
_STARTS = (0.0, 3.0)
_QUICK_STARTS = (0.0,)
# Least noise that is believed, in shares of a channel's spread.
_LEAST_NOISE = 1e-6
# Parameters that a cause has at most, and fewer units of evidence than these cannot say anything.
_WIDEST, _FEWEST_UNITS = 3, 4
_CONFIDENCE = 0.9


class Tried(NamedTuple):
    """
    A candidate, fitted to the recordings for selection, and how it did.

    :param candidate: which
    :param point: the best that was found
    :param kept: the same parameters on the other recordings, start states refitted
    :param criterion: by which the information criterion is lower than without it
    """

    candidate: Candidate
    point: Point
    kept: Point
    criterion: float


def diagnose(
    twin: Twin,
    data: Trajectories,
    *,
    effects: Sequence[type[Effect]] = ALL,
    calibrate: Sequence[str] = (),
    seed: int = 0,
    budget: Literal["full", "quick"] = "full",
    progress: bool = True,
) -> Diagnosis:
    """
    Name what a simulation gets wrong, if the data can.

    The data are audited first: what cannot support a verdict is refused with the reason, and other
    defects are caveats. Recordings are cut into windows, each simulated from a start state of its
    own. On one half of the recordings every candidate is fitted; the best is then confirmed once on
    the other half, by a one-sided t test on the logarithms of error ratios (one for each
    recording), at least 5 % less mean square error, and an information criterion that counts
    correlated errors as fewer. What is not significantly worse than the best there stays as an
    alternative. After each cause that is accepted, everything is tested again. What remains is
    looked for in the force that is missing; a cause that leaves too much of it is not believed.

    :param twin: as it is believed
    :param data: measured, sampled at the twin's ``dt``
    :param effects: classes of the catalogue, or of your own
    :param calibrate: parameters of the twin that are not believed: they are refitted under every
        hypothesis, and are never a finding
    :param seed: of the split
    :param budget: ``"full"``, or ``"quick"``: fewer starts for each candidate
    :param progress: whether a bar shows how far it is
    :return: verdict, findings, what was rejected, what cannot be told apart, the extended twin
    :raises CalibrationError: for other channels or another interval than the twin's, or an unknown
        name in ``calibrate``
    :raises TrajectoryError: if no recording is long enough
    """
    check_fits(twin, data)
    if budget not in ("full", "quick"):
        raise CalibrationError(f"budget must be 'full' or 'quick', got {budget!r}.")
    hypotheses = Hypotheses.about(twin, effects, tuple(calibrate))
    inquiry = _Inquiry(hypotheses, data, seed, budget, progress)
    reason = inquiry.poor()
    return inquiry.refused(reason) if reason else inquiry.run()


class _Left(NamedTuple):
    """What a twin leaves: what can be predicted of it, its mean square, and all of it."""

    remainder: Remainder | None
    power: float
    missing: MissingForce


class _Inquiry:
    """One diagnosis on its way."""

    def __init__(
        self, hypotheses: Hypotheses, data: Trajectories, seed: int, budget: str, progress: bool
    ) -> None:
        self.hypotheses, self.data, self.seed = hypotheses, data, seed
        self.audit = audit(data, channels=hypotheses.twin.channels)
        self.starts = _STARTS if budget == "full" else _QUICK_STARTS
        self.progress = progress
        longest = int(data.lengths.max())
        steps = int(np.clip(round(_WINDOW / data.dt), _SHORTEST, _LONGEST))
        shots, origin = shots_of(data, min(steps, longest), hypotheses.twin)
        self.parts = split(data, origin, seed)
        n_rows = max(int(self.parts.confirm.sum()), int((~self.parts.confirm).sum()))
        self.rows = [np.flatnonzero(~self.parts.confirm), np.flatnonzero(self.parts.confirm)]
        self.unit = [_padded_labels(self.parts, rows, n_rows) for rows in self.rows]
        self.spread = spread_of(data)
        width = len(hypotheses.nuisances) + _MOST * _WIDEST
        select, confirm = (_rows_of(shots, rows, n_rows) for rows in self.rows)
        self.select = Evidence(hypotheses, select, 0.05 * self.spread, width)
        self.confirm = self.select.on(confirm)
        self.theta, self.free = hypotheses.null.copy(), list(hypotheses.nuisances)

    def poor(self) -> str:
        """:return: why these data cannot support a verdict; empty if they may"""
        units = [len(np.unique(unit[unit >= 0])) for unit in self.unit]
        if min(units) < _FEWEST_UNITS // 2:
            return (
                f"{sum(units)} pieces of evidence are too few to propose on some and confirm on "
                "others. Record at least four times as long, or several recordings."
            )
        return self.audit.reason

    def run(self) -> Diagnosis:
        self._settle_noise()
        base = start = self._base()
        found: list[tuple[Tried, Comparison, tuple[str, ...]]] = []
        first: list[tuple[Tried, Comparison]] = []
        while len(found) < _MOST:
            tried = self._try_all(base, [t.candidate.key for t, *_ in found])
            best = self._best(tried, base)
            if not found:
                first = [(t, self._against(t.kept, base[1])) for t in tried]
            if best is None:
                break
            verdict = self._against(best.kept, base[1])
            found.append((best, verdict, self._alternatives(best, tried, base)))
            self.theta = best.point.theta
            self.free += [i for i in self.hypotheses.indices(best.candidate)]
            base = (best.point, best.kept)
        before = left = self._left([], start[0].theta)
        if found:
            left = self._left(_keys(found), base[0].theta)
            explained = max(before.power - left.power, 0.0)
            if left.remainder is not None and left.remainder.power > _MOST_LEFT * explained:
                found, base, self.free = [], start, list(self.hypotheses.nuisances)
                left = before
        named = {t.candidate.key for t, *_ in found}
        rejected = [pair for pair in first if pair[0].candidate.key not in named]
        self._set_noise(base[0])
        pictures = self._pictures(start[1], base[1], before.missing, left.missing)
        return self._told(found, rejected, start, base, left.remainder, pictures)

    def refused(self, reason: str) -> Diagnosis:
        return self._diagnosis(
            "not_identifiable", (), {}, 0.0, {}, (), (reason,), self.hypotheses.null
        )

    def _left(self, causes: Sequence[str], theta: np.ndarray) -> "_Left":
        """:return: what the twin with these causes leaves"""
        twin = self.hypotheses.extended_by(causes, theta)
        missing = missing_force(twin, self.data, self.select.noise)
        joints = tuple(joint.name for joint in twin.joints)
        power = float(np.mean(np.sum(weighed(missing) ** 2, 1)))
        return _Left(remainder(missing, self.data, joints, self.seed), power, missing)

    def _settle_noise(self) -> None:
        """What is left under the best explanation, of whatever kind, is the noise."""
        point = self.select.fit(self.hypotheses.null, self.hypotheses.nuisances)
        self._set_noise(point)
        tried = self._try_all((point, point), [], starts=_QUICK_STARTS)
        best = min((t.point for t in tried), key=lambda p: p.errors.sum(), default=point)
        self._set_noise(best)

    def _set_noise(self, point: Point) -> None:
        real = self.unit[0] >= 0
        raw = point.raw[real]
        noise = np.maximum(np.sqrt(np.mean(raw**2, (0, 1))), _LEAST_NOISE * self.spread)
        self.select, self.confirm = self.select.with_noise(noise), self.confirm.with_noise(noise)

    def _base(self) -> tuple[Point, Point]:
        point = self.select.fit(self.theta, self.free)
        self.theta = point.theta
        return point, self.confirm.fit(point.theta, ())

    def _try_all(
        self,
        base: tuple[Point, Point],
        accepted: Sequence[str],
        starts: Sequence[float] | None = None,
    ) -> list[Tried]:
        left = [c for c in self.hypotheses.candidates if c.key not in accepted]
        what = f"trying {len(left)} causes"
        shown = track(left, what, transient=True, disable=not self.progress)
        return [self._try(candidate, base, starts or self.starts) for candidate in shown]

    def _try(
        self, candidate: Candidate, base: tuple[Point, Point], starts: Sequence[float]
    ) -> Tried:
        h, own = self.hypotheses, list(self.hypotheses.indices(candidate))
        best = base[0]
        for distance in starts:
            begin = base[0].theta.copy()
            begin[own] = np.clip(h.null[own] + distance * h.scale[own], h.lower[own], h.upper[own])
            point = self.select.fit(begin, [*self.free, *own], base[0].offsets)
            if point.errors.sum() < best.errors.sum():
                best = point
        n = effective_size(base[0].raw[self.unit[0] >= 0] / self.select.noise)
        ratio = np.log(_total(base[0], self.unit[0]) / _total(best, self.unit[0]))
        criterion = n * ratio - len(own) * np.log(max(n, 2.0))
        return Tried(candidate, best, self.confirm.fit(best.theta, (), base[1].offsets), criterion)

    def _best(self, tried: Sequence[Tried], base: tuple[Point, Point]) -> Tried | None:
        """The candidate that selection prefers, if the other recordings confirm it."""
        ranked = sorted(tried, key=lambda t: -t.criterion)
        if not ranked or ranked[0].criterion < _LEAST_BIC:
            return None
        best = ranked[0]
        for other in ranked[1:]:
            fewer = len(other.candidate.parameters) < len(best.candidate.parameters)
            as_good = self._against(best.kept, other.kept).p_value > _LEVEL_OF_SET
            if fewer and other.criterion >= _LEAST_BIC and as_good:
                best = other
        return best if self._passes(self._against(best.kept, base[1])) else None

    def _alternatives(
        self, best: Tried, tried: Sequence[Tried], base: tuple[Point, Point]
    ) -> tuple[str, ...]:
        """What is not significantly worse than the best, without more freedom."""
        found = []
        for other in tried:
            if other is best or len(other.candidate.parameters) > len(best.candidate.parameters):
                continue
            worse = self._against(best.kept, other.kept)
            same = worse.p_value > _LEVEL_OF_SET or worse.gain < _SAME
            if same and self._passes(self._against(other.kept, base[1])):
                found.append(other.candidate.key)
        return tuple(found)

    def _passes(self, verdict: Comparison) -> bool:
        return verdict.gain >= _LEAST_GAIN and verdict.p_value < _LEVEL

    def _against(self, new: Point, old: Point) -> Comparison:
        return compare(new.errors, old.errors, self.unit[1])

    def _told(
        self,
        found: Sequence[tuple[Tried, Comparison, tuple[str, ...]]],
        rejected: Sequence[tuple[Tried, Comparison]],
        start: tuple[Point, Point],
        base: tuple[Point, Point],
        left: Remainder | None,
        pictures: Pictures,
    ) -> Diagnosis:
        stderr = self._standard_errors(base[0])
        findings = tuple(self._finding(*one, base[0].theta, stderr) for one in found)
        verdict = "none"
        if findings:
            verdict = "ambiguous" if findings[0].alternatives else "named"
        elif left is not None:
            verdict = "unknown"
        left_over = tuple(
            Rejected(t.candidate.key, c.gain, c.p_value, self._why(t, c))
            for t, c in sorted(rejected, key=lambda pair: -pair[1].gain)
        )
        total = _total(start[1], self.unit[1])
        explained = 1.0 - _total(base[1], self.unit[1]) / total if findings else 0.0
        return self._diagnosis(
            verdict,
            findings,
            self._by_horizon(start[1], base[1]),
            explained,
            self._detectable(start[0]),
            left_over,
            tuple(f"{found.sentence} {found.remedy}" for found in self.audit.findings),
            base[0].theta,
            "" if left is None else _in_words(left),
            pictures,
        )

    def _finding(
        self,
        tried: Tried,
        verdict: Comparison,
        alternatives: tuple[str, ...],
        theta: np.ndarray,
        stderr: np.ndarray,
    ) -> Finding:
        h, candidate = self.hypotheses, tried.candidate
        parameters = {}
        for name, i in zip(candidate.parameters, h.indices(candidate), strict=True):
            half = stats.t.ppf(0.5 + 0.5 * _CONFIDENCE, verdict.n_units - 1) * stderr[i]
            parameters[name.rpartition(".")[2]] = Estimate(
                name=name,
                estimate=float(theta[i]),
                stderr=float(stderr[i]),
                low=float(max(theta[i] - half, h.lower[i])),
                high=float(min(theta[i] + half, h.upper[i])),
                unit=h.twin.parameters[name].unit,
                before=float(h.null[i]),
                at_bound=bool(theta[i] <= h.lower[i] or theta[i] >= h.upper[i]),
            )
        return Finding(
            candidate.name,
            h.place_of(candidate),
            parameters,
            alternatives,
            verdict.p_value,
            verdict.gain,
            candidate.explanation,
        )

    def _why(self, tried: Tried, verdict: Comparison) -> str:
        if verdict.gain < _LEAST_GAIN:
            return "gains too little"
        if verdict.p_value >= _LEVEL:
            return "may be chance"
        return "others gain more"

    def _standard_errors(self, point: Point) -> np.ndarray:
        """Of all parameters, by the sandwich clustered by units; of those that moved, jointly."""
        slopes, free = self.select.slopes(point), self.free
        result = np.full(len(self.hypotheses.names), np.inf)
        if not free:
            return result
        labels = np.unique(self.unit[0][self.unit[0] >= 0])
        scores = np.stack([slopes.scores[self.unit[0] == label].sum(0) for label in labels])[
            :, free
        ]
        bread = np.linalg.pinv(slopes.curvature.sum(0)[np.ix_(free, free)], rcond=1e-10)
        correction = len(labels) / max(len(labels) - 1, 1)
        covariance = correction * bread @ (scores.T @ scores) @ bread
        result[free] = np.sqrt(np.maximum(np.diag(covariance), 0.0)) * self.hypotheses.scale[free]
        return result

    def _detectable(self, point: Point) -> dict[str, dict[str, float]]:
        """The smallest size that lowers the error by the least gain that counts, to first order."""
        h, total = self.hypotheses, self.select.slopes(point).curvature.sum(0)
        needed = (
            0.5
            * _LEAST_GAIN
            * float(np.sum(point.errors * (self.unit[0] >= 0)))
            * (point.raw.shape[1] * point.raw.shape[2])
        )
        nuisances, found = list(h.nuisances), {}
        for candidate in h.candidates:
            sizes = {}
            for name, i in zip(candidate.parameters, h.indices(candidate), strict=True):
                curvature = total[i, i]
                if nuisances:
                    cross = total[i, nuisances]
                    inner = total[np.ix_(nuisances, nuisances)]
                    curvature -= cross @ np.linalg.pinv(inner, rcond=1e-10) @ cross
                size = np.sqrt(2.0 * needed / curvature) if curvature > 1e-12 else np.inf
                sizes[name.rpartition(".")[2]] = float(size * h.scale[i])
            found[candidate.key] = sizes
        return found

    def _by_horizon(self, before: Point, after: Point) -> dict[int, HorizonGain]:
        found, last = {}, before.raw.shape[1] - 1
        for ahead in sorted({1, max(last // 4, 1), last}):
            old, new = (
                np.mean((point.raw[:, ahead] / self.confirm.noise) ** 2, 1)
                for point in (before, after)
            )
            gained = compare(new, old, self.unit[1])
            rms = [float(np.sqrt(np.mean(e[self.unit[1] >= 0]))) for e in (old, new)]
            found[ahead] = HorizonGain(ahead, rms[0], rms[1], gained.low, gained.high)
        return found

    def _pictures(
        self, before: Point, after: Point, missing: MissingForce, left: MissingForce
    ) -> Pictures:
        twin, unit = self.hypotheses.twin, self.unit[1]
        rows = np.flatnonzero(unit == np.unique(unit[unit >= 0])[0])
        measured = np.asarray(self.confirm.shots.obs)[rows]
        errors = [
            np.sqrt(np.mean((point.raw[unit >= 0] / self.confirm.noise) ** 2, (0, 2)))
            for point in (before, after)
        ]
        return Pictures(
            channels=tuple((c.name, c.unit) for c in twin.channels),
            joints=tuple((j.name, "N" if j.unit == "m" else "N m") for j in twin.joints),
            actuators=tuple((a.name, a.unit) for a in twin.actuators),
            replay=replay_of(measured, before.raw[rows], after.raw[rows], self.data.dt),
            steps=np.arange(measured.shape[1]),
            errors=np.stack(errors),
            missing=missing,
            left=left,
        )

    def _diagnosis(
        self,
        verdict: Any,
        findings: tuple[Finding, ...],
        gain: dict[int, HorizonGain],
        explained: float,
        detectable: dict[str, dict[str, float]],
        rejected: tuple[Rejected, ...],
        caveats: tuple[str, ...],
        theta: np.ndarray,
        unexplained: str = "",
        pictures: Pictures | None = None,
    ) -> Diagnosis:
        causes = [_key(finding) for finding in findings]
        return Diagnosis(
            verdict=verdict,
            findings=findings,
            unexplained=unexplained,
            gain=gain,
            explained=explained,
            detectable=detectable,
            rejected=rejected,
            caveats=caveats,
            twin=self.hypotheses.extended_by(causes, theta),
            data_hash=_hash(self.data),
            versions={
                name: importlib.metadata.version(name) for name in ("sb3-hds", "jax", "numpy")
            },
            seed=self.seed,
            pictures=pictures,
        )


def _keys(found: Sequence[tuple[Tried, Comparison, tuple[str, ...]]]) -> list[str]:
    return [tried.candidate.key for tried, *_ in found]


def _in_words(left: Remainder) -> str:
    share = f"{left.gain:.0%}"
    return (
        f"a force at {left.joint} goes with {' and '.join(left.goes_with)}; {share} of its "
        f"variance is predictable on held-out recordings (p = {left.p_value:.2g})."
    )


def _key(finding: Finding) -> str:
    inside = finding.where["slot"] == PARAMETER
    return finding.effect if inside else f"{finding.effect}.{finding.where['name']}"


def _total(point: Point, unit: np.ndarray) -> float:
    return float(point.errors[unit >= 0].sum())


def _padded_labels(parts: Split, rows: np.ndarray, n_rows: int) -> np.ndarray:
    return np.concatenate([parts.unit[rows], np.full(n_rows - len(rows), -1)])


def _rows_of(shots: Shots, rows: np.ndarray, n_rows: int) -> Shots:
    """Some windows, and copies of weight zero that fill up the shape."""
    index = np.concatenate([rows, np.zeros(n_rows - len(rows), int)]).astype(int)
    chosen = Shots(*(np.asarray(leaf)[index] for leaf in shots))
    return chosen._replace(weight=np.where(np.arange(n_rows) < len(rows), chosen.weight, 0.0))


def _hash(data: Trajectories) -> str:
    digest = hashlib.sha256()
    for leaf in (data.obs, data.actions, data.mask):
        digest.update(np.ascontiguousarray(leaf).tobytes())
    return digest.hexdigest()[:16]
