"""Profile-likelihood intervals."""

from collections.abc import Sequence

import numpy as np

from sb3_hds.sysid.estimation.evidence import Evidence, Point

# How close to the wanted rise of the cost is close enough (in its root), and how often to try.
_CLOSE, _MOST_TRIES = 0.1, 5
# Most by which one try is farther from, or nearer to, the estimate than the one before.
_FARTHER, _NEARER = 3.0, 0.2
# Steps of a fit of the other parameters.
_STEPS = 6
_RANK = 1e-10


def profiled(
    evidence: Evidence, point: Point, free: Sequence[int], index: int, half: float
) -> tuple[float, float]:
    """
    The interval of a parameter by its profile likelihood: where the cost, all other free parameters
    and the start states refitted, has risen by what the parabola at the best fit rises over
    ``half``. So it is as wide as a standard error that allows for correlated errors wants it, but
    need not be symmetric: a dead zone or a delay may be known on one side only.

    Source: Raue et al., Bioinformatics 25, 2009 (profile likelihood); the rise is scaled as the
    parabola is.

    :param point: the best fit
    :param free: indices of what was fitted
    :param index: of the parameter, one of ``free``
    :param half: half the width of the symmetric interval
    :return: both ends; a physical bound where the cost does not rise enough before it
    """
    h = evidence.hypotheses
    others = [i for i in free if i != index]
    curvature = evidence.slopes(point, [index, *others]).curvature.sum(0)
    inner = np.linalg.pinv(curvature[1:, 1:], rcond=_RANK, hermitian=True)
    along = curvature[0, 0] - curvature[0, 1:] @ inner @ curvature[1:, 0]
    rise = 0.5 * max(along, 0.0) * (half / h.scale[index]) ** 2
    best = point.theta[index]
    if not np.isfinite(half) or not 0.0 < rise < np.inf:
        return float(h.lower[index]), float(h.upper[index])
    follow = -inner @ curvature[1:, 0] * h.scale[others] / h.scale[index]

    def end(side: float) -> float:
        bound = float(h.lower[index] if side < 0.0 else h.upper[index])
        away, offsets = half, point.offsets
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
