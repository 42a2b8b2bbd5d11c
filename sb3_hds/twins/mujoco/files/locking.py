"""Locked joints: which, where, and the parts of a model that are rigid with them."""

import dataclasses
import math
from collections.abc import Collection, Iterable, Mapping
from fnmatch import fnmatchcase
from typing import Any, NamedTuple

import numpy as np

from sb3_hds.errors import ModelFileError, ParameterError, did_you_mean, first_names
from sb3_hds.twins.mujoco.library import mujoco

#: names of joints, or patterns of them, with positions [rad] or [m]; None: the reference position
Lock = str | Collection[str] | Mapping[str, float | None]

# Numbers of a position, by kind of joint: mjtJoint.
_N_Q = (7, 4, 1, 1)
# Positions closer than this [rad] or [m] are the same.
_SAME = 1e-6


class Coupling(NamedTuple):
    """
    A joint whose displacement is a polynomial of another joint's.

    :param follower: name of the joint
    :param leader: name of the other joint; empty if the follower is held at a constant position
    :param powers: coefficients, of displacements from the reference positions
    """

    follower: str
    leader: str
    powers: tuple[float, ...]


@dataclasses.dataclass(frozen=True)
class Locks:
    """
    :param positions: by index of a locked joint, its numbers in ``qpos``
    :param groups: for each body, the first body that is rigid with it
    :param tendons: indices of tendons that nothing can move
    :param actuators: indices of actuators that move nothing
    :param equalities: indices of equality constraints between parts that are rigid anyway
    """

    positions: Mapping[int, tuple[float, ...]]
    groups: np.ndarray
    tendons: frozenset[int]
    actuators: frozenset[int]
    equalities: frozenset[int]

    @classmethod
    def of(cls, model: Any, positions: Mapping[int, tuple[float, ...]]) -> "Locks":
        """:param positions: as above"""
        groups = _groups(model, positions)
        tendons = frozenset(t for t in range(model.ntendon) if _rigid(model, t, positions, groups))
        return cls(
            positions,
            groups,
            tendons,
            frozenset(_idle_actuators(model, positions, tendons)),
            frozenset(_settled(model, positions, groups, tendons)),
        )

    @classmethod
    def named(cls, model: Any, locked: Iterable[tuple[str, tuple[float, ...]]]) -> "Locks":
        """
        :param locked: joints with their numbers in ``qpos``, as a mechanism stores them
        :raises ModelFileError: for a joint that the model lacks
        """
        index = {joint_name(model, j): j for j in range(model.njnt)}
        lacking = [name for name, _ in locked if name not in index]
        if lacking:
            raise ModelFileError(
                "The source is that of another robot: it has no joint "
                f"{first_names(lacking)}, which the twin has locked."
            )
        return cls.of(model, {index[name]: position for name, position in locked})

    def qpos(self, model: Any) -> np.ndarray:
        """:return: the reference position, with the locked joints where they are"""
        found = np.array(model.qpos0, float)
        for j, position in self.positions.items():
            at = int(model.jnt_qposadr[j])
            found[at : at + len(position)] = position
        return found


def joint_name(model: Any, j: int) -> str:
    """:return: the name of a joint, or one made of its number"""
    return model.joint(j).name or f"joint{j}"


def locked_positions(
    model: Any, lock: Lock, mimics: Collection[Coupling] = ()
) -> dict[int, tuple[float, ...]]:
    """
    Joints that follow a locked one are locked, too, where it holds them.

    :param model: compiled
    :param lock: joints to lock
    :param mimics: couplings of joints that the model does not have as equality constraints
    :return: by index of the joint, its numbers in ``qpos``
    :raises ParameterError: for a name that no joint has, an invalid position, or all joints
    """
    wanted = _expanded(model, lock)
    found = {
        j: reference_of(model, j) if position is None else (position,)
        for j, position in wanted.items()
    }
    index = {joint_name(model, j): j for j in range(model.njnt)}
    couplings = [c for c in (*couplings_of(model), *mimics) if c.leader]
    # Followers of followers take as many rounds as there are couplings.
    for _ in couplings:
        for coupling in couplings:
            _follow(
                model, index[coupling.follower], index[coupling.leader], coupling, wanted, found
            )
    for j, position in found.items():
        if j in wanted and wanted[j] is None and not _within_range(model, j, position[0]):
            low, high = model.jnt_range[j]
            raise ParameterError(
                f"lock: the reference position of {joint_name(model, j)}, {position[0]:g}, is "
                f"outside its range of {low:g} to {high:g}. Give the position at which it is "
                "locked."
            )
    if found and len(found) == model.njnt:
        raise ParameterError("lock: all joints are locked, so nothing moves.")
    return found


def couplings_of(model: Any) -> list[Coupling]:
    """:return: active equality constraints between joints"""
    kind = int(mujoco().mjtEq.mjEQ_JOINT)
    found = []
    for i in np.flatnonzero((model.eq_type == kind) & (model.eq_active0 != 0)).tolist():
        one, other = int(model.eq_obj1id[i]), int(model.eq_obj2id[i])
        leader = joint_name(model, other) if other >= 0 else ""
        powers = tuple(float(x) for x in model.eq_data[i][:5])
        found.append(Coupling(joint_name(model, one), leader, powers))
    return found


def reference_of(model: Any, j: int) -> tuple[float, ...]:
    """:return: the numbers of a joint in the reference position"""
    at = int(model.jnt_qposadr[j])
    return tuple(float(x) for x in model.qpos0[at : at + _N_Q[int(model.jnt_type[j])]])


def _expanded(model: Any, lock: Lock) -> dict[int, float | None]:
    """Names and patterns as joints; the last entry of a joint counts."""
    if isinstance(lock, str):
        lock = [lock]
    given = dict(lock) if isinstance(lock, Mapping) else dict.fromkeys(lock)
    names = [joint_name(model, j) for j in range(model.njnt)]
    found: dict[int, float | None] = {}
    for pattern, value in given.items():
        hits = [j for j, name in enumerate(names) if name == pattern]
        hits = hits or [j for j, name in enumerate(names) if fnmatchcase(name, str(pattern))]
        if not hits:
            inside = any(str(pattern) in name for name in names)
            near = f" Did you mean '*{pattern}*'?" if inside else did_you_mean(str(pattern), names)
            raise ParameterError(
                f"lock: no joint of the model has the name '{pattern}'.{near} Its joints are "
                f"{', '.join(names)}."
            )
        for j in hits:
            found[j] = None if value is None else _position(model, j, value)
    return found


def _position(model: Any, j: int, value: Any) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = math.nan
    if not math.isfinite(number):
        raise ParameterError(
            f"lock: the position of {joint_name(model, j)} must be a finite number, got {value!r}."
        )
    if _N_Q[int(model.jnt_type[j])] != 1:
        raise ParameterError(
            f"lock: {joint_name(model, j)} is a ball or free joint, which is locked at its "
            "reference position: give no number for it."
        )
    return number


def _follow(
    model: Any,
    follower: int,
    leader: int,
    coupling: Coupling,
    wanted: Mapping[int, float | None],
    found: dict[int, tuple[float, ...]],
) -> None:
    """Lock a follower of a locked joint."""
    if leader not in found:
        return
    (held,), (zero,) = found[leader], reference_of(model, leader)
    powers = enumerate(coupling.powers)
    position = reference_of(model, follower)[0] + sum(a * (held - zero) ** k for k, a in powers)
    given = wanted.get(follower)
    if given is not None and abs(given - position) > _SAME:
        raise ParameterError(
            f"lock: {coupling.follower} follows {coupling.leader}, which holds it at "
            f"{position:.6g}, not at {given:.6g}. Lock only {coupling.leader}."
        )
    found[follower] = (position,)


def _within_range(model: Any, j: int, position: float) -> bool:
    if not model.jnt_limited[j] or _N_Q[int(model.jnt_type[j])] != 1:
        return True
    low, high = model.jnt_range[j]
    return bool(low - _SAME <= position <= high + _SAME)


def _groups(model: Any, locked: Mapping[int, Any]) -> np.ndarray:
    found = np.array(model.body_weldid)
    for b in range(1, model.nbody):
        first = int(model.body_weldid[b])
        if first != b:
            found[b] = found[first]
            continue
        begin = int(model.body_jntadr[b])
        joints = range(begin, begin + int(model.body_jntnum[b]))
        if joints and all(j in locked for j in joints):
            found[b] = found[int(model.body_parentid[b])]
    return found


def _rigid(model: Any, t: int, locked: Mapping[int, Any], groups: np.ndarray) -> bool:
    """Whether a tendon runs along locked joints, or between points that are rigid."""
    wrap = mujoco().mjtWrap
    begin, bodies = int(model.tendon_adr[t]), set[int]()
    for i in range(begin, begin + int(model.tendon_num[t])):
        kind, at = int(model.wrap_type[i]), int(model.wrap_objid[i])
        if kind == int(wrap.mjWRAP_JOINT) and at not in locked:
            return False
        if kind == int(wrap.mjWRAP_SITE):
            bodies.add(int(groups[model.site_bodyid[at]]))
        elif kind in (int(wrap.mjWRAP_SPHERE), int(wrap.mjWRAP_CYLINDER)):
            bodies.add(int(groups[model.geom_bodyid[at]]))
    return len(bodies) <= 1


def _idle_actuators(model: Any, locked: Mapping[int, Any], tendons: frozenset[int]) -> list[int]:
    kinds, targets = mujoco().mjtTrn, model.actuator_trnid[:, 0].tolist()
    of_joints = (int(kinds.mjTRN_JOINT), int(kinds.mjTRN_JOINTINPARENT))
    found = []
    for i, (kind, target) in enumerate(zip(model.actuator_trntype.tolist(), targets, strict=True)):
        of_joint = kind in of_joints and target in locked
        if of_joint or (kind == int(kinds.mjTRN_TENDON) and target in tendons):
            found.append(i)
    return found


def _settled(
    model: Any, locked: Mapping[int, Any], groups: np.ndarray, tendons: frozenset[int]
) -> list[int]:
    """Equality constraints that nothing can violate."""
    mj = mujoco()
    site, kinds = int(mj.mjtObj.mjOBJ_SITE), mj.mjtEq
    held = {int(kinds.mjEQ_JOINT): locked, int(kinds.mjEQ_TENDON): tendons}
    found = []
    for i in range(model.neq):
        kind, one, other = (int(x[i]) for x in (model.eq_type, model.eq_obj1id, model.eq_obj2id))
        if kind in held:
            settled = one in held[kind] and (other < 0 or other in held[kind])
        elif kind in (int(kinds.mjEQ_CONNECT), int(kinds.mjEQ_WELD)):
            of_sites = int(model.eq_objtype[i]) == site
            one, other = (int(model.site_bodyid[x]) if of_sites else x for x in (one, other))
            settled = groups[one] == groups[other]
        else:
            settled = False
        if settled:
            found.append(i)
    return found
