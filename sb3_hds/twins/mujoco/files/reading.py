"""Read a mechanism from a compiled model of MuJoCo."""

from typing import Any

import numpy as np

from sb3_hds.errors import ParameterError
from sb3_hds.twins.mujoco.files.locking import Locks, joint_name
from sb3_hds.twins.mujoco.library import mujoco
from sb3_hds.twins.mujoco.mechanism import (
    BALL,
    FREE,
    HINGE,
    SIZES,
    SLIDE,
    Body,
    Drive,
    Link,
    Mechanism,
    Place,
)

_KINDS = (FREE, BALL, SLIDE, HINGE)  # mjtJoint
# Inputs of servos and motors with several inputs, in order: the bits of mjtInput.
_INPUTS = {"pos": 1, "vel": 2, "ff": 4, "voltage": 8}
# Numbers nearer to 0, 1 or -1 than this differ by rounding, as of pi / 2 in a URDF.
_ROUNDING = 1e-10
# Products of inertia below this share of the largest moment of inertia are rounding errors.
_OF_INERTIA = 1e-13


def read(model: Any, *, integrator: str | None = None, locks: Locks | None = None) -> Mechanism:
    """
    :param model: compiled, without unsupported features
    :param integrator: instead of the model's: ``"euler"``, ``"implicitfast"`` or ``"rk4"``
    :param locks: joints that the mechanism does not have: what they carry is rigid
    :raises ParameterError: for another integrator
    """
    mj = mujoco()
    locks = Locks.of(model, {}) if locks is None else locks
    data = mj.MjData(model)
    data.qpos[:] = locks.qpos(model)
    mj.mj_kinematics(model, data)
    mj.mj_comPos(model, data)
    off = _disabled(model)
    frames: dict[int, tuple[np.ndarray, np.ndarray]] = {-1: (np.eye(3), np.zeros(3))}
    links: list[dict[str, Any]] = []
    carried: list[list[int]] = []
    link_of_body, link_of_joint = {0: -1}, {}
    q = v = 0
    for b in range(1, model.nbody):
        last = link_of_body[int(model.body_parentid[b])]
        for j in range(model.body_jntadr[b], model.body_jntadr[b] + model.body_jntnum[b]):
            if j in locks.positions:
                continue
            kind = _KINDS[int(model.jnt_type[j])]
            turned = kind in (BALL, FREE)
            frame = data.xmat[b].reshape(3, 3) if turned else _with_z_along(data.xaxis[j])
            anchor = data.xpos[b] if kind == FREE else data.xanchor[j]
            outer, at = frames[last]
            frames[len(links)] = (frame, anchor)
            turn, way = outer.T @ frame, outer.T @ (anchor - at)
            links.append(_link(model, j, kind, last, turn, way, off) | {"q": q, "v": v})
            q, v = q + SIZES[kind][0], v + SIZES[kind][1]
            carried.append([])
            last = link_of_joint[j] = len(links) - 1
        link_of_body[b] = last
        if last >= 0:
            carried[last].append(b)
    bodies = [_body(model, data, own, *frames[i]) for i, own in enumerate(carried)]
    start = model.key_qpos[0] if model.nkey else model.qpos0
    return Mechanism(
        name=_name_of(model),
        links=tuple(Link(**link, body=body) for link, body in zip(links, bodies, strict=True)),
        drives=tuple(_drives(model, link_of_joint, off, locks)),
        places=tuple(_places(model, data, link_of_body, frames)),
        gravity=(0.0, 0.0, 0.0) if "GRAVITY" in off else _numbers(model.opt.gravity),
        timestep=float(model.opt.timestep),
        integrator=_integrator(model, integrator),
        implicit_damping="EULERDAMP" not in off,
        start=_numbers(
            np.concatenate([start[:0], *(start[_in_qpos(model, j)] for j in link_of_joint)])
        ),
        locked=tuple(
            (joint_name(model, j), _numbers(locks.positions[j])) for j in sorted(locks.positions)
        ),
    )


def _in_qpos(model: Any, j: int) -> slice:
    at = int(model.jnt_qposadr[j])
    return slice(at, at + SIZES[_KINDS[int(model.jnt_type[j])]][0])


def integrator_of(model: Any) -> str:
    """:return: name of the model's integrator, in lower case"""
    mj = mujoco()
    return mj.mjtIntegrator(model.opt.integrator).name.removeprefix("mjINT_").lower()


def _integrator(model: Any, wanted: str | None) -> str:
    found = integrator_of(model) if wanted is None else str(wanted).lower()
    if found not in ("euler", "implicitfast", "rk4"):
        raise ParameterError(
            f"The integrator '{found}' is not supported: pass integrator='implicitfast', 'euler' "
            "or 'rk4'."
        )
    return found


def _disabled(model: Any) -> set[str]:
    mj = mujoco()
    bits = mj.mjtDisableBit
    names = ("SPRING", "DAMPER", "GRAVITY", "CLAMPCTRL", "ACTUATION", "EULERDAMP")
    return {name for name in names if model.opt.disableflags & getattr(bits, f"mjDSBL_{name}")}


def _link(
    model: Any, j: int, kind: str, parent: int, turn: Any, way: Any, off: set[str]
) -> dict[str, Any]:
    q, v = int(model.jnt_qposadr[j]), int(model.jnt_dofadr[j])
    n_q, n_v = SIZES[kind]
    single, free = kind in (HINGE, SLIDE), kind == FREE
    armature, damping = _of_actuators(model, j)
    dampings = _with_powers(model, "dof_damping")[v : v + n_v] + damping
    spring = _with_powers(model, "jnt_stiffness")[j]
    pushed = single and bool(model.jnt_actfrclimited[j])
    return {
        "joint": joint_name(model, j),
        "kind": kind,
        "parent": parent,
        "rotation": _rows(np.eye(3) if free else _rounded(turn)),
        "origin": _numbers(np.zeros(3) if free else _rounded(way)),
        "reference": float(model.qpos0[q]) if single else 0.0,
        "stiffness": () if "SPRING" in off else _trimmed(spring),
        "rest": _numbers(model.qpos_spring[q : q + n_q]),
        "damping": tuple(() if "DAMPER" in off else _trimmed(row) for row in dampings),
        "armature": _numbers(model.dof_armature[v : v + n_v] + armature),
        "friction": _numbers(model.dof_frictionloss[v : v + n_v]),
        "force_limit": _numbers(model.jnt_actfrcrange[j]) if pushed else None,
        "limit": _numbers(model.jnt_range[j]) if single and model.jnt_limited[j] else None,
    }


def _with_powers(model: Any, name: str) -> np.ndarray:
    """A coefficient and those of higher order, which older versions of MuJoCo lack."""
    linear = getattr(model, name)
    return np.column_stack([linear, getattr(model, f"{name}poly", np.zeros((len(linear), 0)))])


def _of_actuators(model: Any, j: int) -> tuple[float, Any]:
    """Armature and damping that the actuators of a joint add to it."""
    if not hasattr(model, "actuator_armature"):
        return 0.0, 0.0
    of_joint = np.isin(model.actuator_trntype, (0, 1)) & (model.actuator_trnid[:, 0] == j)
    squared = np.array([_gear(model, i)[0] ** 2 for i in np.flatnonzero(of_joint).tolist()])
    damping = _with_powers(model, "actuator_damping")[of_joint]
    return float(squared @ model.actuator_armature[of_joint]), squared @ damping


def _body(
    model: Any, data: Any, bodies: list[int], frame: np.ndarray, origin: np.ndarray
) -> Body | None:
    """All bodies that move with a link, as one body."""
    bodies = [b for b in bodies if model.body_mass[b] > 0.0]
    if not bodies:
        return None
    masses = model.body_mass[bodies]
    mass = masses.sum()
    centre = masses @ data.xipos[bodies] / mass
    inertia = np.zeros((3, 3))
    for b, own in zip(bodies, masses, strict=True):
        axes, way = data.ximat[b].reshape(3, 3), data.xipos[b] - centre
        inertia += axes @ np.diag(model.body_inertia[b]) @ axes.T
        inertia += own * (way @ way * np.eye(3) - np.outer(way, way))
    inertia = frame.T @ inertia @ frame
    inertia[np.abs(inertia) < _OF_INERTIA * np.abs(inertia).max()] = 0.0
    held = masses * model.body_gravcomp[bodies]
    where = frame.T @ (held @ (data.xipos[bodies] - origin)) / (held.sum() or 1.0)
    first = bodies[0]
    return Body(
        name=model.body(first).name or f"body{first}",
        mass=float(mass),
        centre=_numbers(_rounded(frame.T @ (centre - origin))),
        origin=_numbers(_rounded(frame.T @ (data.xpos[first] - origin))),
        rotation=_rows(_rounded(frame.T @ data.xmat[first].reshape(3, 3))),
        inertia=_numbers(inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]),
        gravcomp=(float(held.sum()), *_numbers(_rounded(where))) if held.any() else None,
    )


def _drives(model: Any, link_of_joint: dict[int, int], off: set[str], locks: Locks) -> list[Drive]:
    mj = mujoco()
    found = []
    for i in range(n_actuators(model)):
        if i in locks.actuators:
            continue
        joint = int(model.actuator_trnid[i, 0])
        width = {FREE: 6, BALL: 3}.get(_KINDS[int(model.jnt_type[joint])], 1)
        kind = mj.mjtGain(model.actuator_gaintype[i]).name.removeprefix("mjGAIN_").lower()
        inputs, first = _inputs(model, i, kind)
        gain, bias = model.actuator_gainprm[i], model.actuator_biasprm[i]
        biased = model.actuator_biastype[i] == mj.mjtBias.mjBIAS_AFFINE
        dead = "ACTUATION" in off or model.opt.disableactuator & 1 << int(model.actuator_group[i])
        found.append(
            Drive(
                name=model.actuator(i).name or f"motor{i}",
                kind=kind if kind in ("pid", "dcmotor") else "affine",
                link=link_of_joint[joint],
                gear=(0.0,) * width if dead else _numbers(_gear(model, i)[:width]),
                outer=int(model.actuator_trntype[i]) == mj.mjtTrn.mjTRN_JOINTINPARENT,
                inputs=inputs,
                ranges=tuple(
                    _numbers(model.actuator_ctrlrange[k])
                    if model.actuator_ctrllimited[k] and "CLAMPCTRL" not in off
                    else None
                    for k in range(first, first + len(inputs))
                ),
                gain=_numbers(gain[:3] if kind == "affine" else [gain[0], 0.0, 0.0]),
                bias=_numbers(bias[:3] if biased else np.zeros(3)),
                force_limit=_numbers(model.actuator_forcerange[i])
                if model.actuator_forcelimited[i]
                else None,
                motor=_motor(gain, bias) if kind == "dcmotor" else (),
            )
        )
    return found


def _inputs(model: Any, i: int, kind: str) -> tuple[tuple[str, ...], int]:
    """Names of an actuator's commands, and the index of the first."""
    if not hasattr(model, "actuator_ctrladr"):
        return ("",), i
    first = int(model.actuator_ctrladr[i])
    if kind not in ("pid", "dcmotor"):
        return ("",), first
    names = [name for name, bit in _INPUTS.items() if model.actuator_ctrlspec[i] & bit]
    return tuple(names), first


def _motor(gain: Any, bias: Any) -> tuple[tuple[str, float], ...]:
    names = ("resistance", "constant", "kp", "kd", "supply", "cogging", "poles", "phase")
    values = (*gain[[0, 1, 4, 6, 7]], *bias[:3])
    return tuple(zip(names, map(float, values), strict=True))


def n_actuators(model: Any) -> int:
    """:return: number of actuators, each of which may have several commands"""
    return int(getattr(model, "nactuator", model.nu))


def _gear(model: Any, i: int) -> np.ndarray:
    return model.actuator_gear[model.actuator_outadr[i] if hasattr(model, "nactuator") else i]


def _places(
    model: Any,
    data: Any,
    link_of_body: dict[int, int],
    frames: dict[int, tuple[np.ndarray, np.ndarray]],
) -> list[Place]:
    """Sites, and origins of bodies whose names no site has."""
    sites = [
        (model.site(i).name, int(model.site_bodyid[i]), data.site_xpos[i], data.site_xmat[i])
        for i in range(model.nsite)
    ]
    bodies = [(model.body(b).name, b, data.xpos[b], data.xmat[b]) for b in range(1, model.nbody)]
    taken = {name for name, *_ in sites}
    found = []
    for name, b, position, axes in (*sites, *(body for body in bodies if body[0] not in taken)):
        if name:
            frame, origin = frames[link_of_body[b]]
            found.append(
                Place(
                    name,
                    link_of_body[b],
                    _numbers(_rounded(frame.T @ (position - origin))),
                    _rows(_rounded(frame.T @ axes.reshape(3, 3))),
                )
            )
    return found


def _name_of(model: Any) -> str:
    return model.names[: model.names.index(b"\0")].decode() or "model"


def _with_z_along(axis: np.ndarray) -> np.ndarray:
    """A rotation whose last column is an axis; its entries are 0, 1 and -1 if possible."""
    axis = _rounded(axis / np.linalg.norm(axis))
    least = int(np.argmin(np.abs(axis)))
    x = np.eye(3)[least] - axis * axis[least]
    x = x / np.linalg.norm(x)
    return np.stack([x, np.cross(axis, x), axis], 1)


def _rounded(x: Any) -> np.ndarray:
    x = np.asarray(x, float)
    near = np.round(x)
    return np.where((np.abs(x - near) < _ROUNDING) & (np.abs(near) <= 1.0), near, x)


def _numbers(x: Any) -> Any:
    return tuple(float(value) for value in x)


def _rows(x: Any) -> Any:
    return tuple(_numbers(row) for row in x)


def _trimmed(x: Any) -> tuple[float, ...]:
    """Without the zeros at its end."""
    filled = np.flatnonzero(x)
    return _numbers(x[: filled[-1] + 1]) if len(filled) else ()
