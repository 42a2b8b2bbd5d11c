"""What a diagnosis tells beside its names: errors, what would have been seen, pictures."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from sb3_hds.sysid.comparison.held_out import compare
from sb3_hds.sysid.comparison.search import LEAST_GAIN, NOT_FINITE, Half
from sb3_hds.sysid.comparison.unexplained import MissingForce
from sb3_hds.sysid.estimation.evidence import Point
from sb3_hds.sysid.reporting.finding import HorizonGain
from sb3_hds.sysid.reporting.pictures import Pictures, replay_of

# Directions below this share of the largest curvature do not move.
_RANK = 1e-10


def standard_errors(half: Half, point: Point, free: Sequence[int]) -> Float[np.ndarray, " p"]:
    """
    The jackknife over units, one Newton step for each that is left out. Units are few, and the fit
    has made the scores of each smaller than they were: the sandwich would be too sure.

    Source: MacKinnon, Nielsen, Webb, *Fast and reliable jackknife and bootstrap methods for
    cluster-robust inference*, J. Applied Econometrics 38, 2023 (CV3).

    :param free: indices of what was fitted
    :return: of all parameters; infinite for what was not fitted, or where slopes are not finite
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
    :param point: the twin as it came, nuisances refitted
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


def by_horizon(half: Half, before: Point, after: Point, every: int) -> dict[int, HorizonGain]:
    """
    :param every: steps of the data in one of the windows
    :return: errors some steps ahead, by the number of steps of the data
    """
    found, last = {}, before.raw.shape[1] - 1
    for ahead in sorted({1, max(last // 4, 1), last}):
        old, new = (
            _bounded(np.mean((point.raw[:, ahead] / half.evidence.noise) ** 2, 1))
            for point in (before, after)
        )
        gained = compare(new, old, half.unit)
        rms = [float(np.sqrt(np.mean(errors))) for errors in (old, new)]
        found[ahead * every] = HorizonGain(ahead * every, rms[0], rms[1], gained.low, gained.high)
    return found


def _bounded(errors: np.ndarray) -> np.ndarray:
    """What has run away counts as far off."""
    return np.nan_to_num(np.minimum(errors, NOT_FINITE), nan=NOT_FINITE)


def pictures_of(
    half: Half,
    before: Point,
    after: Point,
    every: int,
    missing: MissingForce,
    left: MissingForce,
) -> Pictures:
    """
    :param every: steps of the data in one of the windows
    :param missing: force before
    :param left: force after
    """
    evidence, twin = half.evidence, half.evidence.hypotheses.twin
    rows = np.flatnonzero(half.unit == half.unit[0])
    measured = np.asarray(evidence.shots.obs)[rows]
    errors = [
        np.sqrt(np.mean(_bounded((point.raw / evidence.noise) ** 2), (0, 2)))
        for point in (before, after)
    ]
    rms = np.sqrt(np.mean(after.raw**2, 0))
    return Pictures(
        channels=tuple((c.name, c.unit) for c in twin.channels),
        joints=tuple((j.name, "N" if j.unit == "m" else "N m") for j in twin.joints),
        actuators=tuple((a.name, a.unit) for a in twin.actuators),
        replay=replay_of(measured, before.raw[rows], after.raw[rows], rms, twin.dt),
        steps=every * np.arange(measured.shape[1]),
        errors=np.stack(errors),
        missing=missing,
        left=left,
    )
