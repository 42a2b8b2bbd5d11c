"""The answers that a search leaves open, fitted to all data, with weights and covariances."""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from sb3_hds.core import Trajectories, Twin
from sb3_hds.sysid.belief.answers import Answer, Answers, everything_open, factor_of
from sb3_hds.sysid.comparison.halves import Accepted, Base, Half
from sb3_hds.sysid.comparison.held_out import effective_size
from sb3_hds.sysid.comparison.inference import RANK, jackknife
from sb3_hds.sysid.comparison.search import Search, places_of
from sb3_hds.sysid.equation.plausibility import rarity_of
from sb3_hds.sysid.estimation.candidates import Candidate
from sb3_hds.sysid.estimation.evidence import Point

#: largest number of answers, the likeliest ones
MOST = 6
# Steps of a window where no motion was measured from which to choose it.
_WINDOW = 20
# Number of candidates that stand in for an unexplained residual.
_NEAREST = 3
# Step of the difference by which the twin's parameters follow a candidate's, in typical deviations:
# they are linear in it.
_STEP = 1e-4

#: keys of causes and all parameters -> the nominal model with these causes
Extended = Callable[[Sequence[str], np.ndarray], Twin]


def open_answers(
    search: Search,
    found: Sequence[Accepted],
    rejected: Sequence[Candidate],
    base: Base,
    extended: Extended,
    data: Trajectories,
    thinning: int,
    unexplained: str = "",
) -> Answers:
    """
    The causes that were found; the same with each alternative in place of its cause; and, if a
    residual is unexplained, the same with each of the nearest candidates added. Each is fitted to
    all data, and weighted by its likelihood on held-out recordings and its prior odds.

    :param found: causes
    :param rejected: candidates that were not accepted, the nearest first
    :param base: fit of the causes
    :param extended: makes the twin of an answer
    :param data: of the same interval as the windows
    :param thinning: steps of the twin in one of the windows
    :param unexplained: what remains, in words; empty if nothing does
    """
    h = search.hypotheses
    by_key = {c.key: c for c in h.candidates}
    own = [one.tried.candidate for one in found]
    sets = [(own, base)]
    for n, one in enumerate(found):
        alternatives = [by_key[key] for key in one.alternatives if key in by_key]
        if alternatives:
            without = search.without(base, one.tried.candidate)
            alternatives = [c for c in alternatives if not search.part_of(c, without)]
            sets += [
                ([*own[:n], tried.candidate, *own[n + 1 :]], search.believing(tried, without))
                for tried in search.fit(alternatives, without, places_of(one.rivals))
            ]
    if unexplained:
        nearest = [c for c in rejected if not search.part_of(c, base)][:_NEAREST]
        sets += [
            ([*own, tried.candidate], search.believing(tried, base))
            for tried in search.fit(nearest, base)
        ]
    n_effective = effective_size(base.held_out.residual / search.noise)
    least = min(search.confirm.total(one.held_out) for _, one in sets)
    answers = []
    for candidates, one in sets:
        likelihood = -0.5 * n_effective * np.log(search.confirm.total(one.held_out) / least)
        odds = -sum(rarity_of(c, h.twin) for c in candidates)
        answers.append((likelihood + odds, candidates, one))
    answers = sorted(answers, key=lambda answer: -answer[0])[:MOST]
    return Answers(
        tuple(_answer(search, weight, causes, one, extended) for weight, causes, one in answers),
        np.asarray(search.noise, float),
        thinning * max(base.held_out.residual.size / n_effective, 1.0),
        thinning * (base.held_out.residual.shape[1] - 1),
        _slowest(h.nominal, data),
    )


def nothing_known(twin: Twin, noise: Float[np.ndarray, " obs"], data: Trajectories) -> Answers:
    """
    The answer of data that determine nothing.

    :param noise: standard deviation of each channel's errors
    """
    return Answers((everything_open(twin),), noise, 1.0, _WINDOW, _slowest(twin, data))


def _answer(
    search: Search,
    log_weight: float,
    candidates: Sequence[Candidate],
    base: Base,
    extended: Extended,
) -> Answer:
    h, keys = search.hypotheses, tuple(c.key for c in candidates)
    whole, point = search.pooled(base)
    twin = extended(keys, point.theta)
    if not base.free:
        return Answer(keys, twin, {}, float(log_weight))
    covariance = joint_covariance(whole, point, base.free)
    # Typical deviations: the declared one, the smallest that these data show, or what was found.
    declared = np.array([h.parameter(name).scale for name in h.names])
    typical = np.maximum(np.maximum(declared, h.scale), np.abs(point.theta - h.null))
    factor = factor_of(covariance, typical[list(base.free)])
    rows: dict[str, np.ndarray] = {}
    for row, i in zip(factor, base.free, strict=True):
        inward = -1.0 if point.theta[i] + _STEP * h.scale[i] > h.upper[i] else 1.0
        moved = point.theta.copy()
        moved[i] += inward * _STEP * h.scale[i]
        there = extended(keys, moved).values
        for name, value in there.items():
            slope = (value - twin.values[name]) / (moved[i] - point.theta[i])
            if abs(slope) > 1e-9:
                rows[name] = rows.get(name, np.zeros(len(factor))) + slope * row
    return Answer(keys, twin, rows, float(log_weight))


def joint_covariance(half: Half, point: Point, free: Sequence[int]) -> np.ndarray:
    """
    :param free: indices of what was fitted
    :return: their covariance, by the jackknife over clusters, shape ``(k, k)``; infinite where
        slopes are not finite
    """
    scale = half.evidence.hypotheses.scale[list(free)]
    slopes = half.evidence.slopes(point, free)
    covariance = jackknife(slopes, half.cluster)
    # With fewer clusters than parameters, the jackknife covers only some directions.
    if np.isfinite(covariance).all() and len(np.unique(half.cluster)) <= len(free):
        total = slopes.curvature.sum(0)
        covariance = covariance + np.linalg.pinv(total, rcond=RANK, hermitian=True)
    return covariance * np.outer(scale, scale)


def _slowest(twin: Twin, data: Trajectories) -> np.ndarray:
    """:return: the first observation of the recording that begins slowest"""
    velocities = jax.vmap(lambda obs: twin.infer(obs, twin.params).v)(jnp.asarray(data.obs[:, 0]))
    speeds = np.linalg.norm(np.asarray(velocities), axis=1)
    return np.asarray(data.obs[int(np.argmin(speeds)), 0], float)
