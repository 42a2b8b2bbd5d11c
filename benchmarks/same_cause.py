"""
Which names are equivalent: what the catalogue declares, checked at this place in these recordings.

Effects declare from which other effects they cannot be distinguished, *and when*: a constant force
is equivalent to Coulomb friction only while the joint moves in one direction. Otherwise the name is
wrong. Both must be at one place; an actuator is at the joint that it drives.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from hidden_cases import RIGS, Case, nominal_twin, places_of, slot_of, spread
from independent_rigs import EVERYWHERE

# Share of the samples for which a condition on "all" samples must hold.
_ALL = 0.99
# "Several times" faster, and the share of samples of which that has to be true.
_SEVERAL, _MOSTLY = 3.0, 0.95
# A command is slow beside a delay if it takes so many times as long to change by its spread.
_SLOW = 5.0
# A joint that "hardly moves" keeps the stretch of a spring to this share; one that "swings but
# little" stays within these angles [rad], and its spring rests at this share of its spread.
_HARDLY, _LITTLE, _AT_REST = 0.1, 0.3, 0.1
# Below this share of what its velocity spreads over, a joint stands.
_STANDING = 0.02


class Motion(NamedTuple):
    """
    One joint in all recordings.

    :param index: of the joint; of what a sensor does, of the channel: positions come first
    :param q: positions, shape ``(n,)``
    :param v: velocities
    :param u: commands of its motor, zero without one
    :param dt: interval between commands [s]
    :param wide: typical standard deviation of its positions
    """

    index: int
    q: np.ndarray
    v: np.ndarray
    u: np.ndarray
    dt: float
    wide: float


Values = Mapping[str, float]
Condition = Callable[[Motion, Values], bool]


def one_way(motion: Motion, _: Values) -> bool:
    ahead = float(np.mean(motion.v > 0.0))
    return max(ahead, 1.0 - ahead) >= _ALL


def fast(motion: Motion, values: Values) -> bool:
    slide = values.get("v_s")
    return slide is not None and bool(np.mean(np.abs(motion.v) > _SEVERAL * slide) >= _MOSTLY)


def slow(motion: Motion, values: Values) -> bool:
    slide = values.get("v_s")
    return slide is not None and bool(np.mean(_SEVERAL * np.abs(motion.v) < slide) >= _MOSTLY)


def as_driven(motion: Motion, _: Values) -> bool:
    return bool(np.mean(motion.u * motion.v > 0.0) >= _ALL)


def one_sign(motion: Motion, _: Values) -> bool:
    positive = float(np.mean(motion.u > 0.0))
    return motion.u.any() and max(positive, 1.0 - positive) >= _ALL


def slow_commands(motion: Motion, values: Values) -> bool:
    late = max(values.get("delay", 0.0), values.get("time_constant", 0.0))
    speed = float(np.sqrt(np.mean(np.diff(motion.u) ** 2))) / motion.dt
    return motion.u.std() >= _SLOW * late * speed > 0.0


def hardly_moves(motion: Motion, values: Values) -> bool:
    rest = values.get("q0")
    return rest is not None and motion.q.std() < _HARDLY * abs(motion.q.mean() - rest)


def swings_little(motion: Motion, values: Values) -> bool:
    rest = abs(values.get("q0", np.inf))
    return bool(np.abs(motion.q).max() < _LITTLE) and rest < _AT_REST * motion.wide


def first_angle(motion: Motion, _: Values) -> bool:
    return motion.index == 0


def moves(motion: Motion) -> bool:
    return bool(np.mean(np.abs(motion.v) > _STANDING * motion.v.std()) >= _MOSTLY)


def never(_: Motion, __: Values) -> bool:
    return False


#: two causes, and when data cannot tell them apart. `never`: these rigs or their recordings do not
#: admit it; their motors do not stand still under one load, no mass of theirs scales inertia and
#: weight alike (there is some inertia or some damping besides), one channel alone is late, and no
#: joint stays at one angle, where gravity that is tilted is a constant force. The zero of the first
#: angle of a pendulum, from which the others are measured, is that of gravity.
CONDITIONS: dict[frozenset[str], Condition] = {
    frozenset(pair): condition
    for *pair, condition in (
        ("viscous_friction", "directional_viscous_friction", one_way),
        ("coulomb_friction", "directional_coulomb_friction", one_way),
        ("coulomb_friction", "constant_force", one_way),
        ("coulomb_friction", "stribeck_friction", fast),
        ("coulomb_friction", "concave_friction", fast),
        ("viscous_friction", "concave_friction", slow),
        ("coulomb_friction", "dead_zone", as_driven),
        ("coulomb_friction", "load_dependent_friction", never),
        ("constant_force", "stiffness", hardly_moves),
        ("stiffness", "parameter.gravity", swings_little),
        ("torque_gain", "directional_gain", one_sign),
        ("motor_lag", "action_delay", slow_commands),
        ("action_delay", "sensor_delay", never),
        ("torque_gain", "parameter.mass", never),
        ("sensor_bias", "parameter.tilt", first_angle),
        ("constant_force", "parameter.tilt", never),
        ("constant_force", "parameter.tilt_x", never),
        ("constant_force", "parameter.tilt_y", never),
        ("sensor_bias", "parameter.gravity_x", never),
        ("constant_force", "parameter.gravity_x", never),
        # Only all three together: `_TOGETHER`.
        ("directional_coulomb_friction", "constant_force", never),
    )
}
# What is one thing by one name and two things by others, while the joint moves.
_TOGETHER = ("directional_coulomb_friction", ("coulomb_friction", "constant_force"))


def equals(
    case: Case,
    motion: np.ndarray,
    commands: np.ndarray,
    named: Sequence[str],
    values: Mapping[str, Values],
) -> dict[str, list[str]]:
    """
    :param motion: positions and velocities of all joints, shape ``(n, 2 dof)``
    :param commands: shape ``(n, actuators)``
    :param named: all names that a diagnosis gave one after the other, each with its place
    :param values: their parameters, by name
    :return: for each planted cause, the other names that are equivalent in these data
    """
    found: dict[str, list[str]] = {}
    # Effects outside the catalogue have no name in it.
    for truth, planted in zip(case.truths, case.planted, strict=False):
        same, joint = [], planted.index % RIGS[case.system].dof
        here = _motion_of(planted.index, case, motion, commands)
        for pair, holds in CONDITIONS.items():
            if planted.effect in pair:
                (other,) = pair - {planted.effect}
                name = _named_at(other, joint, case.system)
                if planted.index == EVERYWHERE and slot_of(other) == "actuator":
                    name = f"{other}.all"
                told = values.get(name, {})
                if name and holds(here, {**planted.values, **told}):
                    same.append(name)
        if moves(here):
            same += _together(planted.effect, joint, case, named)
        if planted.index == EVERYWHERE:
            # What all motors share may be told of each of them.
            same += [name for name in named if name.startswith(f"{planted.effect}.")]
        found[truth] = same
    return found


def _together(effect: str, joint: int, case: Case, named: Sequence[str]) -> list[str]:
    one, two = _TOGETHER
    alone = _named_at(one, joint, case.system)
    parts = [_named_at(part, joint, case.system) for part in two]
    if effect == one and set(parts) <= set(named):
        return parts
    if effect in two and {_named_at(p, joint, case.system) for p in two} <= set(case.truths):
        return [alone] if alone in named else []
    return []


def _named_at(effect: str, joint: int, system: str) -> str:
    """:return: the effect with its place at or before a joint; empty if there is none"""
    twin = nominal_twin(system)
    if effect.startswith("parameter."):
        return effect if effect.partition(".")[2] in twin.parameters else ""
    if slot_of(effect) == "channel" or joint >= len(places_of(effect, system)):
        return ""
    return f"{effect}.{places_of(effect, system)[joint].name}"


def _motion_of(index: int, case: Case, motion: np.ndarray, commands: np.ndarray) -> Motion:
    rig = RIGS[case.system]
    joint = index % rig.dof
    driven = joint < commands.shape[1]
    u = commands[:, joint] if driven else np.zeros(len(commands))
    wide = float(spread(case.system)[joint])
    return Motion(index, motion[:, joint], motion[:, rig.dof + joint], u, rig.dt, wide)


def right(truths: str, same: Mapping[str, Sequence[str]], names: str) -> bool:
    """
    :param truths: what was planted, separated by semicolons
    :param same: as ``equals`` says
    :param names: likewise
    :return: whether one of the names is one of the causes, or equivalent to one
    """
    meant = {truth: {truth, *same.get(truth, ())} for truth in truths.split(";") if truth}
    return any(name in every for name in names.split(";") for every in meant.values())
