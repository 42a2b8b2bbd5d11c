"""A belief over twins, from the answers that a diagnosis leaves open."""

import numpy as np
from jaxtyping import Float

from sb3_hds.core.belief import BeliefTwin
from sb3_hds.sysid.belief.answers import Answers, union

# How often a draw out of its physical bounds is drawn again before it is moved to them.
_TRIES = 50


def belief_of(answers: Answers, n: int = 64, seed: int = 0) -> BeliefTwin:
    r"""
    Draws from :math:`\sum_m w_m \, N(\theta_m, L_m L_m^T)`, each normal cut off at the physical
    bounds: :math:`w_m` is proportional to the likelihood of answer :math:`m` on held-out
    recordings, in which correlated errors count as fewer, times its prior odds.

    :param answers: that the data leave open
    :param n: draws; each answer has its share of them, to one draw, and at least one
    :param seed: of the draws
    :return: one twin with everything that any answer has; draw 0 is the likeliest answer as fitted
    """
    twin, values, factor = union(answers.answers)
    rng, bounds = np.random.default_rng(seed), list(twin.parameters.values())
    low, high = (np.array([getattr(p, end) for p in bounds]) for end in ("lower", "upper"))
    origin = _shares(answers.weights, n)
    draws = np.stack([_drawn(rng, values[m], factor[m], low, high) for m in origin])
    draws[0] = values[0]
    names = [answer.name for answer in answers.answers]
    return BeliefTwin(twin, draws, origin, names, tuple(answers.weights))


def _shares(weights: Float[np.ndarray, " m"], n: int) -> np.ndarray:
    """:return: number of the answer of each draw, ascending; the likeliest takes what is left"""
    counts = np.maximum(np.round(weights * n).astype(int), 1)
    counts[0] = max(n - counts[1:].sum(), 1)
    return np.repeat(np.arange(len(weights)), counts)


def _drawn(
    rng: np.random.Generator,
    value: Float[np.ndarray, " p"],
    factor: Float[np.ndarray, "p k"],
    low: Float[np.ndarray, " p"],
    high: Float[np.ndarray, " p"],
) -> Float[np.ndarray, " p"]:
    for _ in range(_TRIES):
        drawn = value + factor @ rng.standard_normal(factor.shape[1])
        if np.all((low <= drawn) & (drawn <= high)):
            return drawn
    return np.clip(drawn, low, high)
