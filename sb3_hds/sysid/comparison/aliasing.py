"""Aliased candidates: causes whose effects on these data are nearly collinear."""

from collections.abc import Sequence

import numpy as np

from sb3_hds.sysid.estimation.candidates import Candidate
from sb3_hds.sysid.estimation.evidence import Evidence, Point

# Cosine of the angle between what two causes do beyond which they look alike.
_IMITATION = 0.95
# Directions below this share of the largest curvature do not move.
_RANK = 1e-10


def imitators(
    evidence: Evidence, point: Point, found: Candidate, nuisances: Sequence[int]
) -> list[str]:
    """
    :param point: the fit with this cause
    :param found: the cause
    :param nuisances: indices of what else is refitted
    :return: keys of aliased candidates: after projecting out the nuisances, the cosine between what
        they and the cause change in these windows exceeds 0.95, to first order
    """
    h, total = evidence.hypotheses, evidence.slopes(point).curvature.sum(0)
    rest = list(nuisances)
    inner = np.linalg.pinv(total[np.ix_(rest, rest)], rcond=_RANK, hermitian=True)
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
