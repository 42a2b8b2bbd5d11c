"""Standard errors, profile likelihoods, family-wise p-values, aliased candidates."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from sb3_hds.sysid.comparison.search import LEAST_GAIN, Half
from sb3_hds.sysid.estimation.evidence import Point

# Directions below this share of the largest curvature do not move.
_RANK = 1e-10


def standard_errors(half: Half, point: Point, free: Sequence[int]) -> Float[np.ndarray, " p"]:
    """
    Jackknife over clusters, by one Newton step for each that is left out. With few clusters, the
    sandwich estimator is too narrow, because the fit has shrunk their scores.

    Source: MacKinnon, Nielsen, Webb, *Fast and reliable jackknife and bootstrap methods for
    cluster-robust inference*, J. Applied Econometrics 38, 2023 (CV3).

    :param free: indices of what was fitted
    :return: of all parameters; infinite for parameters that were not fitted, or if derivatives are
        not finite
    """
    result = np.full(len(point.theta), np.inf)
    if not free:
        return result
    slopes, labels = half.evidence.slopes(point, free), np.unique(half.unit)
    total, variance = slopes.curvature.sum(0), np.zeros(len(free))
    if not (np.isfinite(slopes.curvature).all() and np.isfinite(slopes.scores).all()):
        # Simulations blow up nearby: nobody knows how well the size is known.
        return result
    for label in labels:
        own = half.unit == label
        rest = np.linalg.pinv(total - slopes.curvature[own].sum(0), rcond=_RANK, hermitian=True)
        with np.errstate(over="ignore"):  # infinite is right: one unit alone knows of it
            variance += (rest @ slopes.scores[own].sum(0)) ** 2
    variance *= (len(labels) - 1) / len(labels)
    result[list(free)] = np.sqrt(variance) * half.evidence.hypotheses.scale[list(free)]
    return result


def detectable(half: Half, point: Point) -> dict[str, dict[str, float]]:
    """
    :param point: the nominal model, nuisances refitted
    :return: by candidate and parameter, the smallest size that lowers the error by the least gain
        that counts, to first order
    """
    h, total = half.evidence.hypotheses, half.evidence.slopes(point).curvature.sum(0)
    numbers = point.raw.shape[1] * point.raw.shape[2]
    needed = 0.5 * LEAST_GAIN * half.total(point) * numbers
    nuisances, found = list(h.nuisances), {}
    inner = np.linalg.pinv(total[np.ix_(nuisances, nuisances)], rcond=_RANK)
    for candidate in h.candidates:
        sizes = {}
        for name, i in zip(candidate.parameters, h.indices(candidate), strict=True):
            cross = total[i, nuisances]
            curvature = total[i, i] - cross @ inner @ cross
            size = np.sqrt(2.0 * needed / curvature) if curvature > 1e-12 else np.inf
            sizes[name.rpartition(".")[2]] = float(size * h.scale[i])
        found[candidate.key] = sizes
    return found
