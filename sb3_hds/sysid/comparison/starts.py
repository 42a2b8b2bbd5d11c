"""Where fits of candidates begin, and which of them are worth one."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from sb3_hds.sysid.comparison.inference import WEAK
from sb3_hds.sysid.estimation.candidates import Candidate
from sb3_hds.sysid.estimation.evidence import Evidence, Point, in_threads

# Where fits begin for which the slope at the null is no guide, in units of each parameter's scale.
_AWAY = 3.0
# Where else it may be better, in the same units.
_DISTANCES = (0.1, 0.3, 1.0, 3.0)
# Of several starts, so many that promise most are fitted, in at least so many steps: after a few, a
# start that leads nowhere may be ahead.
_FITTED, _LEAST_STEPS = 3, 8
# A Newton step promises nothing beyond, in the same units.
_FARTHEST = 10.0
# Curvature, per measurement, below which there is no slope.
_FLAT = 1e-15


class Guess(NamedTuple):
    """
    :param gain: by which the cost would fall
    :param theta: where to begin a fit, shape ``(p,)``
    :param offsets: and with which start states, shape ``(n, free)``
    :param blind: what the slope says where nothing is wrong is no guide: it is none, or it leads
        nowhere although things are better farther away
    :param start: of several starts, the best one: values of parameters by full name
    """

    gain: float
    theta: Float[np.ndarray, " p"]
    offsets: Float[np.ndarray, "n free"]
    blind: bool
    start: Mapping[str, float] | None = None


class Here(NamedTuple):
    """
    Where one looks from.

    :param evidence: windows
    :param point: the current model, fitted to them
    :param free: indices of what is refitted whichever candidate it is
    :param steps: of fits that see whether it is better elsewhere
    """

    evidence: Evidence
    point: Point
    free: tuple[int, ...]
    steps: int


def guesses(
    here: Here, candidates: Sequence[Candidate], known: Mapping[str, Mapping[str, float]]
) -> list[Guess]:
    """
    What one Newton step promises, and where it leads; elsewhere if that is no guide.

    :param known: of candidates with several starts, by key, the one that is known to be best
    """
    h, point = here.evidence.hypotheses, here.point
    slopes = here.evidence.slopes(point)
    curvature, score = slopes.curvature.sum(0), slopes.scores.sum(0)
    flat = np.diag(curvature) < _FLAT * point.residual.size
    room = _room(here, point.theta)

    def guess(candidate: Candidate) -> Guess:
        if candidate.key in h.starts:
            best = known.get(candidate.key)
            return _from_starts(
                here, candidate, h.starts[candidate.key] if best is None else [best]
            )
        own = list(h.indices(candidate))
        step, gain = newton(curvature, score, [*here.free, *own], room)
        theta, blind = point.theta + h.scale * step, bool(flat[own].any())
        if blind:
            theta = _away(here, candidate, _AWAY)
        elif h.remembers(candidate):
            place = _farther(here, candidate, gain)
            theta, blind = (theta, False) if place is None else (place, True)
        return Guess(gain, theta, point.offsets, blind)

    return list(in_threads(guess, candidates))


def newton(
    curvature: np.ndarray, score: np.ndarray, moving: list[int], room: tuple[np.ndarray, np.ndarray]
) -> tuple[np.ndarray, float]:
    """
    :param moving: indices; what would leave its room ends at its border
    :return: the step of all parameters, and by how much the cost would fall
    """
    step = np.zeros(len(score))
    while moving:
        inner = np.linalg.pinv(curvature[np.ix_(moving, moving)], rcond=WEAK, hermitian=True)
        step[moving] -= inner @ (score + curvature @ step)[moving]
        wanted, allowed = step[moving], np.clip(step[moving], room[0][moving], room[1][moving])
        step[moving] = allowed
        if (inside := wanted == allowed).all():
            break
        moving = [i for i, kept in zip(moving, inside, strict=True) if kept]
    return step, -float(score @ step + 0.5 * step @ curvature @ step)


def _room(here: Here, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How far each parameter may move down and up, in units of its scale."""
    h = here.evidence.hypotheses
    return (
        np.maximum((h.lower - theta) / h.scale, -_FARTHEST),
        np.minimum((h.upper - theta) / h.scale, _FARTHEST),
    )


def _farther(here: Here, candidate: Candidate, gain: float) -> Float[np.ndarray, " p"] | None:
    """
    The first bit of a gap says little about a whole one.

    :param gain: that a Newton step promises
    :return: where it is better than that; None if nowhere
    """
    point, places = here.point, [_away(here, candidate, distance) for distance in _DISTANCES]
    there = [here.evidence.fit(x, here.free, point.offsets, here.steps) for x in places]
    costs = [fitted.cost for fitted in there]
    return places[int(np.argmin(costs))] if min(costs) < point.cost - gain else None


def _from_starts(here: Here, candidate: Candidate, starts: Sequence[Mapping[str, float]]) -> Guess:
    """
    What fits of the others promise where some parameters stay at one of several values.

    :return: at the best of these, where a fit of all may begin
    """
    h = here.evidence.hypotheses
    fixed = {h.names.index(name) for name in starts[0]}
    index = [*here.free, *(i for i in h.indices(candidate) if i not in fixed)]
    promising = starts
    if len(starts) > _FITTED:
        ranked = sorted(starts, key=lambda start: -_promised(here, _at(here, start), index))
        promising = ranked[:_FITTED]
    steps = max(here.steps, _LEAST_STEPS)
    fits = [
        here.evidence.fit(_at(here, start), index, here.point.offsets, steps) for start in promising
    ]
    best = int(np.argmin([fitted.cost for fitted in fits]))
    there = fits[best]
    gain = here.point.cost - there.cost
    return Guess(gain, there.theta, there.offsets, False, promising[best])


def _at(here: Here, start: Mapping[str, float]) -> Float[np.ndarray, " p"]:
    theta = here.point.theta.copy()
    theta[[here.evidence.hypotheses.names.index(name) for name in start]] = list(start.values())
    return theta


def _promised(here: Here, theta: Float[np.ndarray, " p"], index: list[int]) -> float:
    """:return: by how much the cost would fall by one Newton step of these parameters"""
    slopes = here.evidence.slopes(here.point._replace(theta=theta), index)
    low, high = (bound[index] for bound in _room(here, theta))
    every = list(range(len(index)))
    return newton(slopes.curvature.sum(0), slopes.scores.sum(0), every, (low, high))[1]


def _away(here: Here, candidate: Candidate, distance: float) -> Float[np.ndarray, " p"]:
    h = here.evidence.hypotheses
    theta, own = here.point.theta.copy(), list(h.indices(candidate))
    theta[own] = np.clip(h.null[own] + distance * h.scale[own], h.lower[own], h.upper[own])
    return theta
