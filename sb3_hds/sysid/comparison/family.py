"""Family-wise significance: the largest gain among all candidates under the null hypothesis."""

from collections.abc import Sequence

import numpy as np

from sb3_hds.sysid.estimation.evidence import Slopes

# Draws of the bootstrap, and how many at a time, so that memory stays small.
_N_DRAWS, _AT_A_TIME = 999, 250
# Directions below this share of the largest curvature do not move.
_RANK = 1e-9


def chance_of_the_best(
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
    inner = np.linalg.pinv(curvature[np.ix_(fixed, fixed)], rcond=_RANK, hermitian=True)
    onto = curvature[:, fixed] @ inner
    scores = scores - scores[:, fixed] @ onto.T
    n = len(scores)
    scores = (scores - scores.mean(0)) * n / max(n - len(fitted), 1)
    curvature = curvature - onto @ curvature[fixed]
    sizes = [
        (list(own), np.linalg.pinv(curvature[np.ix_(own, own)], rcond=_RANK, hermitian=True))
        for own in candidates
    ]
    rng, as_large = np.random.default_rng(seed), 1
    for first in range(0, _N_DRAWS, _AT_A_TIME):
        drawn = rng.standard_normal((min(_AT_A_TIME, _N_DRAWS - first), n)) @ scores
        gains = [0.5 * np.einsum("di,ij,dj->d", drawn[:, o], k, drawn[:, o]) for o, k in sizes]
        as_large += int(np.sum(np.max(gains, axis=0) >= gain))
    return as_large / (1 + _N_DRAWS)
