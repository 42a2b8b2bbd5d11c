"""Screening by equation errors: which sets of causes, and which single ones, to simulate."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from sb3_hds.core import AnalyticTwin, Effect, Twin
from sb3_hds.core.twin import plant_of
from sb3_hds.sysid.equation.assembly import assemble, normal_problem, refuted_by_kinematics
from sb3_hds.sysid.equation.held_out_folds import enforce_bounds, predictable, retune, simpler_items
from sb3_hds.sysid.equation.members import (
    ByVelocity,
    FrictionCurve,
    Member,
    by_velocity,
    friction_curves,
    members,
)
from sb3_hds.sysid.equation.problem import Problem
from sb3_hds.sysid.equation.regressors import GAINS, LATE
from sb3_hds.sysid.equation.selection import propose
from sb3_hds.sysid.estimation.candidates import PARAMETER, Candidate
from sb3_hds.sysid.estimation.hypotheses import Hypotheses
from sb3_hds.sysid.estimation.parameters import Belief
from sb3_hds.sysid.motion.motion import Motion

# Single candidates that are simulated besides the set and its equivalents: in all, and for each
# joint.
_SINGLES, _OF_A_JOINT = 10, 5
#: single candidates that are simulated beside a small set of causes, and the causes of one
LIKELIEST, FEW = 3, 3
# Detection limit: share of the nominal model's residual that a cause explains, and by how much it
# exceeds its price, in -2 log likelihood: the least gain and the least information gain by which
# simulations confirm a cause.
_EXPLAINED, _MARGIN = 0.05, 6.0
# Share of a joint's force that a typical size changes.
_TYPICAL = 0.05
# On machines of more joints, candidates without a column are simulated only at joints whose
# residual is predictable by this share; where there are several causes, only these are simulated.
SMALL_MACHINE, _LEFT = 2, 0.2


class Estimates(NamedTuple):
    """
    Sizes of one cause by the equation of motion.

    :param sizes: estimate and ends of the interval, by full name
    :param doubts: half the width of the interval that is due to model uncertainty, by full name
    """

    sizes: dict[str, tuple[float, float, float]]
    doubts: dict[str, float]


class Screened(NamedTuple):
    """
    :param hypotheses: all candidates
    :param problem: their columns
    :param motion: of the joints
    :param members: of the best set by information criterion
    :param hints: keys of effects that are small beside the unexplained residual
    :param keys: of the candidates to simulate
    :param nameless_at: joints at which flexible forces are tried
    :param by_velocity: the equation of each joint, averaged over intervals of similar velocity
    """

    hypotheses: Hypotheses
    problem: Problem
    motion: Motion
    members: tuple[Member, ...]
    hints: tuple[str, ...]
    keys: frozenset[str]
    nameless_at: tuple[str, ...]
    by_velocity: tuple[ByVelocity, ...]

    def among(self, keys: Collection[str]) -> "Screened":
        """:return: the same with some of the members, solved again without the others"""
        return self._with_items([m.item for m in self.members if m.key in keys])

    def without(self, keys: Collection[str]) -> "Screened":
        """:return: the same with simpler members of their families in place of these, if any"""
        rest = [m.item for m in self.members if m.key not in keys]
        left_out = [m.item for m in self.members if m.key in keys]
        return self._with_items(
            rest + [o for i in left_out for o in simpler_items(self.problem, i)[:1]]
        )

    def with_other(self, key: str, other: str) -> "Screened":
        """:return: the same with another candidate in place of a member"""
        keys = [other if m.key == key else m.key for m in self.members]
        return self._with_items(self._items_of(keys))

    def _with_items(self, items: Sequence[int]) -> "Screened":
        p = self.problem
        found = enforce_bounds(p, retune(p, [*p.always, *items]))
        return self._replace(members=_members_of(self.hypotheses, p, found))

    def sizes_of(self, keys: Iterable[str]) -> dict[str, float]:
        """:return: by full name, values of the parameters of these causes, solved without others"""
        p, order = self.problem, [m.key for m in self.members]
        keys = sorted(keys, key=lambda key: (order.index(key) if key in order else len(order), key))
        items = retune(p, [*p.always, *self._items_of(keys)])
        value, found = p.solve(items).value, {}
        for item in (p.items[i] for i in items if i not in p.always):
            if set(item.free) <= value.keys():
                effect = self.hypotheses.effect_of(item.candidate)
                sizes = item.sizes(effect, [value[c] for c in item.free])
                found |= self._by_full_name(item.candidate, sizes)
        return found

    def intervals_of(self, member: Member) -> dict[str, tuple[float, float, float]]:
        """:return: estimate and ends of the interval by full name"""
        candidate = self.problem.items[member.item].candidate
        value, low, high = (
            self._by_full_name(candidate, x) for x in (member.sizes, member.low, member.high)
        )
        return {n: (value[n], min(low[n], high[n]), max(low[n], high[n])) for n in value}

    def friction_curves(self, keys: Collection[str]) -> tuple[FrictionCurve, ...]:
        """:return: friction against velocity at each joint where causes with these keys have it"""
        p = self.problem
        return friction_curves(p, self.by_velocity, retune(p, [*p.always, *self._items_of(keys)]))

    def estimates(self, keys: Collection[str]) -> dict[str, Estimates]:
        """:return: by key of these causes; none where one of them has no column"""
        items = self._items_of(keys)
        if len(items) < len(keys):
            return {}
        told = _members_of(self.hypotheses, self.problem, retune(self.problem, items))
        return {m.key: Estimates(self.intervals_of(m), self.doubts_of(m)) for m in told}

    def _items_of(self, keys: Iterable[str]) -> list[int]:
        at: dict[str, int] = {}
        for i, item in enumerate(self.problem.items):
            at.setdefault(item.key, i)
        at |= {m.key: m.item for m in self.members}
        return [at[key] for key in keys if key in at]

    def doubts_of(self, member: Member) -> dict[str, float]:
        """:return: by full name, as in :class:`Estimates`"""
        names = self.problem.items[member.item].candidate.full_names
        return {names[short]: doubt for short, doubt in member.doubt.items()}

    def _by_full_name(self, candidate: Candidate, sizes: Mapping[str, float]) -> dict[str, float]:
        if candidate.slot == PARAMETER:
            (name,) = sizes
            return {name: self.hypotheses.nominal.values[name] + sizes[name]}
        return {candidate.full_names[short]: float(value) for short, value in sizes.items()}

    @property
    def detectable(self) -> dict[str, dict[str, float]]:
        """
        By candidate and short name, the smallest size that would explain a twentieth of what the
        nominal model leaves, and exceed its price.
        """
        p = self.problem
        start = p.solve(list(p.always))
        cross = p.total[:, start.free]
        seen = np.diag(p.total) - np.einsum("ij,jk,ik->i", cross, start.inverse, cross)
        found: dict[str, dict[str, float]] = {}
        for i, item in enumerate(p.items):
            if item.key in found or i in p.always:
                continue
            needed = max(_EXPLAINED * start.rss, p.price(i) + _MARGIN)
            sizes = found.setdefault(item.key, {})
            for column, name in zip(item.columns, item.names, strict=True):
                size = np.sqrt(needed / seen[column]) if seen[column] > 0.0 else np.inf
                if item.rule == "chain":
                    low, high = (setting[name] for setting in item.settings)
                    size = abs(high - low) * size
                    if i in p.least:
                        size = max(size, low + p.least[i] * (high - low))
                sizes[name] = float(size)
        return found

    @property
    def stops_within(self) -> np.ndarray:
        """Time in which the dry friction of the set stops each joint [s]."""
        p, dof = self.problem, len(self.motion.speed)
        dry = [m.item for m in self.members if p.family(m.item)[0] == "dry"]
        solution = p.solve([*p.always, *(m.item for m in self.members)])
        force = sum((p.force_of(i, solution) for i in dry), np.zeros(dof))
        inertia = np.median(1.0 / np.diagonal(np.linalg.inv(p.mass), axis1=1, axis2=2), axis=0)
        return np.divide(
            self.motion.speed * inertia, force, out=np.full(dof, np.inf), where=force > 0.0
        )

    @property
    def scales(self) -> dict[str, float]:
        """By full name, the change of a parameter that changes a joint's force by a twentieth."""
        p, found = self.problem, {}
        for item in p.items:
            if item.rule != "linear":
                continue
            for column, name in zip(item.columns, item.names, strict=True):
                share = float(np.max(p.shares[:, column] / p.force))
                if share > 0.0:
                    found.setdefault(item.candidate.full_names[name], _TYPICAL / share)
        return found


def screen(
    twin: Twin,
    moved: Motion,
    effects: Sequence[type[Effect]],
    calibrate: Sequence[str] | Mapping[str, Belief],
) -> Screened | None:
    """
    :param twin: nominal model
    :param moved: joints, as measured
    :return: None where there is no equation of motion, or nothing moves
    """
    if not isinstance(plant_of(twin), AnalyticTwin) or not moved.moves.any():
        return None
    coarse = moved.twin(twin)
    hypotheses = Hypotheses.about(
        coarse, effects, calibrate, period=moved.typical_period, speeds=tuple(moved.speed)
    )
    made = assemble(hypotheses, moved)
    if not made.items:
        return None
    p = normal_problem(hypotheses, made)
    chosen, hinted = propose(p)
    set_of = _members_of(hypotheses, p, [i for i in chosen if i not in p.always])
    hints = tuple(p.items[i].key for i in hinted)
    small = len(coarse.joints) <= SMALL_MACHINE
    where = [joint.name for joint in coarse.joints]
    if not small:
        left = predictable(p, chosen) > _LEFT
        where = [n for n, much in zip(where, left, strict=True) if much and len(set_of) < 2]
    keys = {m.key for m in set_of}
    keys |= {p.items[o].key for m in set_of for o in simpler_items(p, m.item)}
    keys |= {key for m in set_of for key in p.hardly_told_from(m.item)}
    if len(set_of) <= FEW:
        keys |= {*list(dict.fromkeys(p.items[i].key for i in p.ranking(p.always)))[:LIKELIEST]}
    if small or len(set_of) < 2:
        keys |= {*(k for m in set_of for k in m.others), *_singles(p), *hints}
        keys |= _without_column(hypotheses, p, moved, where)
        keys |= _of_one_scale(p, keys, [m.key for m in set_of]) | _late_at_the_same_places(p, keys)
    return Screened(
        hypotheses=hypotheses,
        problem=p,
        motion=moved,
        members=set_of,
        hints=hints,
        keys=frozenset(keys),
        nameless_at=tuple(where),
        by_velocity=tuple(by_velocity(made, j) for j in range(p.dof)),
    )


def _members_of(h: Hypotheses, p: Problem, items: Sequence[int]) -> tuple[Member, ...]:
    effects = {c.key: h.effect_of(c) for c in h.candidates}
    found = members(p, [*p.always, *items], effects)
    return tuple(m for m in found if m.item not in p.always)


def _of_one_scale(p: Problem, keys: Collection[str], members: Collection[str]) -> set[str]:
    """
    :param keys: of the candidates to simulate
    :param members: of these, those of the set
    :return: masses where a gain or the scale of a sensor is tried, and gains where one of these or
        a mass is named: the equation is homogeneous in all of them together
    """
    masses = {i.key for i in p.items if i.candidate.slot == PARAMETER and i.key in p.slopes}
    gains = {i.key for i in p.items if i.candidate.name in GAINS}
    scales = {i.key for i in p.items if i.candidate.name == "sensor_scale"}
    found = masses if {*keys} & (gains | scales) else set()
    return found | (gains if {*members} & (masses | scales) else set())


def _late_at_the_same_places(p: Problem, keys: Collection[str]) -> set[str]:
    """Where commands may be late, whatever makes them so."""
    late = [item.candidate for item in p.items if item.candidate.name in LATE]
    places = {candidate.place for candidate in late if candidate.key in keys}
    return {candidate.key for candidate in late if candidate.place in places}


def _singles(p: Problem) -> set[str]:
    """Keys of the candidates that explain most on their own, of all and at each joint."""

    def best(items: Sequence[int], most: int) -> list[str]:
        return list(dict.fromkeys(p.items[i].key for i in p.ranking(p.always, items)))[:most]

    every = range(len(p.items))
    found = {*best(every, _SINGLES)}
    for joint in range(p.dof):
        found |= {*best([i for i in every if p.place(i) == ("joint", joint)], _OF_A_JOINT)}
    return found


def _without_column(h: Hypotheses, p: Problem, moved: Motion, where: Sequence[str]) -> set[str]:
    """Keys of candidates without a column, unless the kinematics refute them."""
    there = {item.key for item in p.items}
    refuted = refuted_by_kinematics(h.nominal, moved)
    found = set()
    for candidate in h.candidates:
        if candidate.slot == "joint":
            asked = candidate.place in where
        else:
            asked = candidate.slot != PARAMETER and len(moved.speed) <= SMALL_MACHINE
        if asked and candidate.key not in there | refuted:
            found.add(candidate.key)
    return found
