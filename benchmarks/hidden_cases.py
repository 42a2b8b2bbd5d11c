"""
The cases of `hidden_effects.py`: planted effects, their places and sizes, and the recordings.

A case is determined by its system and its number. Kinds of cases, effects, sizes, noises and
numbers of recordings are drawn without replacement from shuffled decks, so that each occurs in its
exact share.
"""

import dataclasses
import functools
import json
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from independent_rigs import (
    COMMANDS,
    EULER,
    EVERYWHERE,
    FORCES,
    FROM_FILES,
    OUTSIDE,
    SENSORS,
    SYSTEMS,
    TRANSMISSIONS,
    DivergedError,
    Loop,
    Moment,
    Planted,
    System,
    can_change,
    simulate,
)
from runs import CACHE

N_STEPS = 200
#: errors of the sensors, root mean squares in units of each channel's spread; of an encoder, which
#: rounds every channel to its tick, the square root of 12 times that: two hundred ticks or so to a
#: turn. A rig's own electronics computes the velocities, so their ticks are no finer or coarser.
NOISES = {"tick": 2e-3, "1 %": 0.01, "5 %": 0.05}
#: kinds of cases and their number in a hundred; single and several causes alternate
SHARES = {
    "effect": 20,
    "several": 20,
    "outside": 15,
    "null": 12,
    "null, disturbed": 12,
    "null, wrong base": 12,
    "pair": 6,
    "still": 3,
}
NULLS = tuple(kind for kind in SHARES if kind.startswith("null"))
#: Pendulum-v1's twin, which takes semi-implicit Euler steps, compared with the engine
EULERS = "Euler's twin"
RIGS: dict[str, System] = {**SYSTEMS, "pendulum_v1": EULER, **FROM_FILES}
#: other rules are applied to one in so many cases of a kind
ASKED = 4
PARAMETER = "parameter"
# Effects that can be planted at joints.
JOINT = (
    "viscous_friction",
    "directional_viscous_friction",
    "concave_friction",
    "coulomb_friction",
    "directional_coulomb_friction",
    "stribeck_friction",
    "load_dependent_friction",
    "quadratic_drag",
    "stiffness",
    "cubic_stiffness",
    "cogging",
    "constant_force",
)
# Pairs that resemble a single cause, planted at one place; half of the pairs are arbitrary.
_CONFOUNDED = (
    ("action_delay", "motor_lag"),
    ("coulomb_friction", "constant_force"),
    ("torque_gain", PARAMETER),
)
# For single effects: whether the base parameter is 10 % wrong, and the disturbance.
_CONDITIONS = (
    *((False, 0.0),) * 10,
    *((True, 0.0),) * 4,
    *((False, 0.02), (False, 0.05)) * 2,
    *((True, 0.02), (True, 0.05)),
)
# How often an impossible case is redrawn, and how many of these times with the same effect, and
# with the same size.
_TRIES, _SAME, _SAME_SIZE = 200, 20, 50

# Of twins from model files, within an interval of 20 ms.
_SUBSTEPS = 5

_Card = TypeVar("_Card")


@dataclasses.dataclass(frozen=True)
class Case:
    """
    :param system: key of ``RIGS``
    :param number: of the case
    :param kind: key of ``SHARES``
    :param planted: effects that the twin under diagnosis lacks
    :param factor: their size in detection limits; 0 without any
    :param noise: key of ``NOISES``
    :param recordings: number of recordings
    :param wrong_base: whether a nuisance parameter (`System.base`) is wrong
    :param base_change: its deviation, planted or not
    :param disturbance: coloured torque, in units of the typical command
    :param asked: whether other rules are applied as well
    :param loop: ``"open"`` where commands are torques as they come; a ``"position"`` or
        ``"velocity"`` loop makes them of what is measured
    :param seen: what is recorded: ``"qv"`` for positions and velocities, ``"q"`` for positions
    :param n_steps: of each recording
    """

    system: str
    number: int
    kind: str
    planted: tuple[Planted, ...]
    factor: float
    noise: str
    recordings: int
    wrong_base: bool
    base_change: float
    disturbance: float
    asked: bool
    loop: str = "open"
    seen: str = "qv"
    n_steps: int = N_STEPS

    @property
    def truths(self) -> tuple[str, ...]:
        """Names and places as a diagnosis reports them; empty for effects outside the catalogue."""
        if self.kind == "outside":
            return ()
        return tuple(name_of(planted, self.system) for planted in self.planted)

    @property
    def nuisances(self) -> tuple[str, ...]:
        base = RIGS[self.system].base
        return (base[0],) if base and self.wrong_base else ()


def kinds(system: str) -> tuple[str, ...]:
    """:return: kinds of a hundred cases in order; the first n have nearly the right shares"""
    if RIGS[system] is EULER:
        return (EULERS,) * 100
    shares, order = dict(SHARES), list[str]()
    shares["effect"] += shares.pop("several")
    if RIGS[system].base is None:
        shares["null"] += shares.pop("null, wrong base")
    for n in range(1, 101):
        behind = {kind: share * n / 100 - order.count(kind) for kind, share in shares.items()}
        order.append(max(behind, key=lambda kind: behind[kind]))
    for place in [i for i, kind in enumerate(order) if kind == "effect"][1::2]:
        order[place] = "several"
    return tuple(order)


def kind_of(system: str, number: int) -> tuple[str, int]:
    """
    :return: kind of a case, and how many of this kind come before it; of single effects, twice as
        many, as they have every second card of their packs
    """
    hundreds, place = divmod(number, 100)
    order = kinds(system)
    kind = order[place]
    turn = hundreds * order.count(kind) + order[:place].count(kind)
    return kind, 2 * turn if kind == "effect" else turn


def draw(
    system: str, number: int, *, kind: str = "", noise: str = "", most: int = 20
) -> tuple[Case, Any, np.ndarray]:
    """
    :param kind: instead of the one whose turn it is
    :param noise: likewise
    :param most: recordings
    :return: the case, its data, and positions and velocities as they were, ``(n, 2 dof)``
    """
    turn = number
    if not kind:
        kind, turn = kind_of(system, number)
    deal = functools.partial(from_deck, turn, system, kind)
    factors = {"effect": (2.0, 4.0, 8.0), "pair": (2.0, 4.0, 8.0), "outside": (4.0, 8.0)}
    noise = noise or deal("noise", ("tick", "tick", "1 %", "1 %", "5 %"))
    wrong, disturbance = deal("condition", _CONDITIONS) if kind == "effect" else (False, 0.0)
    wrong = wrong and RIGS[system].base is not None
    case = Case(
        system=system,
        number=number,
        kind=kind,
        planted=(),
        factor=deal("factor", factors.get(kind, (0.0,))),
        noise=noise,
        recordings=min(deal("recordings", (6, 8, 10, 14, 20)), most),
        wrong_base=wrong or kind == "null, wrong base",
        base_change=0.0,
        disturbance=deal("disturbance", (0.02, 0.05)) if kind == "null, disturbed" else disturbance,
        asked=turn % ASKED == 0 and kind != EULERS,
    )
    for again in range(_TRIES):
        # Where the detection limit is high, a large multiple may be more than a rig can have.
        if again and again % _SAME_SIZE == 0:
            case = dataclasses.replace(case, factor=0.5 * case.factor)
        rng = np.random.default_rng([number, zlib.crc32(system.encode()), again])
        changed = _planted(case, deal, rng, again)
        if changed is None:
            continue
        try:
            data, motion = recorded(changed, seed=int(rng.integers(2**31)))
        except DivergedError:
            continue
        return changed, data, motion
    raise RuntimeError(f"{system}, case {number}: nothing could be planted in {_TRIES} tries.")


def from_deck(turn: int, system: str, kind: str, what: str, cards: Sequence[_Card]) -> _Card:
    """Draw without replacement from a deck that is reshuffled when it is used up."""
    pack, place = divmod(turn, len(cards))
    label = zlib.crc32(f"{system}, {kind}, {what}".encode())
    return cards[int(np.random.default_rng([label, pack]).permutation(len(cards))[place])]


def _planted(case: Case, deal: Any, rng: np.random.Generator, again: int) -> Case | None:
    """:return: the case with planted effects according to its kind; None if that is impossible"""
    system, rig = case.system, RIGS[case.system]
    chosen, index = (), None
    if case.kind == "effect":
        kind = deal("effect", plantable(rig)) if again < _SAME else rng.choice(plantable(rig))
        chosen = (str(kind),)
    elif case.kind == "pair":
        confounded = [pair for pair in _CONFOUNDED if rig.base or PARAMETER not in pair]
        chosen = deal("pair", (*confounded, *((),) * len(confounded)))
        index = int(rng.integers(len(rig.torque))) if chosen else None
        chosen = chosen or tuple(map(str, rng.choice(plantable(rig), 2, replace=False)))
    apart = [kind for kind in chosen if kind in TRANSMISSIONS]
    if len(apart) > 1 or (apart and PARAMETER in chosen):
        return None
    if apart or PARAMETER in chosen:
        case = dataclasses.replace(case, wrong_base=False)
    planted = tuple(_effect(case, kind, rng, index) for kind in chosen)
    if case.kind == "outside":
        planted = (_outside(case, deal("outside", OUTSIDE), rng),)
    if not np.all(np.isfinite([value for p in planted for value in p.values.values()])):
        return None
    if rig.base is None:
        return dataclasses.replace(case, planted=planted)
    change = sum(p.values[rig.base[0]] for p in planted if p.effect.startswith(PARAMETER))
    if case.wrong_base:
        change = 0.1 * base_value(system) * float(rng.choice((-1.0, 1.0)))
    if abs(change) > 0.7 * base_value(system) or not can_change(rig, change):
        return None
    return dataclasses.replace(case, planted=planted, base_change=change)


def plantable(rig: System) -> tuple[str, ...]:
    """:return: effects that can be planted in this rig"""
    apart = tuple(TRANSMISSIONS) if rig.apart else ()
    own = (PARAMETER,) if rig.base else ()
    return (*JOINT, *COMMANDS, *SENSORS, *apart, *own)


def slot_of(effect: str) -> str:
    sensor = effect in SENSORS and effect != "reversed_joint"
    return "actuator" if effect in COMMANDS else "channel" if sensor else "joint"


def places_of(effect: str, system: str) -> Sequence[Any]:
    twin = nominal_twin(system)
    slots = {"joint": twin.joints, "actuator": twin.actuators, "channel": twin.channels}
    return slots[slot_of(effect)]


def name_of(planted: Planted, system: str) -> str:
    """:return: effect and place, as a diagnosis reports them"""
    if planted.effect.startswith(PARAMETER):
        return planted.effect
    effect = "sign_flip" if planted.effect == "reversed_joint" else planted.effect
    if planted.index == EVERYWHERE:
        return f"{effect}.all"
    return f"{effect}.{places_of(planted.effect, system)[planted.index].name}"


def _effect(case: Case, kind: str, rng: np.random.Generator, index: int | None = None) -> Planted:
    """One effect of the catalogue, with a size of ``case.factor`` detection limits."""
    system, rig, factor = case.system, RIGS[case.system], case.factor
    limits, wide = smallest(case), spread(system)
    side = float(rng.choice((-1.0, 1.0)))
    if kind == PARAMETER:
        assert rig.base is not None
        base = rig.base[0]
        size = limits.get(f"parameter.{base}", {}).get(base, np.nan)
        return Planted(f"parameter.{base}", 0, {base: side * factor * size})
    places = places_of(kind, system)
    index = int(rng.integers(len(places))) if index is None else index
    # How far a motor that is apart leads its load, or the load lags: in units of the noise.
    lead = factor * 2.0 * NOISES[case.noise] * wide[index]
    torque = rig.torque[min(index, len(rig.torque) - 1)]
    found = limits.get(f"{kind}.{places[index].name}", {})
    s = {name: factor * (size or np.nan) for name, size in found.items()}
    values = {
        "directional_viscous_friction": lambda: {"b_pos": 1.5 * s["b_pos"], "b_neg": 0.0},
        "directional_coulomb_friction": lambda: {"tau_pos": 1.5 * s["tau_pos"], "tau_neg": 0.0},
        "stribeck_friction": lambda: {
            "tau_c": s["tau_c"],
            "tau_s": 3.0 * s["tau_c"],
            "v_s": 0.3 * wide[rig.dof + index],
        },
        "concave_friction": lambda: {"b": 3.0 * s["b"], "v_s": 0.5 * wide[rig.dof + index]},
        "load_dependent_friction": lambda: {"tau_c": 0.3 * s["tau_c"], "mu": min(s["mu"], 0.9)},
        "stiffness": lambda: {"k": s["k"], "q0": 0.3 * wide[index]},
        "cogging": lambda: {
            "amplitude": s["amplitude"],
            "period": float(np.clip(wide[index], 0.1, 1.0)),
            "phase": 0.3 * float(np.clip(wide[index], 0.1, 1.0)),
        },
        "constant_force": lambda: {"tau_0": side * s["tau_0"]},
        "torque_gain": lambda: {"gain": max(1.0 + side * s["gain"], 0.3)},
        "directional_gain": lambda: {"gain_pos": max(1.0 - s["gain_pos"], 0.3), "gain_neg": 1.0},
        "saturation": lambda: {"limit": torque * (1.0 - 0.08 * factor)},
        "sensor_bias": lambda: {"bias": side * s["bias"]},
        "sensor_scale": lambda: {"scale": 1.0 + side * min(s["scale"], 0.3)},
        "motor_lag": lambda: {"time_constant": min(s["time_constant"], 0.3)},
        "action_delay": lambda: {"delay": _late(s["delay"])},
        "sensor_delay": lambda: {"delay": _late(s["delay"])},
        "joint_elasticity": lambda: {
            "k": torque / lead,
            "d": 0.2 * np.sqrt(torque / lead * 0.25 * rig.inertia),
        },
        "backlash": lambda: {"gap": lead},
        "sign_flip": lambda: {"flipped": 1.0},
        "reversed_joint": lambda: {"flipped": 1.0},
    }.get(kind, lambda: s)
    try:
        sizes = {name: float(value) for name, value in values().items()}
    except KeyError:
        sizes = {}
    # There is no detection limit for an effect that the diagnosis does not try here.
    return Planted(kind, index, sizes or {"size": np.nan})


def _late(delay: float) -> float:
    """Round a delay [s] to the steps of the engine, a millisecond."""
    return max(round(min(delay, 0.15), 3), 0.001) if np.isfinite(delay) else np.nan


def _outside(case: Case, kind: str, rng: np.random.Generator) -> Planted:
    """An effect outside the catalogue, its size in detection limits of the most similar effect."""
    joints, limits = nominal_twin(case.system).joints, smallest(case)
    index = int(rng.integers(len(joints)))

    def size(effect: str, name: str) -> float:
        found = limits.get(f"{effect}.{joints[index].name}", {}).get(name) or np.nan
        return case.factor * found

    def met(edge: str, share: float) -> dict[str, float]:
        """An edge that joints are beyond in the rest of the time, and what it adds to a spring."""
        q = _positions(case.system)[:, index]
        at = float(np.quantile(np.abs(q) if edge == "slack" else q, share))
        moments = (Moment(x, 0.0, 0.0, 0.0, 0.0, {}) for x in q)
        force = np.array([FORCES[kind](moment, **{"k": 1.0, edge: at}) for moment in moments])
        return {"k": size("stiffness", "k") / _above_a_spring(q, force), edge: at}

    wide = spread(case.system)[index]
    values = {
        "position_dependent_friction": lambda: {
            "tau_c": size("coulomb_friction", "tau_c"),
            "period": 2.0 * wide,
        },
        "hysteresis": lambda: {
            "slip": 0.3 * wide,
            "stiffness": size("coulomb_friction", "tau_c") / (0.3 * wide),
        },
        "thermal_drift": lambda: {"rate": -size("viscous_friction", "b")},
        "soft_impact": lambda: met("wall", 0.75),
        "cable_spring": lambda: met("slack", 0.6),
    }[kind]()
    return Planted(kind, index, {name: float(value) for name, value in values.items()})


def _above_a_spring(q: np.ndarray, force: np.ndarray) -> float:
    """What a spring and a constant leave of a force, in units of a spring of 1 N m/rad."""
    known = np.stack([np.ones_like(q), q], axis=1)
    remainder = force - known @ np.linalg.lstsq(known, force, rcond=None)[0]
    return float(remainder.std() / q.std())


@functools.cache
def _positions(system: str) -> np.ndarray:
    """:return: positions of all joints without planted effects"""
    obs, _ = simulate(RIGS[system], [], n_recordings=8, n_steps=N_STEPS, seed=1)
    return np.concatenate(obs)[:, : RIGS[system].dof]


@functools.cache
def nominal_twin(system: str, seen: str = "qv") -> Any:
    """
    :param seen: ``"q"`` if positions are observed only
    :return: the twin under diagnosis
    """
    from sb3_hds import twins

    name, values = RIGS[system].twin
    if system in FROM_FILES:
        # Runge-Kutta steps of 4 ms agree with those of 1 ms, at a quarter of the cost.
        made, dt = twins.from_mujoco(RIGS[system].xml), RIGS[system].dt
        return twins.MechanismTwin(made.mechanism, dt=dt, substeps=_SUBSTEPS, observe=seen)
    observe = {"observe": "q"} if seen == "q" else {}
    return twins.make(name, dt=RIGS[system].dt, **values | observe)


def base_value(system: str) -> float:
    base = RIGS[system].base
    assert base is not None
    return nominal_twin(system).values[base[0]]


@functools.cache
def spread(system: str) -> np.ndarray:
    """:return: standard deviation of each channel without planted effects"""
    obs, _ = simulate(RIGS[system], [], n_recordings=8, n_steps=N_STEPS, seed=1)
    return np.concatenate(obs).std(0)


def sensed(true: np.ndarray, system: str, noise: str, chance: np.ndarray) -> np.ndarray:
    """
    :param true: shape ``(..., channels)``
    :param chance: standard normal numbers, likewise
    :return: what sensors report
    """
    error = NOISES[noise] * spread(system)
    if noise == "tick":
        tick = np.sqrt(12.0) * error
        return tick * np.round(true / tick)
    return true + error * chance


def recorded(
    case: Case, seed: int, loop: Loop | None = None, harder: np.ndarray | float = 1.0
) -> tuple[Any, np.ndarray]:
    """
    :param loop: that computes commands from what sensors report; default: none
    :param harder: by how much commands without a loop are larger than this rig's usual ones
    :return: data of a case, and positions and velocities as the sensors would best show them
    """
    from sb3_hds import Trajectories

    rng, shape = np.random.default_rng([seed, 1]), (case.n_steps + 1, len(spread(case.system)))
    chances = [rng.standard_normal(shape) for _ in range(case.recordings)]
    sense = lambda recording, rows, true: sensed(  # noqa: E731
        true, case.system, case.noise, chances[recording][rows]
    )
    rig = RIGS[case.system]
    torque = tuple(map(float, harder * np.array(rig.torque)))
    obs, actions = simulate(
        dataclasses.replace(rig, torque=torque),
        list(case.planted),
        n_recordings=case.recordings,
        n_steps=case.n_steps,
        seed=seed,
        base_change=case.base_change,
        disturbance=case.disturbance,
        excited=case.kind != "still",
        loop=loop and loop._replace(sense=sense),
    )
    noisy = [sense(recording, slice(None), o) for recording, o in enumerate(obs)]
    if case.seen == "q":
        noisy = [o[:, : rig.dof] for o in noisy]
    data = Trajectories.from_arrays(noisy, actions, dt=rig.dt)
    return data, np.concatenate([o[:-1] for o in obs])


def nothing(system: str, noise: str, disturbance: float = 0.0, recordings: int = 10) -> Case:
    """:return: a case without anything planted"""
    return Case(system, 0, "null", (), 0.0, noise, recordings, False, 0.0, disturbance, asked=False)


def smallest(case: Case) -> dict[str, dict[str, float]]:
    """
    What data of this rig, with such noise, such a disturbance and such nuisances, but with nothing
    planted, would have shown: ``Diagnosis.detectable``, kept from call to call.
    """
    label = f"{case.system}_{case.noise.replace(' ', '')}_{case.disturbance:g}"
    path = CACHE / "smallest" / f"{label}{'_calibrated' if case.wrong_base else ''}.json"
    if not path.exists():
        from sb3_hds import diagnose

        data, _ = recorded(nothing(case.system, case.noise, case.disturbance), seed=99)
        found = diagnose(
            nominal_twin(case.system),
            data,
            calibrate=case.nuisances,
            budget="quick",
            progress=False,
        )
        write(path, json.dumps(found.to_dict()["detectable"]))
    return json.loads(path.read_text())


def write(path: Path, text: str) -> None:
    """Write atomically, also if several processes write the same file."""
    import os

    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_suffix(f".{os.getpid()}.tmp")
    temporary.write_text(text)
    temporary.replace(path)


assert set(JOINT) - set(FORCES) == {"viscous_friction", "coulomb_friction", "stiffness"}
