"""Subset selection: a local search over sets of causes, confirmed on held-out data."""

import itertools
from collections.abc import Collection, Iterator, Sequence

import numpy as np

from sb3_hds.sysid.equation.held_out_folds import (
    EQUIVALENT,
    WORSE,
    enforce_bounds,
    equivalents,
    held_out_gain,
    predictable,
    retune,
    simpler_items,
    substitutes,
)
from sb3_hds.sysid.equation.problem import Problem
from sb3_hds.sysid.equation.regressors import DRY, LATE, SHARED, VISCOUS
from sb3_hds.sysid.estimation.candidates import PARAMETER

# Moves that are tried from each set: best additions, best substitutes of a member, and rounds.
_ADDED, _SWAPPED, _MOST_MOVES = 12, 5, 80
# Rounds of climbing again without what was not confirmed.
_MOST_ROUNDS = 3
# Best causes in place of two, and how many of such sets are tried with new nonlinear parameters.
_FOR_TWO, _RETUNED = 2, 3
# Rarity from which members are retried without, and how many.
_DOUBTFUL, _MOST_SHAKEN = 1.5, 4
# Number of joints from which the same effect may stand for one that all actuators share.
_MANY_JOINTS = 3
# Least share of a joint's force that a member carries, least t statistic of its held-out gain, and
# its increase for each unit of rarity: 1.5 for viscous friction, 5.1 for the scale of an encoder.
_MATERIAL, _CONFIRMED, _RARE = 0.006, 1.5, 0.9
# Below that share, a member is kept if it lowers the logarithm of the others' residual by this
# much.
_TRACE, _MOST_OF_THE_REST = 1e-3, 0.7
# A member whose force is below this multiple of the unexplained residual is only a hint; the
# multiple is smaller for effects that are less rare than this.
_OUTSTANDING, _RAREST = 1.5, 2.0
# Gain in the logarithm of held-out errors that does not justify more parameters.
_NO_MATTER = 0.02


def propose(problem: Problem) -> tuple[list[int], list[int]]:
    """
    :return: items of the set of causes that explains most for its price, each of which held-out
        data confirm; and hints: items that are small beside the unexplained residual
    """
    _, keys = min((_climb(problem, start) for start in _starts(problem)), key=lambda r: r[0])
    keys = _try_shared(problem, keys)
    keys = _retry_without_doubtful(problem, keys)
    return _split_hints(problem, _confirmed(problem, _with_plausible(problem, keys)))


def _confirmed(p: Problem, keys: list[int]) -> list[int]:
    """
    Remove what held-out data do not confirm, and climb again without it: what it stood for may be
    something else.
    """
    barred: set[int] = set()
    best = _only_confirmed(p, keys)
    for _ in range(_MOST_ROUNDS):
        families = {p.family(i) for i in keys} - {p.family(i) for i in best}
        barred |= {i for i in range(len(p.items)) if p.family(i) in families}
        _, keys = _climb(p, best, barred)
        keys = _simplify(p, _drop_negligible(p, keys))
        new = _only_confirmed(p, keys)
        if p.score(new) >= p.score(best) - 1e-6:
            break
        best = new
    return best


def _only_confirmed(p: Problem, keys: list[int]) -> list[int]:
    kept = _simplify(p, _drop_unconfirmed(p, keys))
    while (preferred := _prefer_plausible(p, kept)) != kept:
        kept = _simplify(p, _drop_unconfirmed(p, preferred))
    return kept


def _with_plausible(p: Problem, keys: list[int]) -> list[int]:
    """Replace members by equivalent ones with better prior odds, and climb again beside these."""
    replaced: set[int] = set()
    while True:
        keys = _simplify(p, _drop_negligible(p, keys))
        preferred = _prefer_plausible(p, keys)
        families = {p.family(i) for i in {*keys} - {*preferred} - replaced}
        if not families:
            return preferred
        replaced |= {i for i in range(len(p.items)) if p.family(i) in families}
        _, keys = _climb(p, preferred, replaced)


# ------------------------------------------------------------------------------ starts
def _starts(p: Problem) -> list[list[int]]:
    """Friction at every joint, the same with delayed commands, and the nuisances alone."""
    friction = _friction_beside(p, list(p.always))
    starts = [friction]
    if p.dof < 3 or not friction:
        starts.append(list(p.always))
    for name in LATE:
        # The bus that all actuators share, where there is one.
        own = [item.candidate.index for item in p.items if item.candidate.name == name]
        first = min(own, default=0)
        options = [
            i
            for i, item in enumerate(p.items)
            if item.candidate.name == name and item.candidate.index == first
        ]
        tried = [_friction_beside(p, [*p.always, i]) for i in options]
        best = min(tried, key=p.score, default=friction)
        if p.score(best) < p.score(friction):
            starts.append(best)
    return starts


def _friction_beside(p: Problem, others: list[int]) -> list[int]:
    """Viscous and dry friction at all joints, without what would have a negative size."""
    names = (VISCOUS, DRY)
    friction = [i for i, item in enumerate(p.items) if item.candidate.name in names]
    return _within_bounds(p, others, friction)


# ------------------------------------------------------------------------------ moves
def _climb(p: Problem, keys: list[int], barred: Collection[int] = ()) -> tuple[float, list[int]]:
    """:param barred: items that no set may have"""
    score = p.score(keys)
    for _ in range(_MOST_MOVES):
        for move in (_add_or_drop, _swap, _one_for_two, _at_all_joints):
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
    added = itertools.islice(_best_of_each(p, keys, open_to), _ADDED)
    dropped = [[m for m in keys if m != i] for i in keys if i not in p.always]
    return [*added, *dropped]


def _swap(p: Problem, keys: list[int]) -> list[list[int]]:
    trials = []
    for i in (i for i in keys if i not in p.always):
        rest = [m for m in keys if m != i]
        others = p.ranking(rest, substitutes(p, keys, i))
        trials += itertools.islice(_best_of_each(p, rest, others), _SWAPPED)
    return trials


def _best_of_each(p: Problem, keys: list[int], ranked: Sequence[int]) -> Iterator[list[int]]:
    """
    :param ranked: items to add, the best first
    :return: sets with one more: of items of the same candidate, which differ in nonlinear
        parameters, with the first that is admissible
    """
    done: set[str] = set()
    for i in ranked:
        item, more = p.items[i], [*keys, i]
        if item.key not in done and (not item.settings or np.isfinite(p.score(more))):
            done.add(item.key)
            yield more


def _one_for_two(p: Problem, keys: list[int]) -> list[list[int]]:
    """
    One candidate in place of two, of which one is a parameter of the twin: a mass for a first
    moment and an inertia, a gain for two masses, a spring for a mass and an offset.
    """
    trials = []
    open_to = [
        i for i in keys if i not in p.always and p.items[i].candidate.name not in (VISCOUS, DRY)
    ]
    others = {i: substitutes(p, keys, i) for i in open_to}
    for one, other in itertools.combinations(open_to, 2):
        if PARAMETER not in (p.items[one].candidate.slot, p.items[other].candidate.slot):
            continue
        rest = [m for m in keys if m not in (one, other)]
        common = sorted({*others[one]} & {*others[other]})
        trials += [[*rest, o] for o in p.ranking(rest, common)[:_FOR_TWO]]
    return [retune(p, t) for t in sorted(trials, key=p.score)[:_RETUNED]]


def _at_all_joints(p: Problem, keys: list[int]) -> list[list[int]]:
    """The same effect at all joints added, removed, or replaced by one that all actuators share."""
    if p.dof == 1:
        return []
    trials = []
    for name in dict.fromkeys(item.candidate.name for item in p.items):
        every = [i for i, item in enumerate(p.items) if item.candidate.name == name]
        without = [i for i in keys if p.items[i].candidate.name != name]
        if len(without) < len(keys):
            trials.append(without)
        single = [i for i in every if p.items[i].rule == "linear" and not p.items[i].settings]
        if len(single) > 1 and p.items[single[0]].candidate.slot != PARAMETER:
            taken = {p.family(i) for i in without}
            new = [i for i in single if p.family(i) not in taken]
            trials.append(_within_bounds(p, without, new))
        trials += [[*without, i] for i in every if p.place(i) == SHARED]
    return trials


def _within_bounds(p: Problem, keys: list[int], new: list[int]) -> list[int]:
    """Add new items, without those whose size would be beyond a bound."""
    while True:
        held = p.solve([*keys, *new]).held
        bad = [i for i in new if any(c in held for c in p.items[i].free)]
        if not bad:
            return [*keys, *new]
        new = [i for i in new if i not in bad]


def _try_shared(p: Problem, keys: list[int]) -> list[int]:
    """
    Climb again with an effect that all actuators share, such as a delay of the bus, in place of the
    same effect at many joints: no single move can make that exchange.
    """
    score = p.score(keys)
    while True:
        trials = []
        for name in dict.fromkeys(p.items[i].candidate.name for i in keys):
            rest = [i for i in keys if p.items[i].candidate.name != name]
            if len(keys) - len(rest) < _MANY_JOINTS:
                continue
            shared = [i for i in range(len(p.items)) if p.place(i) == SHARED and i not in keys]
            trials += [[*rest, i] for i in p.ranking(rest, shared)]
        trials = [t for t in trials if not p.clashes(t)]
        if not trials:
            return keys
        new_score, new = _climb(p, min(trials, key=p.score))
        if new_score >= score - 1e-6:
            return keys
        score, keys = new_score, new


def _retry_without_doubtful(p: Problem, keys: list[int]) -> list[int]:
    """
    Climb again without one member at a time, the least plausible first: a member that was added
    early may stand for two others, which no single move can show.
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


# ------------------------------------------------------------------------------ confirmation
def _drop_negligible(p: Problem, keys: list[int]) -> list[int]:
    """Remove members with a negligible force, unless they explain most of what the others leave."""
    held = p.held_out(keys)
    kept: set[int] = set()
    while keys:
        own = [i in p.always or i in kept for i in keys]
        share = np.where(own, 1.0, p.force_shares(keys))
        worst = int(np.argmin(share))
        if share[worst] > _MATERIAL:
            break
        rest = [i for i in keys if i != keys[worst]]
        without = p.held_out(rest)
        if (
            share[worst] > _TRACE
            and held_out_gain(p, without, held, keys[worst])[0] > _MOST_OF_THE_REST
        ):
            kept.add(keys[worst])
        else:
            keys, held = rest, without
    return keys


def _simplify(p: Problem, keys: list[int]) -> list[int]:
    """Replace a member by a simpler one of its family that predicts held-out data as well."""
    for i in list(keys):
        others = simpler_items(p, i)
        if not others:
            continue
        rest = [m for m in keys if m != i]
        held = p.held_out(keys)
        gained, _ = held_out_gain(p, p.held_out(rest), held, i)
        for other in others:
            if not np.isfinite(p.score([*rest, other])):
                continue
            lost, t = held_out_gain(p, p.held_out([*rest, other]), held, i)
            if t < WORSE or lost < max(_NO_MATTER, EQUIVALENT * gained):
                keys = [*rest, other]
    return keys


def _prefer_plausible(p: Problem, keys: list[int]) -> list[int]:
    """
    Among candidates that the data cannot distinguish, choose the one with the best prior odds.
    """
    for i in list(keys):
        if i in p.always:
            continue
        rest, held = [m for m in keys if m != i], p.held_out(keys)
        gained, _ = held_out_gain(p, p.held_out(rest), held, i)
        others = [o for o in equivalents(p, keys, i, held, gained) if p.rarity[o] < p.rarity[i]]
        if others:
            keys = [*rest, min(others, key=lambda o: (p.rarity[o], p.score([*rest, o])))]
    return keys


def _drop_unconfirmed(p: Problem, keys: list[int]) -> list[int]:
    """
    Replace members by simpler ones of their family, or remove them, the least significant first,
    until all lower held-out errors.
    """
    while keys:
        held = p.held_out(keys)
        t = [
            np.inf
            if i in p.always
            else held_out_gain(p, p.held_out([m for m in keys if m != i]), held, i)[1]
            for i in keys
        ]
        # The rarer a cause is, the surer it has to be.
        short = [x - (_CONFIRMED + _RARE * p.rarity[i]) for i, x in zip(keys, t, strict=True)]
        if min(short) > 0.0:
            break
        worst = keys[int(np.argmin(short))]
        rest = [i for i in keys if i != worst]
        trials = [[*rest, o] for o in simpler_items(p, worst)]
        keys = min((t for t in trials if np.isfinite(p.score(t))), key=p.score, default=rest)
        keys = enforce_bounds(p, retune(p, keys))
    return keys


def _split_hints(p: Problem, keys: Sequence[int]) -> tuple[list[int], list[int]]:
    """
    An effect that is no larger than the unexplained structure may be a part of that misfit.

    :return: members that stand out, and hints
    """
    keys, hints = list(keys), []
    while keys:
        found, grams = p.solve(keys), p.grams
        rss = np.maximum([found.weights @ g @ found.weights for g in grams.by_joint], 1e-12)
        share = np.sqrt(rss / grams.n_effective) * grams.scale / (p.force * grams.gain)
        left = share * np.sqrt(np.clip(predictable(p, keys), 0.0, 1.0))
        ratio = []
        for i in keys:
            # Friction, which every joint has, may be smaller than rare effects.
            least = _OUTSTANDING * (1.0 + min(p.rarity[i], _RAREST)) / (1.0 + _RAREST)
            own = p.force_of(i, found) / p.force / np.maximum(left, 1e-6) / least
            ratio.append(np.inf if i in p.always else float(np.max(own)))
        if min(ratio) >= 1.0:
            break
        hints.append(keys.pop(int(np.argmin(ratio))))
    return keys, hints
