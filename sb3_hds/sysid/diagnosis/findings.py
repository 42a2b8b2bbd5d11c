"""Findings in words: sizes, intervals, reasons, caveats."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Int

from sb3_hds.sysid.comparison.halves import Accepted, Base, Half, Tried
from sb3_hds.sysid.comparison.held_out import LEAST_GAIN, LEVEL, Comparison, t_test
from sb3_hds.sysid.comparison.inference import (
    aliased_with,
    interval,
    margin,
    standard_errors,
    systematic,
    widened,
)
from sb3_hds.sysid.comparison.parameter_stability import Change
from sb3_hds.sysid.comparison.unexplained import PredictableForce
from sb3_hds.sysid.estimation.candidates import Candidate
from sb3_hds.sysid.estimation.evidence import Point
from sb3_hds.sysid.estimation.hypotheses import Hypotheses
from sb3_hds.sysid.estimation.results import Estimate
from sb3_hds.sysid.reporting.diagnosis import MANY, Verdict
from sb3_hds.sysid.reporting.finding import Finding, HorizonGain
from sb3_hds.sysid.reporting.pictures import bounded
from sb3_hds.sysid.reporting.wording import TOO_LITTLE

#: why a candidate that predicts better is not named
UNCERTAIN, SMALL, CHANCE = "its size is uncertain", "it is small beside the others", "may be chance"
NO_CONSTANT = "it comes near, but its size is not constant"
NAMELESS = "a force without a name predicts better"
ANOTHER = "its fitted sizes are those of another effect"
# Of several causes, half the width of an interval is at least this share of the size: neither the
# twin's integrator nor the smoothing of the equation of motion is better than that.
_INEXACT = 0.01
# Family-wise level of what contradicts that nothing is wrong, though it is no finding.
_CONTRADICTS = 0.01
# Error of a window that a twin does not come near, in units of the noise, or of what is usual.
_LOST = 10.0


def verdict_of(findings: Sequence[Finding], unexplained: str) -> Verdict:
    """
    The verdict on data that support one and follow the conventions of the model.

    - ``"named"``: causes are confirmed.
    - ``"ambiguous"``: they are, but the data cannot tell the first one from its alternatives; of
      more than ``MANY`` causes, most of them from theirs.
    - ``"unknown"``: none is, though something can be predicted that the model does not.
    - ``"none"``: nothing can.

    :param findings: confirmed causes, the first one found first
    :param unexplained: what no cause explains, in words; empty if nothing is left
    """
    if not findings:
        return "unknown" if unexplained else "none"
    ambiguous = [bool(one.alternatives) for one in findings]
    if len(findings) > MANY:
        return "ambiguous" if 2 * sum(ambiguous) > len(findings) else "named"
    return "ambiguous" if ambiguous[0] else "named"


def finding(
    one: Accepted, half: Half, point: Point, free: Sequence[int], profiles: bool
) -> Finding:
    """
    :param half: all windows: confirmed causes are fitted to both halves
    :param point: the final model, with this cause, fitted to that
    :param free: indices of what was fitted
    :param profiles: whether intervals follow the likelihood, or are symmetric
    """
    h, theta = half.evidence.hypotheses, point.theta
    stderr = standard_errors(half, point, free)
    unit = margin(len(np.unique(half.cluster)), np.ones(()))
    reach = unit * stderr
    candidate, parameters = one.tried.candidate, {}
    shorts = [name.rpartition(".")[2] for name in candidate.parameters]
    for name, i in zip(candidate.parameters, h.indices(candidate), strict=True):
        if name in one.sizes and one.of_equation:
            estimate, low, high = one.sizes[name]
            low, high = widened(estimate, low, high, _INEXACT * abs(estimate))
            error = float((high - low) / (2.0 * unit))
        else:
            low, high = interval(half, point, free, i, float(reach[i]), profiles)
            estimate = float(theta[i])
            off = np.hypot(one.doubts.get(name, 0.0), systematic(estimate, one.sizes.get(name)))
            off = np.hypot(off, _INEXACT * abs(estimate) if one.sizes else 0.0)
            low, high = widened(estimate, low, high, off)
            low, high = max(low, float(h.lower[i])), min(high, float(h.upper[i]))
            error = float(np.hypot(stderr[i], off / unit))
        short = name.rpartition(".")[2]
        # Of several places, each has its own.
        own = short if shorts.count(short) == 1 else name.partition(".")[2]
        parameters[own] = Estimate(
            name=name,
            estimate=estimate,
            stderr=error,
            low=low,
            high=high,
            unit=h.parameter(name).unit,
            before=float(h.null[i]),
            at_bound=bool(theta[i] <= h.lower[i] or theta[i] >= h.upper[i]),
            added_to=h.added_to(name),
        )
    return Finding(
        candidate.name,
        h.place_of(candidate),
        parameters,
        one.alternatives,
        one.comparison.p_value,
        one.family_p_value,
        one.comparison.gain,
        candidate.explanation,
        one.share,
    )


def to_tell_apart(found: Sequence[Accepted], hypotheses: Hypotheses) -> list[str]:
    """:return: sentences on what to record if a cause is not distinguishable from others"""
    sentences, undeclared = [], []
    for one in found:
        key = one.tried.candidate.key
        for other in one.alternatives:
            if when := hypotheses.alike(key, other):
                sentences.append(
                    f"{key} and {other} look alike {when}. Recordings of which that is not true "
                    "would tell them apart."
                )
            else:
                undeclared.append(f"{key} from {other}")
    if undeclared:
        sentences.append(
            f"To tell {', '.join(undeclared)}, record other speeds, positions and commands: in "
            "these data they make much the same difference."
        )
    return sentences


def look_alike(found: Sequence[Accepted], half: Half, base: Base) -> list[str]:
    """
    :return: sentences on candidates that are aliased with a cause in these windows, though held-out
        recordings prefer the cause
    """
    if not found:
        return []
    sentences, h, slopes = [], half.evidence.hypotheses, half.evidence.slopes(base.point)
    for one in found:
        own = h.indices(one.tried.candidate)
        rest = [i for i in base.free if i not in own]
        alike = aliased_with(h, base.point, slopes, one.tried.candidate, rest)
        alike = [name for name in alike if name not in one.alternatives]
        if alike:
            sentences.append(
                f"In these data {', '.join(alike)} would do nearly the same as "
                f"{one.tried.candidate.key}, which held-out recordings prefer. Recordings that "
                "excite other speeds, positions and commands would tell them further apart."
            )
    return sentences


def out_of_reach(half: Half, held_out: Point, origin: Int[np.ndarray, " n"]) -> list[str]:
    """
    :param half: held-out recordings
    :param held_out: the final model, on their windows
    :param origin: recording of each window
    :return: a sentence on windows that the model does not predict at all, if there are any
    """
    errors = np.sqrt(half.errors(held_out))
    lost = errors > _LOST * max(float(np.median(errors)), 1.0)
    if not lost.any():
        return []
    where = ", ".join(f"trajectory {i}" for i in np.unique(origin[lost]))
    return [
        f"The simulation is off by more than ten times the noise in {lost.sum()} of {len(lost)} "
        f"windows that nothing was fitted to ({where}). What happens there is not in the other "
        "recordings: look at them, and record more of it."
    ]


def errs_more(gain: Mapping[int, HorizonGain]) -> list[str]:
    """
    :param gain: of all that is named, by horizon
    :return: a sentence on the horizons at which the extended twin is worse, if there are any
    """
    worse = [g for g in gain.values() if g.high < 0.0]
    if not worse:
        return []
    steps = " and ".join(f"{g.steps} (+{g.after / g.before - 1.0:.0%})" for g in worse)
    return [
        f"The extended twin errs more than before, steps ahead: {steps}. Over whole windows it "
        "gains; but what is named may stand in for something else there."
    ]


def why(comparison: Comparison, rejected_for: str | None) -> str:
    """
    :param comparison: the comparison of a candidate that is not named
    :param rejected_for: why it was rejected, if it was ever the best
    """
    if comparison.gain < LEAST_GAIN:
        return TOO_LITTLE
    return rejected_for or (CHANCE if comparison.p_value >= LEVEL else "others gain more")


def bounds_in_words(ends: Sequence[tuple[str, float, float, str]]) -> str:
    """
    :param ends: of each nuisance at a bound, its name, its value there, the nominal value, and unit
    :return: why nothing is named; empty if there is none
    """
    if not ends:
        return ""
    said = " and ".join(f"{n} = {x:.3g} {unit} (nominal {was:.3g})" for n, x, was, unit in ends)
    verb = "ends at its bound" if len(ends) == 1 else "end at their bounds"
    return (
        f"Refitted, {said} {verb}: whatever is wrong, this is not how the system is. "
        "Check conventions (signs, units, order of the columns), leave it out of calibrate, or "
        "widen its bounds if such a value is possible: calibrate={name: (low, high)}."
    )


def in_words(left: PredictableForce) -> str:
    share = f"{left.gain:.0%}"
    return (
        f"A force at {left.joint} goes with {' and '.join(left.goes_with)}; {share} of its "
        f"variance is predictable on held-out recordings (p = {left.p_value:.2g})."
    )


def nearest_in_words(key: str, changes: Change) -> str:
    return (
        f"{key} comes nearest, but its size is no constant: it goes with {changes.goes_with} "
        f"(p = {changes.p_value:.2g})."
    )


def nameless_in_words(
    tried: Tried, better: Comparison, causes: Sequence[str], hypotheses: Hypotheses
) -> str:
    """
    :param tried: a flexible force
    :param better: than the causes
    :param causes: in whose place it is; none: beside the current model
    """
    force, values = tried.candidate, []
    for name, i in zip(force.parameters, hypotheses.indices(force), strict=True):
        unit = hypotheses.parameter(name).unit
        size = f"{name.rpartition('.')[2]} = {tried.point.theta[i]:.3g}"
        values.append(size if unit == "1" else f"{size} {unit}")
    does = f"does better than {' and '.join(causes)}" if causes else "explains what is missing"
    return (
        f"A force that is no finding {does}: {force.key} ({', '.join(values)}), "
        f"with {better.gain:.0%} less error (p = {better.p_value:.2g}). {force.explanation}"
    )


def contradiction(weighed: Sequence[tuple[Candidate, Comparison]]) -> str:
    """
    :param weighed: candidates that were not accepted, on the half that confirms
    :return: a sentence on the one that gains most there, if not all of them may be chance; else
        empty
    """
    sure = [
        (comparison.gain, comparison.p_value, candidate.key)
        for candidate, comparison in weighed
        if comparison.gain >= LEAST_GAIN and len(weighed) * comparison.p_value < _CONTRADICTS
    ]
    if not sure:
        return ""
    gain, p_value, key = max(sure)
    return (
        f"{key} lowers the error of held-out recordings by {gain:.0%} (p = {p_value:.2g}), but "
        "the other recordings do not support it as the cause."
    )


def by_horizon(half: Half, before: Point, after: Point, thinning: int) -> dict[int, HorizonGain]:
    """
    :param thinning: steps of the data in one of the windows
    :return: errors some steps ahead, by the number of steps of the data
    """
    found, last = {}, before.residual.shape[1] - 1
    for ahead in sorted({1, max(last // 4, 1), last}):
        old, new = (
            bounded(np.mean((point.residual[:, ahead] / half.evidence.noise) ** 2, 1))
            for point in (before, after)
        )
        gained = t_test(new, old, half.cluster)
        rms = [float(np.sqrt(np.mean(errors))) for errors in (old, new)]
        steps = ahead * thinning
        found[steps] = HorizonGain(steps, rms[0], rms[1], gained.low, gained.high)
    return found
