"""The members of a set with their sizes, intervals and alternatives."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import scipy

from sb3_hds.core import Effect
from sb3_hds.sysid.equation.confirmation import equals, worth
from sb3_hds.sysid.equation.problem import Problem, Solution
from sb3_hds.sysid.equation.regression import Item

_CONFIDENCE = 0.9
# Sets with one more member that count in intervals, at most, and those that are tried.
_MORE_SETS, _TRIED_SETS = 12, 60


class Member(NamedTuple):
    """
    One cause of a set.

    :param item: index
    :param key: of the candidate
    :param sizes: by short name; of a parameter of the twin, its change
    :param low: ends of 90 % intervals, by short name; of what was tried at a few values only, the
        ones next to it
    :param high: likewise
    :param doubt: by short name, half the width of the interval that comes from not knowing whether
        there is one cause more
    :param gain: increase of -2 log likelihood without it
    :param t: t statistic of the held-out gain over folds
    :param others: keys of candidates that predict held-out data as well in its place
    """

    item: int
    key: str
    sizes: dict[str, float]
    low: dict[str, float]
    high: dict[str, float]
    doubt: dict[str, float]
    gain: float
    t: float
    others: tuple[str, ...]


def members(p: Problem, keys: Sequence[int], effects: Mapping[str, Effect | None]) -> list[Member]:
    """
    :param effects: by key of the candidate; None for parameters
    :return: sizes with cluster-robust intervals, and alternatives
    """
    found = p.solve(keys)
    covariance = _covariance(p, keys, found)
    quantile = scipy.stats.t.ppf(0.5 + _CONFIDENCE / 2.0, max(p.grams.n_blocks - 1, 5))
    errors = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    stderr = dict(zip(found.free, errors, strict=True))
    base, held, out = p.score(keys, priced=False), p.held_out(keys), []
    larger = _with_one_more(p, keys)
    for i in keys:
        rest = [m for m in keys if m != i]
        item = p.items[i]
        if not set(item.free) <= {*found.free, *found.held}:
            continue
        value = found.value
        coefficients = np.array([value[c] for c in item.free])
        spread = np.array([quantile * stderr.get(c, 0.0) for c in item.free])
        effect = effects.get(item.key)
        sizes, low, high = (
            item.sizes(effect, coefficients + side * spread) for side in (0.0, -1.0, 1.0)
        )
        doubt = _doubt(item, effect, sizes, larger)
        for name, least in doubt.items():
            for ends in (low, high):
                away = ends[name] - sizes[name]
                ends[name] = sizes[name] + np.copysign(np.hypot(away, least), away)
        for name, (below, above) in _tried_beside(p, i).items():
            low[name], high[name] = below, above
        gained, t = worth(p, p.held_out(rest), held, i)
        cost = p.score(rest, priced=False) - base
        out.append(
            Member(
                i,
                item.key,
                sizes,
                low,
                high,
                doubt,
                float(cost) if np.isfinite(cost) else 1e6,
                t,
                tuple(dict.fromkeys(p.items[o].key for o in equals(p, keys, i, held, gained))),
            )
        )
    return out


def _with_one_more(p: Problem, keys: Sequence[int]) -> list[tuple[float, dict[int, float]]]:
    """
    Sets in which a further cause is, that was not confirmed.

    Source: Buckland, Burnham, Augustin, *Model selection: an integral part of inference*,
    Biometrics 53, 1997: estimates of several models, weighed by an information criterion.

    :return: of those within physical bounds that predict held-out data better, the weight of each,
        and its coefficients by column
    """
    taken, held = {p.family(i) for i in keys}, p.held_out(keys)
    others = [o for o in p.ranking(keys)[:_TRIED_SETS] if p.family(o) not in taken]
    sets = [[*keys, o] for o in others if not p.clashes([*keys, o])]
    scored = sorted(((p.score(more), more) for more in sets), key=lambda pair: pair[0])
    own, found = p.score(keys), []
    for score, more in scored[:_MORE_SETS]:
        solution = p.solve(more)
        possible = np.isfinite(score) and not set(p.items[more[-1]].free) & {*solution.held}
        if possible and worth(p, held, p.held_out(more), more[-1])[0] > 0.0:
            found.append((score, solution.value))
    if not found or not np.isfinite(own):
        return []
    best = min(own, found[0][0])
    weights = [float(np.exp(0.5 * (best - score))) for score, _ in found]
    total = sum(weights) + float(np.exp(0.5 * (best - own)))
    return [(weight / total, value) for weight, (_, value) in zip(weights, found, strict=True)]


def _doubt(
    item: Item,
    effect: Effect | None,
    sizes: Mapping[str, float],
    larger: Sequence[tuple[float, Mapping[int, float]]],
) -> dict[str, float]:
    """:return: by short name, half the width of an interval over what larger sets estimate"""
    squares = dict.fromkeys(sizes, 0.0)
    for weight, value in larger:
        if set(item.free) <= value.keys():
            there = item.sizes(effect, [value[c] for c in item.free])
            for name in squares:
                squares[name] += weight * (there[name] - sizes[name]) ** 2
    quantile = scipy.stats.norm.ppf(0.5 + _CONFIDENCE / 2.0)
    return {name: float(quantile * np.sqrt(square)) for name, square in squares.items()}


def _tried_beside(p: Problem, i: int) -> dict[str, tuple[float, float]]:
    """:return: of what stands at one of several values, such as a speed, the values next to it"""
    item = p.items[i]
    if item.rule != "linear" or not item.settings:
        return {}
    found = {}
    for name, value in item.settings[0].items():
        tried = {
            o.settings[0][name] for o in p.items if o.key == item.key and name in o.settings[0]
        }
        below = max((x for x in tried if x < value), default=value)
        above = min((x for x in tried if x > value), default=value)
        found[name] = (float(below), float(above))
    return found


def _covariance(p: Problem, keys: Sequence[int], found: Solution) -> np.ndarray:
    """Blocks of data as clusters, never narrower than rows alone would have it."""
    if not found.free:
        return np.zeros((0, 0))
    scores = p.grams.blocks[:, found.free] @ found.weights
    n = len(scores)
    robust = found.inverse @ (scores.T @ scores) @ found.inverse
    robust *= n / max(n - len(found.free) / max(p.dof, 1), n / 2)
    own = np.eye(len(found.free), dtype=bool)
    return np.where(own, np.maximum(robust, found.inverse), robust)
