"""
Cases of `hidden_effects.py` with two to nine causes at once, as on real machines.

Most cases have friction at the joints; in half of them the scale is wrong as well (an inertia, or
the gain of a motor); further causes are drawn from the rest of the catalogue. Sizes lie between
twice the detection limit and *dominant*: friction that takes nine tenths of the torque. Commands
are open-loop torques, or those of a position or velocity loop; there are many recordings or a
single long one; some have positions only. All of these are drawn from decks, as in other cases.
"""

import dataclasses
import functools
import json
import math
import zlib
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from hidden_cases import (
    ASKED,
    CACHE,
    N_STEPS,
    NOISES,
    PARAMETER,
    RIGS,
    Case,
    base_value,
    from_deck,
    kind_of,
    nominal_twin,
    nothing,
    places_of,
    recorded,
    slot_of,
    write,
)
from independent_rigs import (
    ARMATURE,
    EVERYWHERE,
    DivergedError,
    Loop,
    Planted,
    can_change,
)

from sb3_hds.sysid.equation.regression import squares

SEVERAL = "several"
#: cards: what closes the loop, what is recorded, and how many recordings the same steps make
LOOPS = ("open", "open", "position", "open", "open", "velocity")
SEEN = ("qv", "qv", "q", "qv")
LONG = (False, True, False, False)
_NOISES = ("tick", "tick", "1 %", "1 %", "5 %")
_RECORDINGS = (6, 8, 10, 14, 20)
# Largest number of causes by number of joints; more than two joints: nine.
_FEWEST, _MOST = 2, {1: 5, 2: 7}
_MOST_OF_ALL = 9
# Of the causes beside the scale, the share that is viscous or Coulomb friction.
_FRICTION = 0.75
_VISCOUS, _DRY = "viscous_friction", "coulomb_friction"
# What else there may be, and its family: one of a family at a place.
_OTHERS = {
    "constant_force": "offset",
    "action_delay": "late",
    "motor_lag": "late",
    "stiffness": "spring",
    "stribeck_friction": "dry",
    "concave_friction": "viscous",
    "load_dependent_friction": "dry",
    "quadratic_drag": "drag",
    "cogging": "cogging",
    "dead_zone": "dead zone",
    "sensor_bias": "offset",
}
_FAMILIES = {**_OTHERS, _VISCOUS: "viscous", _DRY: "dry"}
# Smallest size in detection limits.
_LEAST = 2.0
# Where friction carries this share of the torque, it is dominant: by so much it is larger then than
# what moves the rig otherwise. Joints without a motor, or with a servo whose gains are what they
# are, bear less.
_DOMINANT = 0.9
_OVER = _DOMINANT / (1.0 - _DOMINANT)
_PASSIVE, _SERVO = 0.5, 3.0
# Joints that keep less than this share of the speed they have without anything planted hardly move;
# nor do those whose friction takes more than this share of the torque.
_HARDLY, _ALL = 0.2, 0.95
# Bandwidth of position and velocity loops [rad/s], their damping ratio, and the largest set points.
_POSITION_LOOP, _VELOCITY_LOOP, _RATIO, _WIDEST = 10.0, 15.0, 0.7, 1.0
# The longest delay and lag [s], the largest share by which a scale is wrong.
_LATEST, _SLOWEST, _OFF = 0.06, 0.1, 0.5
_TRIES, _SAME_COUNT = 400, 100


class Usual(NamedTuple):
    """
    What a rig does where nothing is planted.

    :param limits: detection limits, by name with place and by parameter
    :param force: typical force of each joint [N m] or [N]
    :param inertia: of each joint, the others held
    :param speed: root mean square velocity of each joint
    :param wide: standard deviation of the position of each joint
    :param command: root mean square command of each actuator
    """

    limits: dict[str, dict[str, float]]
    force: np.ndarray
    inertia: np.ndarray
    speed: np.ndarray
    wide: np.ndarray
    command: np.ndarray


def draw(
    system: str, number: int, *, noise: str = "", most: int = max(_RECORDINGS)
) -> tuple[Case, Any, np.ndarray]:
    """
    :param number: of a case whose kind is ``"several"``, or of any one: then the turn is its number
    :param noise: instead of the one whose turn it is
    :param most: recordings, of equal length; a long one is as long as all of them
    :return: as ``hidden_cases.draw``
    """
    kind, turn = kind_of(system, number)
    turn = turn if kind == SEVERAL else number
    deal = functools.partial(from_deck, turn, system, SEVERAL)
    driven = "servos" not in system
    recordings = min(deal("recordings", _RECORDINGS), most)
    long = deal("long", LONG)
    case = Case(
        system=system,
        number=number,
        kind=SEVERAL,
        planted=(),
        factor=_LEAST,
        noise=noise or deal("noise", _NOISES),
        recordings=1 if long else recordings,
        wrong_base=False,
        base_change=0.0,
        disturbance=0.0,
        asked=turn % ASKED == 0,
        loop=deal("loop", LOOPS) if driven else "open",
        seen=deal("seen", SEEN),
        n_steps=N_STEPS * recordings if long else N_STEPS,
    )
    scale = deal("scale", (True, False))
    capacity = _MOST.get(RIGS[system].dof, _MOST_OF_ALL)
    count = deal("count", range(_FEWEST, capacity + 1))
    # The noise is reduced where no effect would be detectable.
    levels = sorted(NOISES, key=NOISES.__getitem__)
    for level in reversed(levels[: levels.index(case.noise) + 1]):
        found = _drawn(dataclasses.replace(case, noise=level), scale, count, capacity)
        if found is not None:
            return found
    raise RuntimeError(f"{system}, case {number}: nothing could be planted in {_TRIES} tries.")


def _drawn(
    case: Case, scale: bool, count: int, capacity: int
) -> tuple[Case, Any, np.ndarray] | None:
    """:return: as ``draw``; None if nothing could be planted"""
    stream = zlib.crc32(f"{case.system}, {SEVERAL}".encode())
    for again in range(_TRIES):
        rng = np.random.default_rng([case.number, stream, again])
        own = count if again < _SAME_COUNT else int(rng.integers(_FEWEST, capacity + 1))
        planted = _planted(case, own, scale, rng)
        if planted is None:
            continue
        changed = _with(case, planted)
        if changed is None:
            continue
        seed = int(rng.integers(2**31))
        short = dataclasses.replace(changed, recordings=1, n_steps=N_STEPS)
        try:
            if not _moves(short, *_driven(short, seed)):
                continue
            data, motion = _driven(changed, seed)
        except DivergedError:
            continue
        if _moves(changed, data, motion):
            return changed, data, motion
    return None


def _with(case: Case, planted: tuple[Planted, ...]) -> Case | None:
    """:return: the case with its causes; None if the inertia is physically impossible"""
    rig = RIGS[case.system]
    if rig.base is None:
        return dataclasses.replace(case, planted=planted)
    change = sum(p.values.get(rig.base[0], 0.0) for p in planted)
    if not can_change(rig, change):
        return None
    return dataclasses.replace(case, planted=planted, base_change=change)


# ------------------------------------------------------------------------------ what is planted
def _planted(
    case: Case, count: int, scale: bool, rng: np.random.Generator
) -> tuple[Planted, ...] | None:
    """:return: so many causes; None if fewer can be large enough to be detectable"""
    found = [_size(case, *_scale(case, rng), rng)] if scale else []
    if not all(map(_finite, found)):
        return None
    free = _places(case)
    while len(found) < count:
        friction = [place for place in free if place[0] in (_VISCOUS, _DRY)]
        others = [place for place in free if place not in friction]
        if not free:
            return None
        chosen = friction if (rng.random() < _FRICTION and friction) or not others else others
        if chosen is others:
            # Kinds are equally likely, independently of their number of places.
            kind = str(rng.choice(sorted({kind for kind, _ in others})))
            chosen = [place for place in others if place[0] == kind]
        kind, index = chosen[int(rng.integers(len(chosen)))]
        planted = _size(case, kind, index, rng)
        if _finite(planted):
            found.append(planted)
            free = [p for p in free if (_FAMILIES[p[0]], p[1]) != (_FAMILIES[kind], index)]
        else:
            free.remove((kind, index))
    return tuple(found)


def _finite(planted: Planted) -> bool:
    return bool(np.all(np.isfinite([*planted.values.values()])))


def _scale(case: Case, rng: np.random.Generator) -> tuple[str, int]:
    """A wrong inertia, or the gain of a motor; commands that are set points have no gain."""
    joints, motors = RIGS[case.system].dof, len(RIGS[case.system].torque)
    if "servos" in case.system or rng.random() < 0.5:
        return PARAMETER, int(rng.integers(joints))
    return "torque_gain", int(rng.integers(motors))


def _places(case: Case) -> list[tuple[str, int]]:
    """:return: effects and their possible places; a late bus acts on all motors at once"""
    rig, servo = RIGS[case.system], "servos" in case.system
    motors = len(rig.torque)
    found = []
    for kind in _FAMILIES:
        slot = slot_of(kind)
        if slot == "actuator" and motors > 1 and _FAMILIES[kind] == "late":
            found.append((kind, EVERYWHERE))
        elif slot == "actuator":
            # A set point arrives as it is, or late.
            found += [(kind, i) for i in range(motors) if not servo]
        else:
            # Of channels, those of positions.
            found += [(kind, i) for i in range(rig.dof)]
    return found


def _size(case: Case, kind: str, index: int, rng: np.random.Generator) -> Planted:
    """An effect with a size between detectable and dominant; NaN if there is no such size."""
    usual = usual_of(case)
    side = float(rng.choice((-1.0, 1.0)))
    if kind == PARAMETER:
        return _parameter(case, index, side, rng)
    joint = index % RIGS[case.system].dof
    name = "all" if index == EVERYWHERE else places_of(kind, case.system)[index].name
    limits = usual.limits.get(f"{kind}.{name}", {})
    force, speed, wide = usual.force[joint], usual.speed[joint], usual.wide[joint]
    command = usual.command[min(joint, len(usual.command) - 1)]
    most = _PASSIVE * force
    if joint < len(usual.command):
        most = force * (_SERVO if "servos" in case.system else _OVER)
    between = lambda parameter, most: _between(limits.get(parameter, np.nan), most, rng)  # noqa: E731

    def falling() -> dict[str, float]:
        tau_c = between("tau_c", most / 2.0)
        return {"tau_c": tau_c, "tau_s": rng.uniform(1.5, 3.0) * tau_c, "v_s": 0.3 * speed}

    def by_load() -> dict[str, float]:
        mu = between("mu", _OFF)
        return {"tau_c": 0.3 * mu * force, "mu": mu}

    values = {
        _VISCOUS: lambda: {"b": between("b", most / speed)},
        _DRY: lambda: {"tau_c": between("tau_c", most)},
        "constant_force": lambda: {"tau_0": side * between("tau_0", _OFF * force)},
        "action_delay": lambda: {"delay": max(round(between("delay", _LATEST), 3), 1e-3)},
        "motor_lag": lambda: {"time_constant": between("time_constant", _SLOWEST)},
        "stiffness": lambda: {"k": between("k", _DOMINANT * force / wide), "q0": 0.3 * side * wide},
        "stribeck_friction": falling,
        "concave_friction": lambda: {"b": between("b", 2.0 * most / speed), "v_s": speed},
        "load_dependent_friction": by_load,
        "quadratic_drag": lambda: {"c": between("c", most / speed**2)},
        "cogging": lambda: {
            "amplitude": between("amplitude", _OFF * force),
            "period": float(np.clip(wide, 0.1, 1.0)),
            "phase": 0.3 * float(np.clip(wide, 0.1, 1.0)),
        },
        "dead_zone": lambda: {"width": between("width", _OFF * command)},
        "sensor_bias": lambda: {"bias": side * between("bias", 0.3 * wide)},
        "torque_gain": lambda: {"gain": 1.0 + side * between("gain", _OFF)},
    }[kind]()
    return Planted(kind, index, {name: float(value) for name, value in values.items()})


def _parameter(case: Case, joint: int, side: float, rng: np.random.Generator) -> Planted:
    """The rig's own wrong inertia; of a twin from a model file, that of a joint's rotor."""
    rig, usual = RIGS[case.system], usual_of(case)
    if rig.base is not None:
        name, index, most = rig.base[0], 0, _OFF * base_value(case.system)
    else:
        name, index = f"{nominal_twin(case.system).joints[joint].name}{ARMATURE}", joint
        own = nominal_twin(case.system).values[name]
        most = _OFF * (own if side < 0.0 else max(own, usual.inertia[joint]))
    limit = usual.limits.get(f"parameter.{name}", {}).get(name, np.nan)
    return Planted(f"parameter.{name}", index, {name: side * _between(limit, most, rng)})


def _between(limit: float, most: float, rng: np.random.Generator) -> float:
    """Draw log-uniformly; NaN if even the largest value is hardly detectable."""
    low = _LEAST * (limit or np.nan)
    if not low < most:
        return np.nan
    return float(math.exp(rng.uniform(math.log(low), math.log(most))))


# ------------------------------------------------------------------------------ how it is driven
def _driven(case: Case, seed: int) -> tuple[Any, np.ndarray]:
    """:return: as ``recorded``; an engineer drives a machine so that it moves, or tunes its loop"""
    return recorded(case, seed, _loop_of(case), 1.0 + _friction(case))


def _friction(case: Case) -> np.ndarray:
    """:return: of each motor's joint, in units of its usual force; no servo is driven harder"""
    found = np.zeros(len(RIGS[case.system].torque))
    if not case.planted or "servos" in case.system:
        return found
    usual = usual_of(case)
    for p in case.planted:
        if slot_of(p.effect) == "joint" and p.index < len(found):
            j, v = p.index, usual.speed[p.index]
            force = p.values.get("tau_c", 0.0) + p.values.get("b", 0.0) * v
            found[j] += (force + p.values.get("c", 0.0) * v**2) / usual.force[j]
    return found


def _loop_of(case: Case) -> Loop | None:
    """
    :return: a controller of each motor's joint, tuned for the machine as it is, friction included;
        None where none closes a loop
    """
    if case.loop == "open":
        return None
    n, usual = len(RIGS[case.system].torque), _usual(case.system, case.noise, "qv", "open")
    inertia, harder = usual.inertia[:n], 1.0 + _friction(case)
    amplitude = np.minimum(usual.wide[:n], _WIDEST)
    if case.loop == "velocity":
        return Loop(np.zeros(n), _VELOCITY_LOOP * inertia * np.sqrt(harder), amplitude)
    stiffness = _POSITION_LOOP**2 * inertia * harder
    return Loop(stiffness, 2.0 * _RATIO * _POSITION_LOOP * inertia * np.sqrt(harder), amplitude)


def _moves(case: Case, data: Any, motion: np.ndarray) -> bool:
    """Whether every joint moves, and no friction takes nearly all of the torque."""
    rig, usual = RIGS[case.system], usual_of(case)
    v = motion[:, rig.dof :]
    speed = np.sqrt(np.mean(v**2, axis=0))
    carried = share_of_friction(case, data, motion)
    return bool(np.all(speed > _HARDLY * usual.speed) and np.nanmax(carried, initial=0.0) < _ALL)


def share_of_friction(case: Case, data: Any, motion: np.ndarray) -> np.ndarray:
    """
    :return: of each joint with a motor, what viscous and Coulomb friction take, root mean squares
        in units of the command; NaN elsewhere
    """
    rig, n = RIGS[case.system], len(RIGS[case.system].torque)
    share = np.full(rig.dof, np.nan)
    if "servos" in case.system:
        return share
    v = motion[:, rig.dof :]
    commands = np.concatenate([data.episode(i)[1] for i in range(len(data))])
    for j in range(n):
        own = [p.values for p in case.planted if p.index == j and p.effect in (_VISCOUS, _DRY)]
        force = sum(p.get("b", 0.0) * v[:, j] + p.get("tau_c", 0.0) * np.sign(v[:, j]) for p in own)
        share[j] = np.sqrt(np.mean(np.square(force)) / np.mean(commands[:, j] ** 2))
    return share


def visible(screened: Any, truths: Sequence[str]) -> list[bool]:
    """
    Other causes may hide one that would show alone: it shows if all of them explain so much less
    without it as something twice as large as the detection limit would. That is four times the
    price of a cause, in -2 log likelihood.

    :param screened: a `sb3_hds.sysid.equation.screening.Screened`
    :param truths: causes with their places; those that have no column count as visible
    """
    p = screened.problem
    options = {key: [i for i, item in enumerate(p.items) if item.key == key] for key in truths}
    chosen = {key: own[len(own) // 2] for key, own in options.items() if own}
    for _ in range(2):
        for key in chosen:
            trials = {i: [*({**chosen, key: i}).values()] for i in options[key]}
            chosen[key] = min(trials, key=lambda i: p.solve([*p.always, *trials[i]]).rss)

    def left(items: Sequence[int]) -> float:
        rss = squares(p.solve([*p.always, *items]).weights, p.grams.by_joint)
        n = p.grams.n_effective
        return float(np.sum(n * np.log(np.maximum(rss, 1e-9) / n)))

    whole = left([*chosen.values()])
    lost = {key: left([j for j in chosen.values() if j != i]) for key, i in chosen.items()}
    return [
        key not in chosen or lost[key] - whole >= _LEAST**2 * p.price(chosen[key]) for key in truths
    ]


# ------------------------------------------------------------------------------ without a cause
def usual_of(case: Case) -> Usual:
    """:return: of this rig with this noise, driven and recorded like this"""
    return _usual(case.system, case.noise, case.seen, case.loop)


@functools.cache
def _usual(system: str, noise: str, seen: str, loop: str) -> Usual:
    """Measured from the equation of motion of a recording without causes; cached."""
    path = CACHE / "usual" / f"{system}_{noise.replace(' ', '')}_{seen}_{loop}.json"
    if not path.exists():
        write(path, json.dumps(_measured(system, noise, seen, loop)))
    found = json.loads(path.read_text())
    return Usual(found.pop("limits"), **{name: np.array(x) for name, x in found.items()})


def _measured(system: str, noise: str, seen: str, loop: str) -> dict[str, Any]:
    from sb3_hds import effects
    from sb3_hds.sysid.equation.screening import screen
    from sb3_hds.sysid.motion.motion import smoothed_motion

    case = dataclasses.replace(nothing(system, noise), kind=SEVERAL, seen=seen, loop=loop)
    data, moved = _driven(case, 99)
    twin = nominal_twin(system, seen)
    found = screen(twin, smoothed_motion(twin, data), effects.ALL, ())
    if found is None:
        raise RuntimeError(f"{system}: there is no equation of motion, so no size just shows.")
    dof = RIGS[system].dof
    commands = np.concatenate([data.episode(i)[1] for i in range(len(data))])
    return {
        "limits": found.detectable,
        "force": found.problem.force.tolist(),
        "inertia": np.mean(np.diagonal(found.problem.mass, axis1=1, axis2=2), 0).tolist(),
        "speed": np.sqrt(np.mean(moved[:, dof:] ** 2, axis=0)).tolist(),
        "wide": moved[:, :dof].std(0).tolist(),
        "command": np.sqrt(np.mean(commands**2, axis=0)).tolist(),
    }
