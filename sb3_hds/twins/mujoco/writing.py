"""A corrected twin back into the model file of its robot: as MJCF, or as URDF where that can."""

import dataclasses
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from sb3_hds.core import ExtendedTwin, Twin
from sb3_hds.core.extended import with_native
from sb3_hds.core.trajectories.storage import check_target, write_bytes
from sb3_hds.core.twin import layers_of, plant_of
from sb3_hds.errors import ModelFileError
from sb3_hds.twins.mujoco import algebra as alg
from sb3_hds.twins.mujoco import dynamics
from sb3_hds.twins.mujoco.library import mujoco
from sb3_hds.twins.mujoco.load import spec_of
from sb3_hds.twins.mujoco.mechanism import Drive, Link, Mechanism
from sb3_hds.twins.mujoco.parameters import bodies_of, gravity_of
from sb3_hds.twins.mujoco.reading import read
from sb3_hds.twins.mujoco.twin import MechanismTwin

_OF_JOINTS = ("damping", "frictionloss", "armature", "stiffness")
_DIGITS = 9
# Share of a joint's motion that its dry friction may stop in a step: MuJoCo's impedance.
_DAMPED = 0.99
# Smaller changes of a body, relative to it, are rounding.
_SAME = 1e-12


@dataclasses.dataclass(frozen=True)
class Written:
    """
    :param path: of the file
    :param changed: what is in it that the source did not say, a line each
    :param left_out: what the twin has and such a file cannot say, a line each
    """

    path: Path
    changed: tuple[str, ...]
    left_out: tuple[str, ...]

    def __str__(self) -> str:
        kind = "URDF" if self.path.suffix.lower() == ".urdf" else "MJCF"
        lines = [f"{self.path} holds the corrected model: {len(self.changed)} changes."]
        if self.left_out:
            lines += [f"{kind} does not say:", *(f"  {line}" for line in self.left_out)]
        return "\n".join(lines)


def write_model(twin: Twin, path: str | os.PathLike[str], source: Any) -> Written:
    """
    Write a calibrated or extended twin of a model file as such a file: its source, corrected.

    An MJCF file carries friction loss, damping, armature, stiffness, gains, gravity, masses with
    centres and inertias, a payload, and delays, time constants and limits of actuators; besides,
    the step and the integrator of the twin, so that ``mj_step``, ``substeps`` times a control
    interval, does what the twin does. Dry friction is MuJoCo's then, at which a joint sticks. A
    URDF carries damping, friction and inertials; what a file cannot say is listed. Meshes that are
    missing are left out of MJCF.

    :param twin: made by ``twins.from_mujoco``, with other parameters, or with effects
    :param path: ``.xml`` or ``.mjcf`` for MJCF, ``.urdf`` for a URDF, which needs one as its source
    :param source: of the twin: path or text of an MJCF or URDF file, or an ``MjSpec``
    :raises ModelFileError: for another twin, or another robot than the twin's
    :raises OSError: if the file cannot be written
    """
    target = Path(path)
    check_target(target)
    plant = plant_of(twin)
    if not isinstance(plant, MechanismTwin):
        raise ModelFileError(
            f"{twin.name} was not made from a model file, so there is none to correct. Save its "
            "numbers: twin.to_spec()."
        )
    kind = target.suffix.lower()
    if kind not in (".xml", ".mjcf", ".urdf"):
        raise ModelFileError(f"A model file ends in .xml, .mjcf or .urdf, not in '{kind}'.")
    said = _Said.of(twin, plant)
    content = _urdf(said, source) if kind == ".urdf" else _mjcf(said, source, target)
    write_bytes(target, content.encode())
    return Written(target, tuple(said.changed), tuple(said.left_out))


@dataclasses.dataclass
class _Said:
    """
    What a file has to say.

    :param values: of the plant, with what effects add to them
    :param effects: others: name, index and place of each, with its values
    """

    plant: MechanismTwin
    values: dict[str, float]
    effects: list[tuple[str, int, str, dict[str, float]]]
    changed: list[str] = dataclasses.field(default_factory=list)
    left_out: list[str] = dataclasses.field(default_factory=list)

    @classmethod
    def of(cls, twin: Twin, plant: MechanismTwin) -> "_Said":
        values = {name: float(twin.values.get(name, plant.values[name])) for name in plant.values}
        found = cls(plant, values, [])
        for layer in layers_of(twin):
            if layer is plant:
                continue
            if not isinstance(layer, ExtendedTwin):
                found.left_out.append(f"{type(layer).__name__}, a layer around the twin")
                continue
            for a in layer.attached:
                own = {name: float(layer.values[f"{a.key}.{name}"]) for name in a.effect.parameters}
                native = plant.native_effects.get((a.effect.name, a.index))
                if native is None:
                    found.effects.append((a.effect.name, a.index, a.key, own))
                    continue
                for name, target in native.items():
                    parameter = a.effect.parameters[name]
                    values[target] = float(with_native(values[target], own[name], parameter))
        return found

    @property
    def mechanism(self) -> Mechanism:
        return self.plant.mechanism

    def difference(self, name: str) -> float:
        """:return: from the value that the file has"""
        if name not in self.values:
            return 0.0
        return self.values[name] - self.plant.parameters[name].null

    def told(self, name: str) -> None:
        parameter = self.plant.parameters[name]
        value, unit = self.values[name], parameter.unit
        self.changed.append(f"{name}: {value:.6g} {unit} (was {parameter.null:.6g})")

    def lacking(self, name: str) -> None:
        self.left_out.append(f"{name}: {self.values[name]:.6g} {self.plant.parameters[name].unit}")


# --- MJCF


def _mjcf(said: _Said, source: Any, target: Path) -> str:
    mj, mechanism = mujoco(), said.mechanism
    spec, model, _ = spec_of(source)
    file = read(model, integrator=mechanism.integrator)
    _check_same(mechanism, file)
    spec.option.timestep = said.plant.dt / said.plant.substeps
    spec.option.integrator = getattr(mj.mjtIntegrator, f"mjINT_{mechanism.integrator.upper()}")
    by_id = {joint.id: joint for joint in spec.joints}
    for index, link in enumerate(mechanism.links):
        _write_joint(said, by_id[index], link, float(spec.option.timestep))
    tilted = [name for name in said.values if name.startswith("tilt_") and said.difference(name)]
    if tilted:
        spec.option.gravity = np.array(gravity_of(mechanism, said.values), float)
        for name in tilted:
            said.told(name)
    _write_bodies(said, spec, model)
    drives = [_corrected(said, drive) for drive in mechanism.drives]
    if [d.name for d in file.drives] == [d.name for d in mechanism.drives]:
        actuators = sorted(spec.actuators, key=lambda actuator: actuator.id)
    else:
        for actuator in list(spec.actuators):
            spec.delete(actuator)
        actuators = [_added(spec, by_id[d.link], d) for d in mechanism.drives]
        said.changed += [f"actuator {drive.name}" for drive in mechanism.drives]
    for actuator, drive, before in zip(actuators, drives, mechanism.drives, strict=True):
        # A damping ratio is of the masses that the file came with; its damping stays what it was.
        by_ratio = drive.kind != "dcmotor" and float(actuator.biasprm[2]) > 0.0
        if drive != before or by_ratio:
            _write_gains(actuator, drive)
    _write_effects(said, spec, actuators)
    if isinstance(source, os.PathLike) or not str(source).lstrip().startswith("<"):
        _keep_assets(spec, Path(str(source)), target)
    try:
        spec.compile()
    except ValueError as error:
        told = str(error).strip().splitlines()[0]
        raise ModelFileError(f"MuJoCo refuses the corrected model: {told}") from None
    return spec.to_xml()


def _check_same(mechanism: Mechanism, file: Mechanism) -> None:
    ours, theirs = ([link.joint for link in m.links] for m in (mechanism, file))
    if ours != theirs:
        raise ModelFileError(
            f"The source is that of another robot: its joints are {', '.join(theirs)}, and those "
            f"of {mechanism.name} are {', '.join(ours)}."
        )


def _write_joint(said: _Said, joint: Any, link: Link, step: float) -> None:
    for name in _OF_JOINTS:
        full = f"{link.joint}_{name}"
        change = said.difference(full)
        if not change:
            continue
        # What actuators bring along stays theirs.
        now = np.array(getattr(joint, name), float)
        now.reshape(-1)[0] = max(0.0, round(float(now.reshape(-1)[0]) + change, _DIGITS))
        setattr(joint, name, now if now.ndim else float(now))
        said.told(full)
    if said.values.get(f"{link.joint}_frictionloss", link.friction[0]) > 0.0:
        # By default MuJoCo's dry friction is soft: below some speed, of a light joint a fast one,
        # it is viscous. The twin's is not, and so this stops what it can stop within a step.
        share = _DAMPED
        joint.solimp_friction = np.array([share, share, *np.array(joint.solimp_friction)[2:]])
        joint.solref_friction = np.array([-1.0, -share / step])
        said.changed.append(f"dry friction of {link.joint} holds within a step (solreffriction)")


def _corrected(said: _Said, drive: Drive) -> Drive:
    """With calibrated gains."""
    own = {
        name: said.values[f"{drive.name}_{name}"]
        for name in ("gain", "kp", "kv", "motorconst", "resistance")
        if said.difference(f"{drive.name}_{name}")
    }
    for name in own:
        said.told(f"{drive.name}_{name}")
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


def _write_effects(said: _Said, spec: Any, actuators: list[Any]) -> None:
    firsts = np.cumsum([0, *(len(drive.inputs) for drive in said.mechanism.drives)]).tolist()
    step = float(spec.option.timestep)
    for name, index, key, own in said.effects:
        single = name in _OF_ACTUATORS and index in firsts[:-1]
        row = firsts.index(index) if single else -1
        alone = single and len(said.mechanism.drives[row].inputs) == 1
        if alone and _OF_ACTUATORS[name](actuators[row], said.mechanism.drives[row], own, step):
            said.changed += [f"{key}.{short}: {value:.6g}" for short, value in own.items()]
        else:
            said.left_out += [f"{key}.{short}: {value:.6g}" for short, value in own.items()]


def _write_delay(actuator: Any, drive: Drive, own: Mapping[str, float], step: float) -> bool:
    """MuJoCo keeps samples of commands, one for each step, since 3.5."""
    if not hasattr(actuator, "delay"):
        return False
    if own["delay"] > 0.0:
        actuator.delay = round(own["delay"], _DIGITS)
        actuator.nsample = math.ceil(own["delay"] / step - 1e-9) + 1
    return True


def _write_lag(actuator: Any, drive: Drive, own: Mapping[str, float], step: float) -> bool:
    mj = mujoco()
    if own["time_constant"] > 0.0:
        actuator.dyntype = mj.mjtDyn.mjDYN_FILTEREXACT
        dynamics_of = np.array(actuator.dynprm, float)
        dynamics_of[0] = round(own["time_constant"], _DIGITS)
        actuator.dynprm = dynamics_of
    return True


def _write_limit(actuator: Any, drive: Drive, own: Mapping[str, float], step: float) -> bool:
    """A limit of zero is none."""
    limit = own["limit"]
    if limit > 0.0:
        low, high = drive.ranges[0] or (-math.inf, math.inf)
        actuator.ctrllimited = True
        actuator.ctrlrange = np.array([max(low, -limit), min(high, limit)])
    return True


def _write_gain(actuator: Any, drive: Drive, own: Mapping[str, float], step: float) -> bool:
    """Of a servo: its target counts for more, or less."""
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


def _write_bodies(said: _Said, spec: Any, model: Any) -> None:
    """What is rigidly carried by a joint is one body of the twin: the first of them changes."""
    wanted = _changed_bodies(said)
    if not wanted:
        return
    mj, mechanism = mujoco(), said.mechanism
    by_id = {body.id: body for body in spec.bodies}
    link_of: dict[int, int] = {0: -1}
    for b in range(1, model.nbody):
        n = int(model.body_jntnum[b])
        last = int(model.body_jntadr[b]) + n - 1
        link_of[b] = last if n else link_of[int(model.body_parentid[b])]
    data = mj.MjData(model)
    mj.mj_kinematics(model, data)
    for i, new in wanted.items():
        link = mechanism.links[i]
        assert link.body is not None
        own = [b for b, at in link_of.items() if at == i and model.body_mass[b] > 0.0]
        first = own[0]
        turn, origin = np.array(link.body.rotation), np.array(link.body.origin)
        # Of the whole, in the frame of the first body: mass, first and second moments.
        mass = float(new.mass)
        centre = turn.T @ (np.array([float(x) for x in new.centre]) - origin)
        second = turn.T @ np.array(alg.full(new.second_moments), float) @ turn
        second = second + mass * np.outer(centre, centre)
        axes, at = data.xmat[first].reshape(3, 3), data.xpos[first]
        moment = mass * centre
        for b in own[1:]:
            other, held = data.ximat[b].reshape(3, 3), float(model.body_mass[b])
            place = axes.T @ (data.xipos[b] - at)
            inertia = axes.T @ other @ np.diag(model.body_inertia[b]) @ other.T @ axes
            mass, moment = mass - held, moment - held * place
            second = second - (0.5 * np.trace(inertia) * np.eye(3) - inertia)
            second = second - held * np.outer(place, place)
        body = by_id[first]
        _write_inertial(said, body, mass, moment, second)


def _write_inertial(
    said: _Said, body: Any, mass: float, moment: np.ndarray, second: np.ndarray
) -> None:
    centre = moment / mass if mass > 0.0 else np.zeros(3)
    about = second - mass * np.outer(centre, centre)
    if mass <= 0.0 or np.linalg.eigvalsh(about)[0] < 0.0:
        said.left_out.append(f"mass and inertia of {body.name}: its rigid parts outweigh it")
        return
    inertia = np.trace(about) * np.eye(3) - about
    body.explicitinertial = True
    body.mass = mass
    body.ipos = centre
    body.fullinertia = inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    said.changed.append(f"inertial of {body.name}: {mass:.6g} kg")


def _changed_bodies(said: _Said) -> dict[int, dynamics.Body]:
    """:return: by link, what is not as the file has it"""
    mechanism, plant = said.mechanism, said.plant
    null = {name: parameter.null for name, parameter in plant.parameters.items()}
    with_body = [i for i, link in enumerate(mechanism.links) if link.body is not None]
    pairs = zip(
        with_body,
        *(bodies_of(mechanism, plant.payload, plant.masses, p) for p in (null, said.values)),
        strict=True,
    )
    return {i: new for i, old, new in pairs if not np.allclose(_flat(old), _flat(new), _SAME, 0.0)}


def _flat(body: dynamics.Body) -> np.ndarray:
    return np.array([body.mass, *body.centre, *body.second_moments], float)


def _keep_assets(spec: Any, source: Path, target: Path) -> None:
    """Meshes and textures stay where they are."""
    there, here = source.resolve().parent, target.resolve().parent
    if there == here or not (spec.meshes or spec.hfields or spec.textures or spec.skins):
        return
    for name in ("meshdir", "texturedir"):
        old = getattr(spec.compiler, name) or ""
        if not os.path.isabs(old):
            setattr(spec.compiler, name, Path(os.path.relpath(there / old, here)).as_posix())


# --- URDF


def _urdf(said: _Said, source: Any) -> str:
    text = str(source).lstrip()
    if not text.startswith("<"):
        file = Path(str(source))
        if not file.is_file():
            raise ModelFileError(f"There is no file '{file}'. Pass the URDF of the twin.")
        text = file.read_text(errors="replace")
    builder = ElementTree.TreeBuilder(insert_comments=True)
    try:
        robot = ElementTree.fromstring(text, ElementTree.XMLParser(target=builder))
    except ElementTree.ParseError as error:
        raise ModelFileError(f"The source is no XML: {error}.") from None
    if robot.tag != "robot":
        raise ModelFileError(
            "A URDF is written only where the twin comes from one. Write MJCF: name the file .xml."
        )
    joints = {joint.get("name"): joint for joint in robot.iter("joint")}
    for link in said.mechanism.links:
        _write_urdf_joint(said, joints.get(link.joint), link)
    links = {link.get("name"): link for link in robot.iter("link")}
    for i, new in _changed_bodies(said).items():
        body = said.mechanism.links[i].body
        assert body is not None
        _write_urdf_inertial(said, links.get(body.name), body, new)
    in_file = {f"{link.joint}_{name}" for link in said.mechanism.links for name in _OF_JOINTS[:2]}
    inertial = said.plant.masses or said.plant.payload is not None
    bodies = [link.body.name for link in said.mechanism.links if link.body] if inertial else []
    ends = ("_mass", "_com_", "_stretch_", "_shear_")
    in_bodies = {n for n in said.values for b in bodies for e in ends if n.startswith(f"{b}{e}")}
    in_bodies |= {name for name in said.values if "_payload" in name}
    for name in said.values:
        if said.difference(name) and name not in in_file | in_bodies:
            said.lacking(name)
    for _, _, key, own in said.effects:
        said.left_out += [f"{key}.{short}: {value:.6g}" for short, value in own.items()]
    body = ElementTree.tostring(robot, encoding="unicode")
    return f'<?xml version="1.0"?>\n{body}\n'


def _write_urdf_joint(said: _Said, joint: Any, link: Link) -> None:
    for name, attribute in (("damping", "damping"), ("frictionloss", "friction")):
        full = f"{link.joint}_{name}"
        if not said.difference(full):
            continue
        if joint is None:
            said.lacking(full)
            continue
        dynamics_of = joint.find("dynamics")
        if dynamics_of is None:
            dynamics_of = ElementTree.SubElement(joint, "dynamics")
            dynamics_of.tail = "\n"
        dynamics_of.set(attribute, f"{said.values[full]:.{_DIGITS}g}")
        said.told(full)


def _write_urdf_inertial(said: _Said, link: Any, body: Any, new: dynamics.Body) -> None:
    """Only where nothing else is rigidly carried: then the link is the twin's body."""
    own = None if link is None else link.find("inertial")
    mass = None if own is None else own.find("mass")
    told = math.nan if mass is None else float(mass.get("value", "nan"))
    if own is None or mass is None or not math.isclose(told, body.mass, rel_tol=1e-9):
        said.left_out.append(f"mass and inertia of {body.name}, which carries other links rigidly")
        return
    turn, origin = np.array(body.rotation), np.array(body.origin)
    centre = turn.T @ (np.array([float(x) for x in new.centre]) - origin)
    second = turn.T @ np.array(alg.full(new.second_moments), float) @ turn
    inertia = np.trace(second) * np.eye(3) - second
    number = lambda x: f"{float(x):.{_DIGITS}g}"  # noqa: E731
    mass.set("value", number(new.mass))
    place = own.find("origin")
    if place is None:
        place = ElementTree.SubElement(own, "origin")
    place.set("xyz", " ".join(map(number, centre)))
    place.set("rpy", "0 0 0")
    matrix = own.find("inertia")
    if matrix is None:
        matrix = ElementTree.SubElement(own, "inertia")
    for i, row in enumerate("xyz"):
        for j, column in enumerate("xyz"):
            if j >= i:
                matrix.set(f"i{row}{column}", number(inertia[i, j]))
    said.changed.append(f"inertial of {body.name}: {float(new.mass):.6g} kg")
