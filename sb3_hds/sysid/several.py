"""Several causes at once: a set that equation errors propose, judged by simulation."""

from collections.abc import Sequence

import numpy as np
from scipy import stats

from sb3_hds.sysid.comparison import Comparison, confirm
from sb3_hds.sysid.equation.selection import Member
from sb3_hds.sysid.evidence import Point
from sb3_hds.sysid.hypotheses import Candidate, encoders
from sb3_hds.sysid.screening import Screened
from sb3_hds.sysid.search import LEAST_GAIN, Base, Half, Search, Tried, as_good, passes
from sb3_hds.sysid.telling import Accepted

# Level at which each member has to be missed by held-out recordings when it is left out.
_LEVEL = 0.05
# Folds of the data on which the equation's t is based.
_FREEDOM = 7


def confirmed_set(search: Search, screened: Screened, start: Base) -> tuple[list[Accepted], Base]:
    """
    :param screened: the set, with the sizes that it has in the equation of motion
    :param start: what is believed without any cause
    :return: members without which held-out recordings are predicted worse, and what is believed
        with them; none where the set as a whole does not predict better
    """
    h = search.hypotheses
    wanted = {c.key: c for c in h.candidates}
    members = {m.key: m for m in screened.members if m.key in wanted}
    theta = start.point.theta.copy()
    for name, value in screened.sizes.items():
        if name in h.names:
            i = h.names.index(name)
            theta[i] = np.clip(value, h.lower[i], h.upper[i])
    own = [i for key in members for i in h.indices(wanted[key])]
    base = search.base(theta, (*start.free, *(i for i in own if i not in start.free)))
    if not members or not passes(search.better(base.kept, start.kept)):
        return [], start
    verdicts = {}
    while members:
        lost = {key: _without(search, wanted[key], base) for key in members}
        verdicts = {
            key: _at_own_joint(search.confirm, wanted[key], base.kept, without.kept)
            for key, without in lost.items()
        }
        weakest = max(verdicts, key=lambda key: (verdicts[key].p_value, -verdicts[key].gain))
        weak = [k for k, v in verdicts.items() if v.p_value >= _LEVEL or v.gain < LEAST_GAIN]
        if not weak:
            break
        worst = weakest if weakest in weak else weak[0]
        members.pop(worst)
        base = lost[worst]
    p, every = screened.problem, [m.item for m in screened.members]
    carried = dict(zip(every, map(float, p.carried(every)), strict=True))
    found = [
        _accepted(search, wanted[key], member, members, verdicts[key], base)._replace(
            share=carried[member.item]
        )
        for key, member in members.items()
    ]
    return found, base


def _without(search: Search, candidate: Candidate, base: Base) -> Base:
    return search.without(candidate, base)


def _accepted(
    search: Search,
    candidate: Candidate,
    member: Member,
    members: dict[str, Member],
    verdict: Comparison,
    base: Base,
) -> Accepted:
    known = {c.key: c for c in search.hypotheses.candidates}
    others = [known[k] for k in member.others if k in known and k not in members]
    rest = _without(search, candidate, base)
    tried = search.finished(others, rest) if others else []
    equal = [t.candidate.key for t in tried if as_good(search.better(base.kept, t.kept))]
    chance = float(stats.t.sf(member.t, _FREEDOM)) * len(known)
    same = Tried(candidate, base.point, base.kept, member.gain)
    return Accepted(same, verdict, tuple(equal), min(chance, 1.0))


def _at_own_joint(half: Half, candidate: Candidate, new: Point, old: Point) -> Comparison:
    """Held-out errors of the channels of the joint where a cause acts, or of all."""
    channels = own_channels(half, candidate)
    return confirm(_errors(half, new, channels), _errors(half, old, channels), half.unit)


def own_channels(half: Half, candidate: Candidate) -> Sequence[int]:
    """:return: indices of the channels that tell most of a candidate"""
    twin = half.evidence.hypotheses.believed
    every = range(len(twin.channels))
    if candidate.slot not in ("joint", "actuator") or candidate.index < 0:
        return every
    if candidate.slot == "actuator" and len(twin.actuators) != len(twin.joints):
        return every
    encoder = encoders(twin).get(candidate.index)
    return every if encoder is None else encoder.channels


def _errors(half: Half, point: Point, channels: Sequence[int]) -> np.ndarray:
    noise = half.evidence.noise[list(channels)]
    errors = np.mean((point.raw[..., list(channels)] / noise) ** 2, (1, 2))
    floor = float(np.mean((half.irrelevant[list(channels)] / noise) ** 2))
    return np.nan_to_num(errors, nan=1e8, posinf=1e8) + floor
