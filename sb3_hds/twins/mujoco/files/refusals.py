"""Errors for features of a model that its twin does not simulate, with the remedy."""

from collections.abc import Collection
from typing import Any

import numpy as np

from sb3_hds.errors import ModelFileError, first_names
from sb3_hds.twins.mujoco.files.locking import Coupling, Locks, couplings_of, joint_name
from sb3_hds.twins.mujoco.files.reading import n_actuators
from sb3_hds.twins.mujoco.library import mujoco

#: features that a twin may omit on request
IGNORABLE = ("contacts", "equality", "fluid", "limits", "tendons")


def refuse(
    model: Any,
    integrator: str,
    ignore: Collection[str],
    locks: Locks,
    mimics: Collection[Coupling] = (),
) -> None:
    """
    :param model: compiled
    :param integrator: that the twin will have
    :param ignore: of :data:`IGNORABLE`
    :param locks: joints that the twin will have locked
    :param mimics: couplings of joints that the model does not have as equality constraints
    :raises ModelFileError: for all unsupported features, a line each
    """
    unknown = [name for name in ignore if name not in IGNORABLE]
    if unknown:
        raise ModelFileError(
            f"ignore takes {', '.join(IGNORABLE)}, got {', '.join(map(str, unknown))}."
        )
    found = [
        f"{reason} To leave them out, pass ignore=['{name}']."
        for name, reason in _ignorable(model, locks, mimics).items()
        if name not in ignore
    ]
    found += _never(model, integrator, locks)
    if found:
        raise ModelFileError("This model cannot become a twin:\n" + "\n".join(found))


def _ignorable(model: Any, locks: Locks, mimics: Collection[Coupling]) -> dict[str, str]:
    found = {}
    touching = contacts(model, locks.groups)
    if touching:
        found["contacts"] = (
            f"Contacts can happen ({first_names(touching)}), which the twin does not simulate "
            "(engine='mujoco' does)."
        )
    constraints = _constraints(model, locks, mimics)
    if constraints:
        found["equality"] = " ".join(constraints)
    tendons = [t for t in range(model.ntendon) if t not in locks.tendons]
    if tendons:
        names = [model.tendon(t).name or f"tendon {t}" for t in tendons]
        found["tendons"] = f"Tendons pull ({first_names(names)}), which the twin does not simulate."
    if model.opt.density or model.opt.viscosity:
        found["fluid"] = (
            f"A medium of density {model.opt.density:g} and viscosity {model.opt.viscosity:g} "
            "resists, and the twin has none (the effect quadratic_drag may serve)."
        )
    return found


def _constraints(model: Any, locks: Locks, mimics: Collection[Coupling]) -> list[str]:
    """Messages for equality constraints: couplings of joints, and all others."""
    if not _enabled(model, "EQUALITY"):
        return []
    locked = {joint_name(model, j) for j in locks.positions}
    coupled = [c for c in (*couplings_of(model), *mimics) if {c.follower, c.leader} - {""} - locked]
    found = []
    if coupled:
        pairs = [f"{c.follower} follows {c.leader or 'a constant'}" for c in coupled]
        joints = dict.fromkeys(name for c in coupled for name in (c.leader, c.follower) if name)
        found.append(
            f"Joints are coupled ({first_names(pairs)}), which the twin does not simulate: they "
            f"would move independently. If they stand still in the data, pass lock={[*joints]}."
        )
    kind = int(mujoco().mjtEq.mjEQ_JOINT)
    active = [
        model.equality(i).name or f"equality {i}"
        for i in np.flatnonzero(model.eq_active0).tolist()
        if i not in locks.equalities and int(model.eq_type[i]) != kind
    ]
    if active:
        found.append(
            f"Constraints close chains ({first_names(active)}), which the twin does not simulate: "
            "their parts would move independently."
        )
    return found


def _never(model: Any, integrator: str, locks: Locks) -> list[str]:
    """Messages for features that cannot be omitted."""
    mj = mujoco()
    found = []
    if model.nflex:
        found.append("Bodies that bend (flex) are no rigid bodies. Remove them from the model.")
    if getattr(model, "nplugin", 0):
        found.append("Plugins are programs that the twin does not have. Remove them.")
    alone = _floating_alone(model, locks)
    if alone and integrator == "implicitfast":
        found.append(
            "MuJoCo's implicitfast is another one for a body that floats alone "
            f"({first_names(alone)}). Pass integrator='euler' or 'rk4'."
        )
    on = [int(mj.mjtTrn.mjTRN_JOINT), int(mj.mjtTrn.mjTRN_JOINTINPARENT)]
    # Not all versions of MuJoCo have all of these.
    gains = [getattr(mj.mjtGain, f"mjGAIN_{name}", None) for name in ("MUSCLE", "SO3", "USER")]
    special = [int(gain) for gain in gains if gain is not None]
    kinds = {
        "with internal dynamics": model.actuator_actnum > 0,
        "that are not attached to a joint": ~np.isin(model.actuator_trntype, on),
        "that are muscles or turn an orientation": np.isin(model.actuator_gaintype, special),
        "with a delay": getattr(model, "actuator_delay", np.zeros(n_actuators(model))) > 0.0,
    }
    hints = {
        "with internal dynamics": "A filter is the effect motor_lag: make it a motor or servo.",
        "with a delay": "Remove it and attach the effect action_delay.",
    }
    for words, wrong in kinds.items():
        acting = [i for i in np.flatnonzero(wrong).tolist() if i not in locks.actuators]
        names = [model.actuator(i).name or f"actuator {i}" for i in acting]
        if names:
            hint = hints.get(words, "Use motors, position, velocity or dcmotor on joints.")
            found.append(f"The twin has no actuators {words} ({first_names(names)}). {hint}")
    gravcomp = np.flatnonzero(
        getattr(model, "jnt_actgravcomp", np.zeros(model.njnt)) & model.jnt_actfrclimited
    )
    names = [joint_name(model, j) for j in gravcomp.tolist() if j not in locks.positions]
    if names and np.any(model.body_gravcomp):
        found.append(
            f"Actuators with a limit compensate gravity ({first_names(names)}). "
            "Set actgravcomp='false'."
        )
    return found


def contacts(model: Any, groups: np.ndarray) -> list[str]:
    """
    :param groups: for each body, the first body that is rigid with it
    :return: pairs of geoms, or of their bodies, that may touch
    """
    if not (_enabled(model, "CONTACT") and _enabled(model, "CONSTRAINT")):
        return []
    body, weld = model.geom_bodyid, groups
    own, other = np.triu_indices(model.ngeom, 1)
    kinds, affinities = model.geom_contype, model.geom_conaffinity
    meeting = (kinds[own] & affinities[other]) | (kinds[other] & affinities[own])
    one, two = weld[body[own]], weld[body[other]]
    separate = one != two
    if _enabled(model, "FILTERPARENT"):
        parent = weld[model.body_parentid[weld]]
        above = (one != 0) & (two != 0)
        separate &= ~(above & ((one == parent[body[other]]) | (two == parent[body[own]])))
    low, high = np.minimum(body[own], body[other]), np.maximum(body[own], body[other])
    pair = (low.astype(np.int64) << 16) + high
    separate &= ~np.isin(pair, model.exclude_signature[: model.nexclude])
    found = [(int(own[i]), int(other[i])) for i in np.flatnonzero((meeting > 0) & separate)]
    found += [(int(model.pair_geom1[i]), int(model.pair_geom2[i])) for i in range(model.npair)]
    return [f"{_geom(model, a)} and {_geom(model, b)}" for a, b in found]


def _geom(model: Any, i: int) -> str:
    body = int(model.geom_bodyid[i])
    return model.geom(i).name or model.body(body).name or f"body {body}"


def _floating_alone(model: Any, locks: Locks) -> list[str]:
    """Bodies with a free joint that carry no joint."""
    found = []
    for j in np.flatnonzero(model.jnt_type == 0).tolist():
        body = int(model.jnt_bodyid[j])
        if j in locks.positions:
            continue
        if model.body_subtreemass[body] == model.body_mass[body]:
            found.append(model.body(body).name or f"body {body}")
    return found


def _enabled(model: Any, name: str) -> bool:
    mj = mujoco()
    return not model.opt.disableflags & getattr(mj.mjtDisableBit, f"mjDSBL_{name}")
