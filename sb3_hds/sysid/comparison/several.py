"""Several causes at once: a set that equation errors propose, judged by simulation."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import scipy

from sb3_hds.effects import NAMELESS
from sb3_hds.sysid.comparison.halves import Accepted, Base, Half, Tried
from sb3_hds.sysid.comparison.held_out import Comparison, as_good, passes, t_or_rank_test
from sb3_hds.sysid.comparison.search import Place, Search
from sb3_hds.sysid.equation.held_out_folds import simpler_items
from sb3_hds.sysid.equation.members import Member
from sb3_hds.sysid.equation.plausibility import rarity_of
from sb3_hds.sysid.equation.regressors import LATE
from sb3_hds.sysid.equation.screening import FEW, LIKELIEST, Screened
from sb3_hds.sysid.equation.weak_form import FOLDS
from sb3_hds.sysid.estimation.candidates import Candidate
from sb3_hds.sysid.estimation.evidence import Point, in_threads
from sb3_hds.sysid.estimation.shooting import evenly
from sb3_hds.sysid.motion.joints import encoders

# Level at which each member has to be missed by held-out recordings when it is left out.
_LEVEL = 0.05
# Least gain of a member that the equation of motion has confirmed already: less is negligible.
_LEAST = 0.01
# Members beyond which a set counts as large: their sizes are those in the equation of motion, and
# each of them, confirmed there on held-out data, only must not surely make predictions worse.
_MANY = 6
# Steps of a fit of start states that begins where they were with one member more.
_ROUGH_STEPS = 2
# Windows of a large machine on which each member of its set is left out once.
_SOME_WINDOWS = 8


def proposed_set(search: Search, screened: Screened, start: Base) -> Base:
    """
    :return: the model with the whole set, with its sizes in the equation of motion; of a
        small set, refitted
    """
    h, members = search.hypotheses, _members(search, screened)
    theta = _with_sizes(search, start.point.theta, screened.sizes_of(members))
    own = [i for candidate, _ in members.values() for i in h.indices(candidate)]
    refitted = [] if len(members) > _MANY else [i for i in own if i not in start.free]
    return search.base(theta, (*start.free, *refitted))


def confirmed_set(
    search: Search, screened: Screened, start: Base, base: Base
) -> tuple[list[Accepted], Base]:
    """
    :param start: the model without any cause
    :param base: with the whole set
    :return: members without which held-out recordings are predicted worse, and the model with them;
        none where the set as a whole does not predict better
    """
    members = _members(search, screened)
    if not members or not passes(search.ranking.compare(base.held_out, start.held_out)):
        return [], start
    many = len(members) > _MANY
    judged = (_judge_many if many else _judge_few)(search, screened, start, base)
    screened, base, members = judged.screened, judged.base, _members(search, judged.screened)
    p, every = screened.problem, [m.item for m in screened.members]
    carried = dict(zip(every, map(float, p.force_shares(every)), strict=True))
    found = [
        _accepted(search, *members[key], members, judged, key)._replace(
            share=carried[members[key][1].item],
            sizes=screened.intervals_of(members[key][1]),
            of_equation=many,
            doubts=screened.doubts_of(members[key][1]),
        )
        for key in members
        if key in judged.verdicts
    ]
    return found, base


def one_does_as_well(
    search: Search, screened: Screened, found: Sequence[Accepted], start: Base, base: Base
) -> bool:
    """
    :param found: a set of causes
    :param start: the model without any cause
    :param base: with the set
    :return: whether a single cause, of those without a column in the equation of motion, such as
        elasticity, or the likeliest by it, does as well as a small set, which may be its imitation;
        or whether a flexible force that somebody asked for does better than any set
    """
    candidates, compare = search.hypotheses.candidates, search.ranking.compare
    flexible = [c for c in candidates if c.name in {kind.name for kind in NAMELESS}]
    if any(
        t.point.cost < base.point.cost and not as_good(compare(t.held_out, base.held_out))
        for t in search.fit(flexible, start)
    ):
        return True
    if len(found) > FEW:
        return False
    p, own = screened.problem, {one.tried.candidate.key for one in found}
    likely = list(dict.fromkeys(p.items[i].key for i in p.ranking(p.always)))[:LIKELIEST]
    unlikely = {item.key for item in p.items} - {*likely} | own
    most = sum(len(one.tried.candidate.parameters) for one in found)
    # With as many parameters, the equation has preferred the set.
    others = [
        c.key
        for c in candidates
        if c.key in unlikely or len(c.parameters) > most - (c.key in likely)
    ]
    if len(others) == len(candidates):
        return False
    return any(
        t.point.cost < base.point.cost and as_good(compare(base.held_out, t.held_out))
        for t in search.finalists(start, others)
    )


class _Judged(NamedTuple):
    """
    A set that simulation has judged.

    :param screened: with the members that are left
    :param base: the model with them
    :param verdicts: by key of a member, the set beside the one without it
    :param rivals: by key of a member of a small set, what was fitted in its place
    """

    screened: Screened
    base: Base
    verdicts: Mapping[str, Comparison]
    rivals: Mapping[str, Sequence[Tried]]


def _judge_few(search: Search, screened: Screened, start: Base, base: Base) -> _Judged:
    """
    Leave out members that held-out recordings do not need, one after the other, and exchange those
    in whose place another candidate is preferred.
    """
    exchanged: dict[str, str] = {}
    members = _members(search, screened)
    while True:
        lost = _without_each(search, base, members)
        verdicts = {
            key: _at_own_joint(search.confirm, members[key][0], base.held_out, rest.held_out)
            for key, rest in lost.items()
        }
        weak = [k for k, v in verdicts.items() if v.p_value >= _LEVEL or v.gain < _LEAST]
        if weak:
            worst = max(weak, key=lambda key: (verdicts[key].p_value, -verdicts[key].gain))
            members.pop(worst)
            base = lost[worst]
            continue
        if len(members) < len(screened.members):
            screened = screened.among(members)
            members = _members(search, screened)
        rivals = {
            key: _rivals(search, screened, start, base, key, without, exchanged)
            for key, without in lost.items()
            if key in members
        }
        better = [
            (key, t)
            for key, fitted in rivals.items()
            for t in fitted
            if t.candidate.key not in {*exchanged, *exchanged.values()}
            and _preferred(search, t, members[key][0], base)
        ]
        judged = _Judged(screened, base, verdicts, rivals)
        if not better:
            return judged
        key, best = max(better, key=lambda pair: pair[1].criterion)
        exchanged[best.candidate.key] = key
        screened = screened.with_other(key, best.candidate.key)
        if best.candidate.key not in (m.key for m in screened.members):
            return judged
        members = _members(search, screened)
        base = search.believing(best, lost[key])


def _preferred(search: Search, rival: Tried, member: Candidate, base: Base) -> bool:
    """
    :param base: the model with the member
    :return: whether a rival without more parameters predicts surely better, or as well with better
        prior odds
    """
    compare, twin = search.ranking.compare, search.hypotheses.nominal
    if len(rival.candidate.parameters) > len(member.parameters):
        return False
    if not as_good(compare(rival.held_out, base.held_out)):
        return True
    likelier = rarity_of(rival.candidate, twin) < rarity_of(member, twin)
    return likelier and as_good(compare(base.held_out, rival.held_out))


def _judge_many(search: Search, screened: Screened, start: Base, base: Base) -> _Judged:
    """Replace members that surely make held-out predictions worse by simpler ones, or none."""
    screened, base = _with_likelier(search, screened, start, base)
    members = _members(search, screened)
    verdicts = _each_left_out(search, screened, start, base, members, list(members))
    harmful = {key for key, v in verdicts.items() if v.p_value >= 1.0 - _LEVEL}
    if harmful:
        screened = screened.without(harmful)
        members = _members(search, screened)
        theta = _sizes_with(search, screened, start, members.keys())
        base = search.base(theta, base.free, near=base)
        new = [key for key in members if key not in verdicts]
        verdicts |= _each_left_out(search, screened, start, base, members, new)
    return _Judged(screened, base, verdicts, {})


def _with_likelier(
    search: Search, screened: Screened, start: Base, base: Base
) -> tuple[Screened, Base]:
    """
    Fit dry friction in place of each dead zone. Whether commands are late by a lag or a delay, the
    equation has to say of a large set: to simulate both takes longer than all the rest.

    :return: the set, with what is preferred
    """
    for member in screened.members:
        members = _members(search, screened)
        others = screened.problem.hardly_told_from(member.item)
        if not others or member.key not in members:
            continue
        candidate, _ = members[member.key]
        if candidate.name in LATE:
            continue
        lost = search.without(base, candidate, near=base, rival=base)
        tried = _in_place_of(search, screened, start, base, member.key, lost, others)
        better = [t for t in tried if _preferred(search, t, candidate, base)]
        if better:
            best = max(better, key=lambda t: t.criterion)
            screened = screened.with_other(member.key, best.candidate.key)
            base = search.believing(best, lost)
    return screened, base


def _rivals(
    search: Search,
    screened: Screened,
    start: Base,
    base: Base,
    key: str,
    lost: Base,
    exchanged: Mapping[str, str],
) -> list[Tried]:
    """
    :param lost: the model without the member
    :param exchanged: by key of a member, the one in whose place it is
    :return: candidates in its place, fitted from their sizes in the equation of motion: those that
        predict as well there, simpler ones of its family, and those that differ from it by what the
        equation hardly shows
    """
    members = _members(search, screened)
    _, member = members[key]
    simpler = simpler_items(screened.problem, member.item)
    others = dict.fromkeys([*member.others, *(screened.problem.items[i].key for i in simpler)])
    if key in exchanged:
        others[exchanged[key]] = None
    others |= dict.fromkeys(screened.problem.hardly_told_from(member.item))
    return _in_place_of(search, screened, start, base, key, lost, others)


def _in_place_of(
    search: Search,
    screened: Screened,
    start: Base,
    base: Base,
    key: str,
    lost: Base,
    others: Iterable[str],
) -> list[Tried]:
    """:return: other candidates in the place of a member, fitted"""
    members = _members(search, screened)
    candidate, _ = members[key]
    known = {c.key: c for c in search.hypotheses.candidates if c.key not in members}
    rivals = [known[other] for other in others if other in known]
    rest = [k for k in members if k != key]
    places = {}
    for rival in rivals:
        starts = [_sizes_with(search, screened, start, [*rest, rival.key])]
        if {candidate.name, rival.name} <= {*LATE}:
            starts.append(_as_late(search, base.point.theta, candidate, rival))
        cost_at = lambda theta: search.select.evidence.nearest(theta, [base.point.offsets])[1]  # noqa: E731
        places[rival.key] = Place(min(starts, key=cost_at), base.point.offsets, lost.free)
    return search.fit(rivals, lost, places) if rivals else []


def _as_late(search: Search, theta: np.ndarray, one: Candidate, other: Candidate) -> np.ndarray:
    """A delay and a lag by the same time are the same to first order."""
    h, theta = search.hypotheses, theta.copy()
    (here,), (there,) = h.indices(one), h.indices(other)
    late = np.clip(theta[here], h.lower[there], h.upper[there])
    theta[here], theta[there] = h.null[here], late
    return theta


def _without_each(
    search: Search, base: Base, members: Mapping[str, tuple[Candidate, Member]]
) -> dict[str, Base]:
    """:return: the model without each of the members of a small set"""

    def lost(candidate: Candidate) -> Base:
        return search.without(base, candidate, near=base, rival=base)

    found = search.bar.over(in_threads(lost, [c for c, _ in members.values()]), len(members))
    return dict(zip(members, found, strict=True))


def _members(search: Search, screened: Screened) -> dict[str, tuple[Candidate, Member]]:
    known = {c.key: c for c in search.hypotheses.candidates}
    return {m.key: (known[m.key], m) for m in screened.members if m.key in known}


def _each_left_out(
    search: Search,
    screened: Screened,
    start: Base,
    base: Base,
    members: Mapping[str, tuple[Candidate, Member]],
    keys: Sequence[str],
) -> dict[str, Comparison]:
    """:return: of some members of a large set, held-out errors with each beside those without it"""
    half, some = search.confirm, evenly(search.confirm.evidence.shots.n, _SOME_WINDOWS)
    shots = half.evidence.shots.rows(some)
    half = half._replace(evidence=half.evidence.on(shots), cluster=half.cluster[some])
    held_out = base.held_out._replace(
        offsets=base.held_out.offsets[some], residual=base.held_out.residual[some]
    )

    def left_out(key: str) -> Comparison:
        theta = _sizes_with(search, screened, start, members.keys() - {key})
        rest = half.evidence.fit(theta, (), held_out.offsets, _ROUGH_STEPS)
        return _at_own_joint(half, members[key][0], held_out, rest)

    found: list[Comparison] = list(search.bar.over(in_threads(left_out, keys), len(keys)))
    return dict(zip(keys, found, strict=True))


def _sizes_with(search: Search, screened: Screened, start: Base, keys: Iterable[str]) -> np.ndarray:
    """The model with these members only, with their sizes in the equation of motion."""
    return _with_sizes(search, start.point.theta, screened.sizes_of(keys))


def _with_sizes(search: Search, theta: np.ndarray, sizes: Mapping[str, float]) -> np.ndarray:
    h, theta = search.hypotheses, theta.copy()
    for name, value in sizes.items():
        if name in h.names:
            i = h.names.index(name)
            theta[i] = np.clip(value, h.lower[i], h.upper[i])
    return theta


def _accepted(
    search: Search,
    candidate: Candidate,
    member: Member,
    members: Collection[str],
    judged: _Judged,
    key: str,
) -> Accepted:
    tried, base = judged.rivals.get(key, ()), judged.base
    worse = {
        t.candidate.key
        for t in tried
        if not as_good(search.ranking.compare(base.held_out, t.held_out))
    }
    # What is not simulated counts as equivalent where the equation says so.
    others = dict.fromkeys([*member.others, *(t.candidate.key for t in tried)])
    equal = [k for k in others if k not in worse and k not in members]
    # The equation has chosen among all candidates, not only among those that are simulated.
    n_candidates = len(judged.screened.hypotheses.candidates)
    p_value = float(scipy.stats.t.sf(member.t, FOLDS - 1)) * n_candidates
    return Accepted(
        Tried(candidate, base.point, base.held_out, member.gain),
        judged.verdicts[key],
        tuple(equal),
        min(p_value, 1.0),
        rivals=tuple(t for t in tried if t.candidate.key in equal),
    )


def _at_own_joint(half: Half, candidate: Candidate, new: Point, old: Point) -> Comparison:
    """Held-out errors of the channels of the joint where a cause acts, or of all."""
    channels = own_channels(half, candidate)
    return t_or_rank_test(half.errors(new, channels), half.errors(old, channels), half.cluster)


def own_channels(half: Half, candidate: Candidate) -> Sequence[int]:
    """:return: indices of the channels that tell most of a candidate"""
    twin = half.evidence.hypotheses.nominal
    every = range(len(twin.channels))
    if candidate.slot not in ("joint", "actuator") or candidate.index < 0:
        return every
    if candidate.slot == "actuator" and len(twin.actuators) != len(twin.joints):
        return every
    encoder = encoders(twin).get(candidate.index)
    return every if encoder is None else encoder.channels
