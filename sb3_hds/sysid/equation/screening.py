"""Screening by equation errors: which sets of causes, and which single ones, to simulate."""

from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from sb3_hds.core import ActionEffect, AnalyticTwin, Effect, Twin
from sb3_hds.core.twin import plant_of
from sb3_hds.sysid.equation.columns import equation, refuted_by_kinematics
from sb3_hds.sysid.equation.confirmation import (
    Left,
    admitted,
    retuned,
    simpler,
    what_is_left,
)
from sb3_hds.sysid.equation.friction import (
    ByVelocity,
    FrictionCurve,
    by_velocity,
    friction_curves,
)
from sb3_hds.sysid.equation.members import Member, members
from sb3_hds.sysid.equation.motion import Motion
from sb3_hds.sysid.equation.plausibility import plausibility, rarity_of
from sb3_hds.sysid.equation.problem import Problem
from sb3_hds.sysid.equation.regression import Equation, Item
from sb3_hds.sysid.equation.selection import LATE, propose
from sb3_hds.sysid.equation.weak_form import Grams, grams, weak_rows
from sb3_hds.sysid.estimation.candidates import PARAMETER, Candidate
from sb3_hds.sysid.estimation.hypotheses import Hypotheses
from sb3_hds.sysid.estimation.parameters import Belief

# Single candidates that are simulated, besides those of the set and what may stand for them, and at
# least of each joint.
_SINGLES, _OF_A_JOINT = 10, 5
# Share of what the nominal model leaves that a cause explains at least, and by how much it has to
# exceed its price, in -2 log likelihood.
_TOLD, _SURELY = 0.05, 6.0
# Share of a joint's force that a typical size changes.
_TYPICAL = 0.05
# Machines of more joints are not asked about what has no column at every joint, but where much is
# left that can be predicted; where they have several causes, only these are simulated.
SMALL_MACHINE, _LEFT = 2, 0.2
# Share of an interval below which a command is not late: how the motion goes on between two samples
# matters as much.
_LEAST_LATE = 0.03
# Ranges of the motion by which a spring may rest outside of it: farther away, it is an offset.
_BEYOND = 0.5
# Least noise of a velocity, in shares of the fastest joint's speed.
_QUIETEST = 1e-6


class Estimates(NamedTuple):
    """
    Sizes of one cause by the equation of motion.

    :param sizes: estimate and ends of the interval, by full name
    :param doubts: of that interval, half the width that comes from not knowing whether there is one
        cause more
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
    :param left: what the set leaves at each joint
    :param keys: of the candidates that are worth a simulation
    :param nameless_at: joints at which flexible forces are tried
    :param by_velocity: the equation of each joint, averaged over intervals of similar velocity
    """

    hypotheses: Hypotheses
    problem: Problem
    motion: Motion
    members: tuple[Member, ...]
    hints: tuple[str, ...]
    left: tuple[Left, ...]
    keys: frozenset[str]
    nameless_at: tuple[str, ...]
    by_velocity: tuple[ByVelocity, ...]

    def among(self, keys: Collection[str]) -> "Screened":
        """:return: the same with some members, solved and judged anew without the others"""
        p, rest = self.problem, [m.item for m in self.members if m.key in keys]
        found = admitted(p, retuned(p, [*p.always, *rest]))
        return self._replace(members=_members_of(self.hypotheses, p, found))

    def without(self, keys: Collection[str]) -> "Screened":
        """:return: the same with simpler members of their families instead of some, or none"""
        p = self.problem
        rest = [m.item for m in self.members if m.key not in keys]
        rest += [o for m in self.members if m.key in keys for o in simpler(p, m.item)[:1]]
        found = admitted(p, retuned(p, [*p.always, *rest]))
        return self._replace(members=_members_of(self.hypotheses, p, found))

    def sizes_of(self, keys: Collection[str]) -> dict[str, float]:
        """:return: values of the parameters of some members, by full name, solved without others"""
        p, rest = self.problem, [m.item for m in self.members if m.key in keys]
        items = retuned(p, [*p.always, *rest])
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
        parts = [self._by_full_name(candidate, x) for x in (member.sizes, member.low, member.high)]
        value, low, high = parts
        return {n: (value[n], min(low[n], high[n]), max(low[n], high[n])) for n in value}

    def friction_curves(self, keys: Collection[str]) -> tuple[FrictionCurve, ...]:
        """:return: friction against velocity at each joint where causes with these keys have it"""
        p = self.problem
        return friction_curves(p, self.by_velocity, retuned(p, [*p.always, *self._items_of(keys)]))

    def estimates(self, keys: Collection[str]) -> dict[str, Estimates]:
        """:return: by key of these causes; none where one of them has no column"""
        items = self._items_of(keys)
        if len(items) < len(keys):
            return {}
        told = _members_of(self.hypotheses, self.problem, retuned(self.problem, items))
        return {m.key: Estimates(self.intervals_of(m), self.doubts_of(m)) for m in told}

    def _items_of(self, keys: Collection[str]) -> list[int]:
        at: dict[str, int] = {}
        for i, item in enumerate(self.problem.items):
            at.setdefault(item.key, i)
        at |= {m.key: m.item for m in self.members}
        return [at[key] for key in keys if key in at]

    def doubts_of(self, member: Member) -> dict[str, float]:
        """:return: by full name, as in :class:`Estimates`"""
        candidate = self.problem.items[member.item].candidate
        names = {name.rpartition(".")[2]: name for name in candidate.parameters}
        return {names[short]: doubt for short, doubt in member.doubt.items()}

    def _by_full_name(self, candidate: Candidate, sizes: Mapping[str, float]) -> dict[str, float]:
        if candidate.slot == "parameter":
            (name,) = sizes
            return {name: self.hypotheses.believed.values[name] + sizes[name]}
        shorts = {name.rpartition(".")[2]: name for name in candidate.parameters}
        return {shorts[short]: float(value) for short, value in sizes.items()}

    @property
    def detectable(self) -> dict[str, dict[str, float]]:
        """
        By candidate and short name, the smallest size that would explain a twentieth of what the
        nominal model leaves, and be worth its price.
        """
        p = self.problem
        start = p.solve(list(p.always))
        cross = p.total[:, start.free]
        seen = np.diag(p.total) - np.einsum("ij,jk,ik->i", cross, start.inverse, cross)
        found: dict[str, dict[str, float]] = {}
        for i, item in enumerate(p.items):
            if item.key in found or i in p.always:
                continue
            needed = max(_TOLD * start.rss, p.price(i) + _SURELY)
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
        """In which time the dry friction of the set stops each joint [s]."""
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
        """What changes a joint's force by a twentieth, of parameters that have a slope there."""
        p, found = self.problem, {}
        for item in p.items:
            if item.rule != "linear":
                continue
            shorts = {name.rpartition(".")[2]: name for name in item.candidate.parameters}
            for column, name in zip(item.columns, item.names, strict=True):
                share = float(np.max(p.shares[:, column] / p.force))
                full = name if item.candidate.slot == "parameter" else shorts[name]
                if share > 0.0:
                    found.setdefault(full, _TYPICAL / share)
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
    if not isinstance(plant_of(twin), AnalyticTwin):
        return None
    if not moved.moves.any():
        return None
    coarse = moved.twin(twin)
    hypotheses = Hypotheses.about(
        coarse, effects, calibrate, period=moved.typical_period, speeds=tuple(moved.speed)
    )
    made = equation(hypotheses, moved)
    if not made.items:
        return None
    p = problem(hypotheses, made, grams(made, weak_rows(made)))
    found = propose(p)
    set_of = _members_of(hypotheses, p, [i for i in found.keys if i not in p.always])
    left = what_is_left(p, found.keys)
    hints = tuple(p.items[i].key for i in found.hints)
    joints = [joint.name for joint in coarse.joints]
    small = len(joints) <= SMALL_MACHINE
    where = [
        name
        for name, x in zip(joints, left, strict=True)
        if small or (len(set_of) < 2 and x.predictable > _LEFT)
    ]
    keys = {m.key for m in set_of}
    keys |= {p.items[o].key for m in set_of for o in simpler(p, m.item)}
    if small or len(set_of) < 2:
        keys |= {*(k for m in set_of for k in m.others), *_singles(p), *hints}
        keys |= _without_column(hypotheses, p, moved, where)
        keys |= _of_one_scale(p, keys)
    return Screened(
        hypotheses=hypotheses,
        problem=p,
        motion=moved,
        members=set_of,
        hints=hints,
        left=tuple(left),
        keys=frozenset(keys),
        nameless_at=tuple(where),
        by_velocity=by_velocity(made),
    )


def _members_of(h: Hypotheses, p: Problem, items: Sequence[int]) -> tuple[Member, ...]:
    effects = {c.key: h.effect_of(c) for c in h.candidates}
    found = members(p, [*p.always, *items], effects)
    return tuple(m for m in found if m.item not in p.always)


def _of_one_scale(p: Problem, keys: Collection[str]) -> set[str]:
    """Where a gain is tried, the masses: the equation is homogeneous in both together."""
    names = {key.partition(".")[0] for key in keys}
    if not names & {"torque_gain", "directional_gain"}:
        return set()
    return {
        item.key for item in p.items if item.candidate.slot == PARAMETER and item.key in p.slopes
    }


def _singles(p: Problem) -> set[str]:
    """Keys of what explains most beside nothing, of all and at each joint."""

    def best(items: Sequence[int], most: int) -> list[str]:
        return list(dict.fromkeys(p.items[i].key for i in p.ranking(p.always, items)))[:most]

    every = range(len(p.items))
    found = {*best(every, _SINGLES)}
    for joint in range(p.dof):
        found |= {*best([i for i in every if p.place(i) == ("joint", joint)], _OF_A_JOINT)}
    return found


def _without_column(h: Hypotheses, p: Problem, moved: Motion, where: Sequence[str]) -> set[str]:
    """What equation errors cannot say anything of, unless the kinematics refute it."""
    there = {item.key for item in p.items}
    refuted = refuted_by_kinematics(h.believed, moved)
    found = set()
    for candidate in h.candidates:
        if candidate.key in there or candidate.key in refuted:
            continue
        if candidate.slot == "joint" and candidate.place not in where:
            continue
        if candidate.slot != "joint" and len(moved.speed) > SMALL_MACHINE:
            continue
        if candidate.slot == "parameter":
            continue
        found.add(candidate.key)
    return found


def problem(hypotheses: Hypotheses, equation: Equation, made: Grams) -> Problem:
    """:param made: normal equations of the equation"""
    items, n = tuple(equation.items), len(equation.columns)
    lower, upper, prior = np.full(n, -np.inf), np.full(n, np.inf), np.zeros(n + 1)
    always = []
    for number, item in enumerate(items):
        if item.candidate.slot == PARAMETER and item.candidate.index < 0:
            always.append(number)
        for c, name in zip(item.columns, item.names, strict=True):
            if item.rule == "chain":
                lower[c], upper[c] = 0.0, 1.0
            elif item.rule == "linear":
                lower[c], upper[c] = _bounds(hypotheses, item, name)
    for number in always:
        (column,), name = items[number].columns, items[number].candidate.place
        prior[column] = hypotheses.prior[hypotheses.names.index(name)] ** -2.0
    dof = equation.missing.shape[1]
    shares = np.zeros((dof, n))
    for c, column in enumerate(equation.columns):
        own = slice(None) if column.joint is None else column.joint
        shares[own, c] = np.sqrt(np.mean(column.values**2, axis=0))
    force = np.sqrt(np.mean(equation.actuator**2, axis=0))
    force = np.maximum(force, np.sqrt(np.mean(equation.load**2, axis=0))) + 1e-300
    some = np.linspace(0, len(equation.mass) - 1, min(32, len(equation.mass))).astype(int)
    total = made.by_joint.sum(0)
    return Problem(
        items=items,
        grams=made,
        lower=lower,
        upper=upper,
        prior=prior,
        force=force,
        shares=shares,
        passes=_passing(hypotheses, equation, items),
        mass=equation.mass[some],
        effective=equation.effective[some],
        noise=np.maximum(equation.motion.noise_v, _QUIETEST * equation.motion.speed.max()),
        noisy=equation.noisy,
        slopes={key: slope[some] for key, slope in equation.slopes.items()},
        drives=equation.drives,
        rests=_rests(equation, items),
        least=_least_late(equation, items),
        always=tuple(always),
        rarity=tuple(rarity_of(item.candidate, hypotheses.believed) for item in items),
        total=total,
        cost=float(np.log(made.effective.mean())),
    )


def _rests(equation: Equation, items: Sequence[Item]) -> dict[int, tuple[float, float]]:
    """Of springs, between which shares of both columns one rests near where the joint moves."""
    found = {}
    for number, item in enumerate(items):
        if item.candidate.name != "stiffness" or item.rule != "blend":
            continue
        q = equation.q[:, item.candidate.index]
        beyond = _BEYOND * float(np.ptp(q))
        first, second = (at["q0"] for at in item.settings)
        ends = (float(q.min()) - beyond, float(q.max()) + beyond)
        low, high = ((end - first) / (second - first) for end in ends)
        found[number] = (low, high)
    return found


def _least_late(equation: Equation, items: Sequence[Item]) -> dict[int, float]:
    found = {}
    for number, item in enumerate(items):
        if item.candidate.name in LATE:
            low, high = (at[name] for at, name in zip(item.settings, item.names, strict=True))
            found[number] = max((_LEAST_LATE * equation.motion.dt - low) / (high - low), 0.0)
    return found


def _bounds(h: Hypotheses, item: Item, name: str) -> tuple[float, float]:
    """Of a change from the null: what physics allows, and what machines have."""
    known = plausibility(item.candidate.name)
    if item.candidate.slot == PARAMETER:
        place = item.candidate.place
        i = h.names.index(place)
        value = h.believed.values[place]
        return h.lower[i] - value, h.upper[i] - value
    full = next(p for p in item.candidate.parameters if p.rpartition(".")[2] == name)
    i = h.names.index(full)
    low, high = h.lower[i] - h.null[i], h.upper[i] - h.null[i]
    return max(low, known.lower if known.lower != 0.0 else low), min(high, known.upper)


def _passing(h: Hypotheses, equation: Equation, items: Sequence[Item]) -> dict[int, float]:
    found = {}
    commands = np.concatenate([r.actions for r in equation.motion.recordings])
    for number, item in enumerate(items):
        if item.candidate.name not in ("saturation", "dead_zone"):
            continue
        effect = h.effect_of(item.candidate)
        assert isinstance(effect, ActionEffect)
        low, high = (at[effect.interpolated] for at in item.settings)
        size = np.abs(commands[:, item.candidate.index])
        middle = 0.5 * (low + high)
        passing = size < middle if item.candidate.name == "saturation" else size > 0.5 * middle
        found[number] = float(np.mean(passing))
    return found
