"""Which causes, all at once: a search over families, judged on data that were held out."""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import scipy

from sb3_hds.core import Effect
from sb3_hds.sysid.equation.problem import Problem, Solution
from sb3_hds.sysid.equation.weak_form import rich_columns

# Moves that are tried from each set: of what promises most when added, and in the place of another.
_ADDED, _SWAPPED, _MOST_MOVES = 12, 5, 80
# A member carries at least this share of a joint's force, and lowers held-out errors by a t of at
# least this, and so much more for each unit of rarity.
_MATERIAL, _CONFIRMED, _RARE = 0.006, 1.5, 0.9
# Below that share, one counts that takes this much off the logarithm of what the others leave.
_TRACE, _MOST_OF_THE_REST = 1e-3, 0.7
# A member whose force is below this multiple of what stays unexplained is a hint, no more; of what
# is less rare than this, a smaller one.
_OUTSTANDING, _RAREST = 1.5, 2.0
# An alternative may score worse by this, and predicts held-out data as well to this t or share.
_CLOSE, _WORSE, _SAME = 8.0, 2.0, 0.2
# Whatever its t, a loss below this share of what the place gains may come from any misfit.
_EQUIVALENT = 0.05
_MOST_ALTERNATIVES = 12
_CONFIDENCE = 0.9
# Members of a family that are another one with more parameters, and the gain in the logarithm of
# held-out errors that is not worth these.
_SIMPLER = {
    "stribeck_friction": "coulomb_friction",
    "load_dependent_friction": "coulomb_friction",
    "directional_coulomb_friction": "coulomb_friction",
    "directional_viscous_friction": "viscous_friction",
    "concave_friction": "viscous_friction",
    "directional_gain": "torque_gain",
}
_NO_MATTER = 0.02
# Members of which so rare ones are doubted, and how many.
_DOUBTFUL, _MOST_SHAKEN = 1.5, 4
_VISCOUS, _DRY = "viscous_friction", "coulomb_friction"
_LATE = ("action_delay", "motor_lag")
# Joints at which the same effect may stand for something that all share.
_MANY_JOINTS = 3
# Place of what all actuators have in common.
_SHARED = ("actuator", -1)


class Member(NamedTuple):
    """
    One cause of a set.

    :param item: index
    :param key: of the candidate
    :param sizes: by short name; of a parameter of the twin, its change
    :param low: ends of 90 % intervals, by short name; of what was tried at a few values only, the
        ones next to it
    :param high: likewise
    :param gain: what leaving it out costs, in -2 log likelihood
    :param t: of the held-out gain over folds
    :param others: keys of candidates that held-out data do not tell from it
    """

    item: int
    key: str
    sizes: dict[str, float]
    low: dict[str, float]
    high: dict[str, float]
    gain: float
    t: float
    others: tuple[str, ...]


class Left(NamedTuple):
    """
    What a set leaves at a joint.

    :param share: of its force, root mean square of rows
    :param noise: the same in units of what the noise of the velocities alone would leave
    :param predictable: share of it that all columns together predict on held-out data
    :param most: key of the candidate that takes most of it
    :param gain: by which the set lowers the held-out error of the nominal model
    """

    share: float
    noise: float
    predictable: float
    most: str
    gain: float


class Proposal(NamedTuple):
    """
    :param keys: items of the set
    :param hints: items that are small beside what stays unexplained
    """

    keys: tuple[int, ...]
    hints: tuple[int, ...]


def propose(problem: Problem) -> Proposal:
    """:return: the set of causes that explains most for its price, each of which data confirm"""
    starts = _starts(problem)
    results = [_climb(problem, keys) for keys in starts]
    _, keys = min(results, key=lambda r: r[0])
    keys = _shared_instead(problem, keys)
    keys = _shaken(problem, keys)
    keys = _material(problem, keys)
    keys = _simplified(problem, keys)
    keys = _plausible_first(problem, keys)
    keys = _simplified(problem, _confirmed(problem, keys))
    kept, hints = outstanding(problem, keys)
    return Proposal(tuple(kept), tuple(hints))


# ------------------------------------------------------------------------------ starts
def _starts(p: Problem) -> list[list[int]]:
    """Whole machines: friction at every joint, the same with everything late, and nothing."""
    friction = _friction_beside(p, list(p.always))
    starts = [friction]
    if p.dof < 3 or not friction:
        starts.append(list(p.always))
    for name in _LATE:
        options = [
            i
            for i, item in enumerate(p.items)
            if item.candidate.name == name and item.candidate.index == _first_place(p, name)
        ]
        tried = [_friction_beside(p, [*p.always, i]) for i in options]
        best = min(tried, key=p.score, default=friction)
        if p.score(best) < p.score(friction):
            starts.append(best)
    return starts


def _first_place(p: Problem, name: str) -> int:
    """The bus that all actuators share, where there is one."""
    return min((item.candidate.index for item in p.items if item.candidate.name == name), default=0)


def _friction_beside(p: Problem, others: list[int]) -> list[int]:
    """Viscous and dry friction everywhere; what would drive leaves, the most negative first."""
    names = (_VISCOUS, _DRY)
    keys = [i for i, item in enumerate(p.items) if item.candidate.name in names] + others
    while True:
        found = p.solve(keys)
        bad = [
            i
            for i in keys
            if p.items[i].candidate.name in names and p.items[i].columns[0] in found.held
        ]
        if not bad:
            return keys
        keys = [i for i in keys if i not in bad]


# ------------------------------------------------------------------------------ moves
def _climb(p: Problem, keys: list[int], barred: Collection[int] = ()) -> tuple[float, list[int]]:
    """:param barred: items that no set may have"""
    score = p.score(keys)
    moves: tuple[Callable[[Problem, list[int]], list[list[int]]], ...] = (
        _add_or_drop,
        _swap,
        _at_all_joints,
    )
    for _ in range(_MOST_MOVES):
        for move in moves:
            tried = [
                (p.score(t), t)
                for t in move(p, keys)
                if not p.clashes(t) and not any(i in barred for i in t)
            ]
            best = min(tried, key=lambda one: one[0], default=(np.inf, keys))
            if best[0] < score - 1e-6:
                score, keys = best
                break
        else:
            break
    return score, keys


def _add_or_drop(p: Problem, keys: list[int]) -> list[list[int]]:
    families = {p.family(i) for i in keys}
    open_to = [i for i in p.ranking(keys) if p.family(i) not in families]
    dropped = [[m for m in keys if m != i] for i in keys if i not in p.always]
    return [[*keys, i] for i in open_to[:_ADDED]] + dropped


def _swap(p: Problem, keys: list[int]) -> list[list[int]]:
    trials = []
    for i in keys:
        if i in p.always:
            continue
        rest = [m for m in keys if m != i]
        trials += [[*rest, o] for o in p.ranking(rest, swaps(p, keys, i))[:_SWAPPED]]
    return trials


def swaps(p: Problem, keys: Sequence[int], i: int) -> list[int]:
    """:return: items that could be in the place of a member"""
    taken = {p.family(m) for m in keys if m != i}
    own = set(p.joints(i))
    return [
        o
        for o in range(len(p.items))
        if o not in keys and p.family(o) not in taken and own & set(p.joints(o))
    ]


def _at_all_joints(p: Problem, keys: list[int]) -> list[list[int]]:
    """The same effect everywhere, added, taken away, or exchanged for one that all share."""
    if p.dof == 1:
        return []
    trials = []
    for name in dict.fromkeys(item.candidate.name for item in p.items):
        every = [i for i, item in enumerate(p.items) if item.candidate.name == name]
        without = [i for i in keys if p.items[i].candidate.name != name]
        if len(without) < len(keys):
            trials.append(without)
        single = [i for i in every if p.items[i].rule == "linear" and not p.items[i].settings]
        if len(single) > 1 and p.items[single[0]].candidate.slot != "parameter":
            taken = {p.family(i) for i in without}
            trials.append(
                _inside_bounds(p, without, [i for i in single if p.family(i) not in taken])
            )
        trials += [[*without, i] for i in every if p.place(i) == _SHARED]
    return trials


def _inside_bounds(p: Problem, keys: list[int], new: list[int]) -> list[int]:
    while new:
        found = p.solve([*keys, *new])
        value = dict(zip(found.free, found.theta, strict=True))
        bad = [i for i in new if any(value[c] < p.lower[c] for c in p.items[i].free if c in value)]
        if not bad:
            break
        new = [i for i in new if i not in bad]
    return [*keys, *new]


def _shared_instead(p: Problem, keys: list[int]) -> list[int]:
    """
    Climb again with what all actuators share, such as a late bus, in the place of something at many
    joints: that is better only once the others have made room.
    """
    score = p.score(keys)
    while True:
        trials = []
        for name in dict.fromkeys(p.items[i].candidate.name for i in keys):
            rest = [i for i in keys if p.items[i].candidate.name != name]
            if len(keys) - len(rest) < _MANY_JOINTS:
                continue
            shared = [i for i in range(len(p.items)) if p.place(i) == _SHARED and i not in keys]
            trials += [[*rest, i] for i in p.ranking(rest, shared)]
        trials = [t for t in trials if not p.clashes(t)]
        if not trials:
            return keys
        new_score, new = _climb(p, min(trials, key=p.score))
        if new_score >= score - 1e-6:
            return keys
        score, keys = new_score, new


def _shaken(p: Problem, keys: list[int]) -> list[int]:
    """
    Climb again without one member at a time, the least plausible first: what was added early may
    stand for two others, and no single move tells.
    """
    score, tried = p.score(keys), set()
    for _ in range(_MOST_SHAKEN):
        doubtful = [
            i
            for i in keys
            if i not in p.always and p.items[i].key not in tried and p.rarity[i] >= _DOUBTFUL
        ]
        if not doubtful:
            break
        worst = max(doubtful, key=lambda i: p.rarity[i])
        tried.add(p.items[worst].key)
        barred = {i for i, item in enumerate(p.items) if item.key == p.items[worst].key}
        new_score, new = _climb(p, [i for i in keys if i != worst], barred)
        new_score, new = _climb(p, new)
        if new_score < score - 1e-6:
            score, keys = new_score, new
    return keys


# ------------------------------------------------------------------------------ what stays
def _material(p: Problem, keys: list[int]) -> list[int]:
    """Without what carries next to nothing, unless it is most of what the others leave."""
    held = p.held_out(keys)
    kept: set[int] = set()
    while keys:
        own = [i in p.always or i in kept for i in keys]
        share = np.where(own, 1.0, p.carried(keys))
        worst = int(np.argmin(share))
        if share[worst] > _MATERIAL:
            break
        rest = [i for i in keys if i != keys[worst]]
        without = p.held_out(rest)
        if share[worst] > _TRACE and worth(p, without, held, keys[worst])[0] > _MOST_OF_THE_REST:
            kept.add(keys[worst])
        else:
            keys, held = rest, without
    return keys


def _confirmed(p: Problem, keys: list[int]) -> list[int]:
    while keys:
        held = p.held_out(keys)
        t = [
            np.inf
            if i in p.always
            else worth(p, p.held_out([m for m in keys if m != i]), held, i)[1]
            for i in keys
        ]
        short = [x - _least_t(p, i) for i, x in zip(keys, t, strict=True)]
        if min(short) > 0.0:
            break
        rest = [i for i, x in zip(keys, short, strict=True) if x > min(short)]
        keys = admitted(p, retuned(p, rest))
    return keys


def retuned(p: Problem, keys: list[int]) -> list[int]:
    """What is not linear in a member, at the values that suit the others as they are now."""
    for place, i in enumerate(list(keys)):
        if p.items[i].settings and i not in p.always:
            same = [o for o, item in enumerate(p.items) if item.key == p.items[i].key]
            trials = [[*keys[:place], o, *keys[place + 1 :]] for o in same]
            keys = min(trials, key=lambda t: (t[place] in p.beyond(t), p.solve(t).rss))
    return keys


def admitted(p: Problem, keys: list[int]) -> list[int]:
    """Without a member, another may fall out of its bounds: a simpler one stands in, or none."""
    while beyond := [i for i in p.beyond(keys) if i not in p.always]:
        worst = max(beyond, key=lambda i: p.rarity[i])
        rest = [m for m in keys if m != worst]
        trials = [rest, *([*rest, o] for o in simpler(p, worst))]
        keys = min(trials, key=lambda t: (len(p.beyond(t)), p.score(t)))
    return keys


def simpler(p: Problem, i: int) -> list[int]:
    """:return: items of the same family and place with fewer parameters"""
    name = _SIMPLER.get(p.items[i].candidate.name)
    return [
        o
        for o, item in enumerate(p.items)
        if item.candidate.name == name and p.family(o) == p.family(i)
    ]


def _simplified(p: Problem, keys: list[int]) -> list[int]:
    """A richer member of a family whose simpler one predicts held-out data as well is that one."""
    for i in list(keys):
        others = simpler(p, i)
        if not others:
            continue
        rest = [m for m in keys if m != i]
        held = p.held_out(keys)
        gained, _ = worth(p, p.held_out(rest), held, i)
        for other in others:
            if not np.isfinite(p.score([*rest, other])):
                continue
            lost, t = worth(p, p.held_out([*rest, other]), held, i)
            if t < _WORSE or lost < max(_NO_MATTER, _EQUIVALENT * gained):
                keys = [*rest, other]
    return keys


def _plausible_first(p: Problem, keys: list[int]) -> list[int]:
    """Of what data cannot tell apart, what an engineer would think of first."""
    for i in list(keys):
        if i in p.always:
            continue
        rest, held = [m for m in keys if m != i], p.held_out(keys)
        gained, _ = worth(p, p.held_out(rest), held, i)
        others = [o for o in _equals(p, keys, i, held, gained) if p.rarity[o] < p.rarity[i]]
        if others:
            keys = [*rest, min(others, key=lambda o: (p.rarity[o], p.score([*rest, o])))]
    return keys


def worth(p: Problem, without: np.ndarray, held: np.ndarray, i: int) -> tuple[float, float]:
    """
    :param without: held-out errors without a member
    :param held: with it
    :return: mean logarithm of their ratio, and its t over folds, at the member's own joint; where
        it acts at several, at the one that gains most; of what all actuators share, over all
    """
    ratio = np.log((without + 1e-9) / (held + 1e-9))
    joints = p.joints(i)
    joint = joints[int(np.argmax(ratio.mean(0)[joints]))]
    x = ratio[:, joints].ravel() if p.place(i) == _SHARED else ratio[:, joint]
    return float(x.mean()), float(x.mean() / (x.std(ddof=1) / np.sqrt(len(x)) + 1e-9))


def _least_t(p: Problem, i: int) -> float:
    """The rarer a cause is, the surer it has to be."""
    return _CONFIRMED + _RARE * p.rarity[i]


def outstanding(p: Problem, keys: Sequence[int]) -> tuple[list[int], list[int]]:
    """
    Where a model misses structure of some size, an effect that is no larger is as likely a part of
    the misfit.

    :return: members that stand out, and hints
    """
    keys, hints = list(keys), []
    while keys:
        left = np.array(
            [x.share * np.sqrt(np.clip(x.predictable, 0.0, 1.0)) for x in what_is_left(p, keys)]
        )
        found, ratio = p.solve(keys), []
        for i in keys:
            force = p.force_of(i, found) / p.force
            own = force / np.maximum(left, 1e-6) / _least_ratio(p, i)
            ratio.append(np.inf if i in p.always else float(np.max(own)))
        if min(ratio) >= 1.0:
            break
        worst = int(np.argmin(ratio))
        hints.append(keys.pop(worst))
    return keys, hints


def _least_ratio(p: Problem, i: int) -> float:
    """Friction that every joint has stands out sooner than what is rare."""
    return _OUTSTANDING * (1.0 + min(p.rarity[i], _RAREST)) / (1.0 + _RAREST)


def what_is_left(p: Problem, keys: Sequence[int]) -> list[Left]:
    """:return: at each joint"""
    weights, grams, out = p.solve(keys).weights, p.grams, []
    nominal = p.held_out(list(p.always)).sum(0)
    gain = 1.0 - np.sqrt(p.held_out(keys).sum(0) / np.maximum(nominal, 1e-300))
    others = [i for i in range(len(p.items)) if i not in keys]
    for j in range(p.dof):
        gram = grams.by_joint[j]
        rss = max(float(weights @ gram @ weights), 1e-12)
        diagonal = np.diag(gram) + 1e-300
        noise = np.sqrt(rss / grams.effective[j])
        floor = grams.floor[j]
        slope = (gram @ weights) ** 2 / diagonal / rss
        most = max(others, key=lambda i: max(slope[list(p.items[i].free)], default=0.0), default=-1)
        out.append(
            Left(
                share=float(noise * grams.scale[j] / (p.force[j] * _row_gain(p, j))),
                noise=float(noise / floor) if floor > 0.0 else np.nan,
                predictable=_predictable(p, weights, j, diagonal),
                most=p.items[most].key if most >= 0 else "",
                gain=float(gain[j]),
            )
        )
    return out


def _row_gain(p: Problem, j: int) -> float:
    """By how much a force that changes slowly is larger in a row than at an instant."""
    return p.grams.gain[j]


def _predictable(p: Problem, weights: np.ndarray, j: int, diagonal: np.ndarray) -> float:
    """Ridge regression of what is left on all linear columns, fold by fold."""
    columns = np.arange(len(weights) - 1)
    rich = columns[rich_columns(list(p.items), columns)]
    rich = rich[diagonal[rich] > 1e-12]
    on = np.union1d(rich, np.flatnonzero(weights))
    rich, weights = np.searchsorted(on, rich), weights[on]
    every = p.grams.by_joint[j][np.ix_(on, on)]
    base = predicted = 0.0
    for fold in (fold[np.ix_(on, on)] for fold in p.grams.folds[:, j]):
        train = every - fold
        size = np.sqrt(np.abs(np.diag(train)[rich])) + 1e-300
        inner = train[np.ix_(rich, rich)] / np.outer(size, size)
        x = np.linalg.solve(inner + 0.02 * np.eye(len(rich)), (train[rich] @ weights) / size)
        then = weights.copy()
        then[rich] -= x / size
        base += weights @ fold @ weights
        predicted += then @ fold @ then
    return float(1.0 - predicted / base) if base > 0.0 else 0.0


# ------------------------------------------------------------------------------ what is told
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
                float(cost) if np.isfinite(cost) else 1e6,
                t,
                tuple(dict.fromkeys(p.items[o].key for o in _equals(p, keys, i, held, gained))),
            )
        )
    return out


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


def _equals(
    p: Problem, keys: Sequence[int], i: int, held: np.ndarray, gained: float
) -> Iterator[int]:
    """
    :param held: held-out errors of the set
    :param gained: mean logarithm of their ratio without the member
    :return: items in whose place of the member the set is as good
    """
    own, rest = p.score(keys), [m for m in keys if m != i]
    for other in p.ranking(rest, swaps(p, keys, i))[:_MOST_ALTERNATIVES]:
        if p.items[other].key == p.items[i].key:
            continue
        trial = [*rest, other]
        if p.score(trial) < own + _CLOSE:
            lost, t = worth(p, p.held_out(trial), held, i)
            few, surely = lost < _EQUIVALENT * gained, t >= _WORSE
            if few or (not surely and lost < _SAME * max(gained, 1e-3)):
                yield other
