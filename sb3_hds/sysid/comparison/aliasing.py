"""Which causes would do nearly the same to these data as another one."""

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
    :param point: where the twin with this cause has been fitted
    :param found: the cause
    :param nuisances: indices of what else is refitted
    :return: other candidates that could stand for nearly all of what the cause does to these
        windows, to first order: the cosine between the two exceeds 0.95
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
