"""A corrected twin as MJCF: the ``MjSpec`` of the source, with changes."""

import dataclasses
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from sb3_hds.errors import ModelFileError
from sb3_hds.twins.mujoco.files.correction import (
    DIGITS,
    OF_JOINTS,
    Correction,
    changed_bodies,
    in_body_frame,
)
from sb3_hds.twins.mujoco.files.load import spec_of
from sb3_hds.twins.mujoco.files.locking import Locks
from sb3_hds.twins.mujoco.files.reading import read
from sb3_hds.twins.mujoco.library import mujoco
from sb3_hds.twins.mujoco.mechanism import Drive, Link, Mechanism
from sb3_hds.twins.mujoco.parameters import gravity_of

# Share of a joint's motion that its dry friction may stop in a step: MuJoCo's impedance.
_IMPEDANCE = 0.99


def mjcf_of(correction: Correction, source: Any, target: Path) -> str:
    mj, mechanism = mujoco(), correction.mechanism
    spec, model, _ = spec_of(source)
    locks = Locks.named(model, mechanism.locked)
    file = read(model, integrator=mechanism.integrator, locks=locks)
    _check_same(mechanism, file)
    spec.option.timestep = correction.plant.dt / correction.plant.substeps
    spec.option.integrator = getattr(mj.mjtIntegrator, f"mjINT_{mechanism.integrator.upper()}")
    moving = [joint for joint in spec.joints if joint.id not in locks.positions]
    joints = sorted(moving, key=lambda joint: joint.id)
    for joint, link in zip(joints, mechanism.links, strict=True):
        _write_joint(correction, joint, link, float(spec.option.timestep))
    tilted = [n for n in correction.values if n.startswith("tilt_") and correction.difference(n)]
    if tilted:
        spec.option.gravity = np.array(gravity_of(mechanism, correction.values), float)
        for name in tilted:
            correction.record_change(name)
    _write_bodies(correction, spec, model, locks)
    drives = [_corrected(correction, drive) for drive in mechanism.drives]
    if [d.name for d in file.drives] == [d.name for d in mechanism.drives]:
        acting = [a for a in spec.actuators if a.id not in locks.actuators]
        actuators = sorted(acting, key=lambda actuator: actuator.id)
    else:
        for actuator in list(spec.actuators):
            if actuator.id not in locks.actuators:
                spec.delete(actuator)
        actuators = [_added(spec, joints[d.link], d) for d in mechanism.drives]
        correction.changed += [f"actuator {drive.name}" for drive in mechanism.drives]
    for actuator, drive, before in zip(actuators, drives, mechanism.drives, strict=True):
        # A damping ratio depends on the masses: write the damping that it meant in the source.
        by_ratio = drive.kind != "dcmotor" and float(actuator.biasprm[2]) > 0.0
        if drive != before or by_ratio:
            _write_gains(actuator, drive)
    _write_effects(correction, spec, actuators)
    if isinstance(source, os.PathLike) or not str(source).lstrip().startswith("<"):
        _keep_assets(spec, Path(str(source)), target)
    try:
        spec.compile()
    except ValueError as error:
        message = str(error).strip().splitlines()[0]
        raise ModelFileError(f"MuJoCo refuses the corrected model: {message}") from None
    return spec.to_xml()


def _check_same(mechanism: Mechanism, file: Mechanism) -> None:
    ours, theirs = ([link.joint for link in m.links] for m in (mechanism, file))
    if ours != theirs:
        raise ModelFileError(
            f"The source is that of another robot: its joints are {', '.join(theirs)}, and those "
            f"of {mechanism.name} are {', '.join(ours)}."
        )


def _write_joint(correction: Correction, joint: Any, link: Link, step: float) -> None:
    for name in OF_JOINTS:
        full = f"{link.joint}_{name}"
        change = correction.difference(full)
        if not change:
            continue
        # Damping and armature of actuators, which the twin adds, stay with them.
        now = np.array(getattr(joint, name), float)
        now.reshape(-1)[0] = max(0.0, round(float(now.reshape(-1)[0]) + change, DIGITS))
        setattr(joint, name, now if now.ndim else float(now))
        correction.record_change(full)
    if correction.values.get(f"{link.joint}_frictionloss", link.friction[0]) > 0.0:
        # By default MuJoCo's dry friction is viscous below some speed, a high one for light joints.
        # These settings stop a joint within a step instead, like the twin's friction.
        impedance = [_IMPEDANCE, _IMPEDANCE, *np.array(joint.solimp_friction)[2:]]
        joint.solimp_friction = np.array(impedance)
        joint.solref_friction = np.array([-1.0, -_IMPEDANCE / step])
        correction.changed.append(
            f"dry friction of {link.joint} holds within a step (solreffriction)"
        )


def _corrected(correction: Correction, drive: Drive) -> Drive:
    """The drive with calibrated gains."""
    own = {
        name: correction.values[f"{drive.name}_{name}"]
        for name in ("gain", "kp", "kv", "motorconst", "resistance")
        if correction.difference(f"{drive.name}_{name}")
    }
    for name in own:
        correction.record_change(f"{drive.name}_{name}")
    gain, bias, motor = list(drive.gain), list(drive.bias), dict(drive.motor)
    if "gain" in own:
        gain[0] = own["gain"]
    if "kp" in own:
        gain[0], bias[1] = own["kp"], -own["kp"]
    if "kv" in own:
        bias[2] = -own["kv"]
        gain[0] = own["kv"] if drive.role == "velocity" else gain[0]
    if "motorconst" in own:
        motor["constant"] = own["motorconst"]
    if "resistance" in own:
        motor["resistance"] = own["resistance"]
    return dataclasses.replace(
        drive, gain=tuple(gain), bias=tuple(bias), motor=tuple(motor.items())
    )


def _added(spec: Any, joint: Any, drive: Drive) -> Any:
    mj = mujoco()
    if not joint.name:
        raise ModelFileError("Joints without names cannot be driven by actuators. Name them.")
    actuator = spec.add_actuator(name=drive.name, target=joint.name)
    actuator.trntype = mj.mjtTrn.mjTRN_JOINT
    actuator.gear = np.array([*drive.gear, *np.zeros(6 - len(drive.gear))])
    actuator.gaintype = mj.mjtGain.mjGAIN_FIXED
    actuator.biastype = mj.mjtBias.mjBIAS_AFFINE if any(drive.bias) else mj.mjtBias.mjBIAS_NONE
    (limits,) = drive.ranges
    if limits is not None:
        actuator.ctrllimited, actuator.ctrlrange = True, np.array(limits)
    if drive.force_limit is not None:
        actuator.forcelimited, actuator.forcerange = True, np.array(drive.force_limit)
    _write_gains(actuator, drive)
    return actuator


def _write_gains(actuator: Any, drive: Drive) -> None:
    gain, bias = np.array(actuator.gainprm, float), np.array(actuator.biasprm, float)
    if drive.kind == "dcmotor":
        motor = dict(drive.motor)
        gain[:2] = motor["resistance"], motor["constant"]
    else:
        gain[0] = drive.gain[0]
        bias[:3] = drive.bias
        actuator.biasprm = bias
    actuator.gainprm = gain


def _write_effects(correction: Correction, spec: Any, actuators: list[Any]) -> None:
    firsts = np.cumsum([0, *(len(drive.inputs) for drive in correction.mechanism.drives)]).tolist()
    step = float(spec.option.timestep)
    for name, index, key, own in correction.effects:
        single = name in _OF_ACTUATORS and index in firsts[:-1]
        written = False
        if single:
            row = firsts.index(index)
            drive = correction.mechanism.drives[row]
            alone = len(drive.inputs) == 1
            written = alone and _OF_ACTUATORS[name](actuators[row], drive, own, step)
        correction.record_effect(key, own, written=written)


def _write_delay(actuator: Any, drive: Drive, own: Mapping[str, float], step: float) -> bool:
    """Since 3.5, MuJoCo can delay commands by samples, one for each step."""
    if not hasattr(actuator, "delay"):
        return False
    if own["delay"] > 0.0:
        actuator.delay = round(own["delay"], DIGITS)
        actuator.nsample = math.ceil(own["delay"] / step - 1e-9) + 1
    return True


def _write_lag(actuator: Any, drive: Drive, own: Mapping[str, float], step: float) -> bool:
    mj = mujoco()
    if own["time_constant"] > 0.0:
        actuator.dyntype = mj.mjtDyn.mjDYN_FILTEREXACT
        dynamics = np.array(actuator.dynprm, float)
        dynamics[0] = round(own["time_constant"], DIGITS)
        actuator.dynprm = dynamics
    return True


def _write_limit(actuator: Any, drive: Drive, own: Mapping[str, float], step: float) -> bool:
    """A limit of zero means no limit."""
    limit = own["limit"]
    if limit > 0.0:
        low, high = drive.ranges[0] or (-math.inf, math.inf)
        actuator.ctrllimited = True
        actuator.ctrlrange = np.array([max(low, -limit), min(high, limit)])
    return True


def _write_gain(actuator: Any, drive: Drive, own: Mapping[str, float], step: float) -> bool:
    """For a servo: the gain of its target."""
    if drive.kind != "affine":
        return False
    gain = np.array(actuator.gainprm, float)
    gain[:3] *= own["gain"]
    actuator.gainprm = gain
    return True


_OF_ACTUATORS = {
    "action_delay": _write_delay,
    "motor_lag": _write_lag,
    "saturation": _write_limit,
    "torque_gain": _write_gain,
}


def _write_bodies(correction: Correction, spec: Any, model: Any, locks: Locks) -> None:
    """Bodies that are rigidly attached to one joint are one body of the twin: change the first."""
    wanted = changed_bodies(correction)
    if not wanted:
        return
    mj, mechanism = mujoco(), correction.mechanism
    by_id = {body.id: body for body in spec.bodies}
    moving = [j for j in range(model.njnt) if j not in locks.positions]
    link_of: dict[int, int] = {0: -1}
    for b in range(1, model.nbody):
        begin = int(model.body_jntadr[b])
        own = [
            moving.index(j) for j in range(begin, begin + int(model.body_jntnum[b])) if j in moving
        ]
        link_of[b] = own[-1] if own else link_of[int(model.body_parentid[b])]
    data = mj.MjData(model)
    data.qpos[:] = locks.qpos(model)
    mj.mj_kinematics(model, data)
    for i, new in wanted.items():
        link = mechanism.links[i]
        assert link.body is not None
        first, *others = (b for b, at in link_of.items() if at == i and model.body_mass[b] > 0.0)
        # Total mass, first and second moments in the frame of the first body, ...
        mass, centre, second = in_body_frame(link.body, new)
        second = second + mass * np.outer(centre, centre)
        axes, at = data.xmat[first].reshape(3, 3), data.xpos[first]
        moment = mass * centre
        # ... less those of the other bodies.
        for b in others:
            other, held = data.ximat[b].reshape(3, 3), float(model.body_mass[b])
            place = axes.T @ (data.xipos[b] - at)
            inertia = axes.T @ other @ np.diag(model.body_inertia[b]) @ other.T @ axes
            mass, moment = mass - held, moment - held * place
            second = second - (0.5 * np.trace(inertia) * np.eye(3) - inertia)
            second = second - held * np.outer(place, place)
        _write_inertial(correction, by_id[first], mass, moment, second)


def _write_inertial(
    correction: Correction, body: Any, mass: float, moment: np.ndarray, second: np.ndarray
) -> None:
    centre = moment / mass if mass > 0.0 else np.zeros(3)
    about = second - mass * np.outer(centre, centre)
    if mass <= 0.0 or np.linalg.eigvalsh(about)[0] < 0.0:
        correction.left_out.append(f"mass and inertia of {body.name}: its rigid parts outweigh it")
        return
    inertia = np.trace(about) * np.eye(3) - about
    body.explicitinertial = True
    body.mass = mass
    body.ipos = centre
    body.fullinertia = inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    correction.changed.append(f"inertial of {body.name}: {mass:.6g} kg")


def _keep_assets(spec: Any, source: Path, target: Path) -> None:
    """Make relative paths of meshes and textures valid in the target's folder."""
    there, here = source.resolve().parent, target.resolve().parent
    if there == here or not (spec.meshes or spec.hfields or spec.textures or spec.skins):
        return
    for name in ("meshdir", "texturedir"):
        old = getattr(spec.compiler, name) or ""
        if not os.path.isabs(old):
            setattr(spec.compiler, name, Path(os.path.relpath(there / old, here)).as_posix())
