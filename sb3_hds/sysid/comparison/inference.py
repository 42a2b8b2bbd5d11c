"""Standard errors, intervals, family-wise p-values, aliased candidates."""

from collections.abc import Mapping, Sequence

import numpy as np
import scipy
from jaxtyping import Float, Int

from sb3_hds.sysid.comparison.halves import Half
from sb3_hds.sysid.comparison.held_out import LEAST_GAIN
from sb3_hds.sysid.estimation.candidates import Candidate
from sb3_hds.sysid.estimation.evidence import Evidence, Point, Slopes
from sb3_hds.sysid.estimation.hypotheses import Hypotheses
from sb3_hds.sysid.estimation.normal_equations import CONFIDENCE

#: directions below this share of the largest curvature are not determined, where it is inverted
RANK = 1e-10
# Cosine of the angle between what two causes do beyond which they look alike: 18 degrees.
_IMITATION = 0.95
# How close to the wanted rise of the cost is close enough (in its root), and how often to try.
_CLOSE, _MOST_TRIES = 0.1, 5
# Most by which one try is farther from, or nearer to, the estimate than the one before.
_FARTHER, _NEARER = 3.0, 0.2
# Steps of a fit of the other parameters.
_STEPS = 6
# Draws of the bootstrap, and how many at a time, so that memory stays small.
_N_DRAWS, _AT_A_TIME = 999, 250
#: directions below this share of the largest curvature do not move
WEAK = 1e-9


def jackknife(slopes: Slopes, cluster: Int[np.ndarray, " n"]) -> Float[np.ndarray, "p p"]:
    """
    Over clusters, by one Newton step for each that is left out. With few clusters, the sandwich
    estimator is too narrow, because the fit has shrunk their scores.

    Source: MacKinnon, Nielsen, Webb, *Fast and reliable jackknife and bootstrap methods for
    cluster-robust inference*, J. Applied Econometrics 38, 2023 (CV3).

    :param cluster: cluster of each window
    :return: covariance of the parameters, in units of their scale; infinite if derivatives are not
        finite
    """
    labels, total = np.unique(cluster), slopes.curvature.sum(0)
    if not (np.isfinite(slopes.curvature).all() and np.isfinite(slopes.scores).all()):
        # Simulations blow up nearby: nobody knows how well the size is known.
        return np.full_like(total, np.inf)
    covariance = np.zeros_like(total)
    for label in labels:
        own = cluster == label
        rest = np.linalg.pinv(total - slopes.curvature[own].sum(0), rcond=RANK, hermitian=True)
        step = rest @ slopes.scores[own].sum(0)
        # Infinite is right: one cluster alone knows of it.
        with np.errstate(over="ignore", invalid="ignore"):
            covariance += np.outer(step, step)
    return covariance * (len(labels) - 1) / len(labels)


def standard_errors(half: Half, point: Point, free: Sequence[int]) -> Float[np.ndarray, " p"]:
    """
    By the :func:`jackknife`.

    :param free: indices of what was fitted
    :return: of all parameters; infinite for parameters that were not fitted, or if derivatives are
        not finite
    """
    result = np.full(len(point.theta), np.inf)
    if not free:
        return result
    variance = np.diag(jackknife(half.evidence.slopes(point, free), half.cluster))
    result[list(free)] = np.sqrt(variance) * half.evidence.hypotheses.scale[list(free)]
    return result


def detectable(half: Half, point: Point) -> dict[str, dict[str, float]]:
    """
    :param point: the nominal model, nuisances refitted
    :return: by candidate and parameter, the smallest size that lowers the error by the least gain
        that counts, to first order
    """
    h, total = half.evidence.hypotheses, half.evidence.slopes(point).curvature.sum(0)
    numbers = point.residual.shape[1] * point.residual.shape[2]
    needed = 0.5 * LEAST_GAIN * half.total(point) * numbers
    nuisances, found = list(h.nuisances), {}
    inner = np.linalg.pinv(total[np.ix_(nuisances, nuisances)], rcond=RANK)
    for candidate in h.candidates:
        sizes = {}
        for name, i in zip(candidate.parameters, h.indices(candidate), strict=True):
            cross = total[i, nuisances]
            curvature = total[i, i] - cross @ inner @ cross
            size = np.sqrt(2.0 * needed / curvature) if curvature > 1e-12 else np.inf
            sizes[name.rpartition(".")[2]] = float(size * h.scale[i])
        found[candidate.key] = sizes
    return found


def detectable_sizes(
    half: Half, point: Point, by_equation: Mapping[str, Mapping[str, float]]
) -> dict[str, dict[str, float]]:
    """
    By candidate, where the equation of motion proposes it and a simulation confirms it. Of what is
    not simulated, or has no derivative at the null, by the equation: as much larger as errors that
    are too small to matter make the residual.

    :param point: the nominal model, nuisances refitted
    :param by_equation: what the equation of motion shows, by candidate and parameter
    """
    found = detectable(half, point)
    left = float(np.mean((point.residual / half.evidence.noise) ** 2, (1, 2)).sum())
    larger = np.sqrt(half.total(point) / left) if left > 0.0 else 1.0
    for key, sizes in by_equation.items():
        simulated = {n: x for n, x in found.get(key, {}).items() if np.isfinite(x)}
        found[key] = {
            name: max(size, simulated.get(name, larger * size)) for name, size in sizes.items()
        }
    return found


def aliased_with(
    h: Hypotheses, point: Point, slopes: Slopes, found: Candidate, nuisances: Sequence[int]
) -> list[str]:
    """
    :param point: the fit with this cause
    :param slopes: there, of all parameters
    :param found: the cause
    :param nuisances: indices of what else is refitted
    :return: keys of aliased candidates: after projecting out the nuisances, the cosine between what
        they and the cause change in these windows exceeds 0.95, to first order
    """
    total, rest = slopes.curvature.sum(0), list(nuisances)
    inner = np.linalg.pinv(total[np.ix_(rest, rest)], rcond=RANK, hermitian=True)
    total = total - total[:, rest] @ inner @ total[rest]
    own = list(h.indices(found))
    direction = ((point.theta - h.null) / h.scale)[own]
    strength = direction @ total[np.ix_(own, own)] @ direction
    names = []
    for candidate in h.candidates:
        other = list(h.indices(candidate))
        if set(other) & {*own, *rest} or np.diag(total)[other].min() <= 1e-9 * strength:
            continue
        shared = total[np.ix_(other, own)] @ direction
        caught = shared @ np.linalg.pinv(total[np.ix_(other, other)], hermitian=True) @ shared
        if caught > _IMITATION**2 * strength:
            names.append(candidate.key)
    return names


def profiled(
    evidence: Evidence, point: Point, free: Sequence[int], index: int, reach: float
) -> tuple[float, float]:
    """
    The interval of a parameter by its profile likelihood: where the cost, all other free parameters
    and the start states refitted, has risen by what the parabola at the best fit rises over
    ``reach``. So it is as wide as a standard error that allows for correlated errors wants it, but
    need not be symmetric: a dead zone or a delay may be known on one side only.

    Source: Raue et al., Bioinformatics 25, 2009 (profile likelihood); the rise is scaled as the
    parabola is.

    :param point: the best fit
    :param free: indices of what was fitted
    :param index: of the parameter, one of ``free``
    :param reach: half the width of the symmetric interval
    :return: both ends; a physical bound where the cost does not rise enough before it
    """
    h = evidence.hypotheses
    others = [i for i in free if i != index]
    curvature = evidence.slopes(point, [index, *others]).curvature.sum(0)
    inner = np.linalg.pinv(curvature[1:, 1:], rcond=RANK, hermitian=True)
    along = curvature[0, 0] - curvature[0, 1:] @ inner @ curvature[1:, 0]
    rise = 0.5 * max(along, 0.0) * (reach / h.scale[index]) ** 2
    best = point.theta[index]
    if not np.isfinite(reach) or not 0.0 < rise < np.inf:
        return float(h.lower[index]), float(h.upper[index])
    follow = -inner @ curvature[1:, 0] * h.scale[others] / h.scale[index]

    def end(side: float) -> float:
        bound = float(h.lower[index] if side < 0.0 else h.upper[index])
        away, offsets = reach, point.offsets
        for _ in range(_MOST_TRIES):
            value = float(np.clip(best + side * away, h.lower[index], h.upper[index]))
            theta = point.theta.copy()
            theta[index] = value
            moved = theta[others] + follow * (value - best)
            theta[others] = np.clip(moved, h.lower[others], h.upper[others])
            cost = evidence.fit(theta, others, offsets, _STEPS).cost - point.cost
            ratio = np.sqrt(max(cost, 0.0) / rise)
            if abs(ratio - 1.0) < _CLOSE or (value == bound and ratio < 1.0):
                return value
            away = abs(value - best) * float(np.clip(1.0 / max(ratio, 1e-9), _NEARER, _FARTHER))
        return float(np.clip(best + side * away, h.lower[index], h.upper[index]))

    return end(-1.0), end(1.0)


def margin(n_clusters: int, stderr: np.ndarray) -> np.ndarray:
    """:return: half the width of a symmetric interval"""
    return scipy.stats.t.ppf(0.5 + 0.5 * CONFIDENCE, max(n_clusters - 1, 1)) * stderr


def interval(
    half: Half, point: Point, free: Sequence[int], index: int, reach: float, profiles: bool
) -> tuple[float, float]:
    """:param reach: half the width of the symmetric interval"""
    h, best = half.evidence.hypotheses, float(point.theta[index])
    if profiles:
        return profiled(half.evidence, point, free, index, reach)
    return max(best - reach, float(h.lower[index])), min(best + reach, float(h.upper[index]))


def widened(estimate: float, low: float, high: float, off: float) -> tuple[float, float]:
    """:param off: half the width of an independent error"""
    return (
        estimate - float(np.hypot(estimate - low, off)),
        estimate + float(np.hypot(high - estimate, off)),
    )


def systematic(estimate: float, other: tuple[float, float, float] | None) -> float:
    """
    :param other: estimate of the equation of motion, with its interval
    :return: by how much the two differ beyond that: smoothing spoils the one and integration the
        other, and the noise of either says nothing of it
    """
    if other is None:
        return 0.0
    value, low, high = other
    reach = high - value if estimate > value else value - low
    return float(np.sqrt(max((estimate - value) ** 2 - reach**2, 0.0)))


def family_p_value(
    slopes: Slopes,
    candidates: Sequence[Sequence[int]],
    free: Sequence[int],
    fitted: Sequence[int],
    gain: float,
    seed: int = 0,
) -> float:
    """
    Family-wise p-value of the best candidate: how often the largest gain over all candidates would
    be as large if nothing were wrong but the noise, of whatever colour.

    Multipliers are drawn for whole windows and weigh their scores: the sums have the covariance
    that scores have under what remains, so the noise needs no model. What was fitted has made the
    scores of few windows smaller than they were, which is undone.

    Source: Chernozhukov, Chetverikov, Kato, *Gaussian approximations and multiplier bootstrap for
    maxima of sums of high-dimensional random vectors*, Ann. Stat. 41, 2013; MacKinnon, White, *Some
    heteroskedasticity-consistent covariance matrix estimators*, J. Econometrics 29, 1985.

    :param slopes: where the best candidate is fitted, so that what it explains is no noise
    :param candidates: for each, the indices of its parameters
    :param free: indices of what is refitted whichever candidate it is
    :param fitted: indices of what has been fitted: ``free`` and the best candidate's parameters
    :param gain: by which the best candidate lowers the cost
    """
    scores, curvature = slopes.scores, slopes.curvature.sum(0)
    fixed = list(free)
    inner = np.linalg.pinv(curvature[np.ix_(fixed, fixed)], rcond=WEAK, hermitian=True)
    onto = curvature[:, fixed] @ inner
    scores = scores - scores[:, fixed] @ onto.T
    n = len(scores)
    scores = (scores - scores.mean(0)) * n / max(n - len(fitted), 1)
    curvature = curvature - onto @ curvature[fixed]
    sizes = [
        (list(own), np.linalg.pinv(curvature[np.ix_(own, own)], rcond=WEAK, hermitian=True))
        for own in candidates
    ]
    rng, as_large = np.random.default_rng(seed), 1
    for first in range(0, _N_DRAWS, _AT_A_TIME):
        drawn = rng.standard_normal((min(_AT_A_TIME, _N_DRAWS - first), n)) @ scores
        gains = [0.5 * np.einsum("di,ij,dj->d", drawn[:, o], k, drawn[:, o]) for o, k in sizes]
        as_large += int(np.sum(np.max(gains, axis=0) >= gain))
    return as_large / (1 + _N_DRAWS)
