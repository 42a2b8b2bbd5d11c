"""A corrected twin as URDF: its damping, friction and inertials."""

import math
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from sb3_hds.errors import ModelFileError
from sb3_hds.twins.mujoco.files.correction import (
    DIGITS,
    OF_JOINTS,
    Correction,
    changed_bodies,
    in_body_frame,
)
from sb3_hds.twins.mujoco.mechanism import Body, Link
from sb3_hds.twins.mujoco.parameters import of_inertia
from sb3_hds.twins.mujoco.rigid_body import spatial


def urdf_of(correction: Correction, source: Any) -> str:
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
        raise ModelFileError(f"The source is not XML: {error}.") from None
    if robot.tag != "robot":
        raise ModelFileError(
            "A URDF is written only where the twin comes from one. Write MJCF: name the file .xml."
        )
    joints = {joint.get("name"): joint for joint in robot.iter("joint")}
    for link in correction.mechanism.links:
        _write_urdf_joint(correction, joints.get(link.joint), link)
    links = {link.get("name"): link for link in robot.iter("link")}
    for i, new in changed_bodies(correction).items():
        body = correction.mechanism.links[i].body
        assert body is not None
        _write_urdf_inertial(correction, links.get(body.name), body, new)
    recorded = {name for name in correction.values if "_payload" in name}
    for link in correction.mechanism.links:
        recorded |= {f"{link.joint}_{name}" for name in OF_JOINTS[:2]}
        recorded |= set(of_inertia(link.body.name) if link.body else ())
    for name in correction.values:
        if correction.difference(name) and name not in recorded:
            correction.record_left_out(name)
    for _, _, key, own in correction.effects:
        correction.record_effect(key, own, written=False)
    body = ElementTree.tostring(robot, encoding="unicode")
    return f'<?xml version="1.0"?>\n{body}\n'


def _write_urdf_joint(correction: Correction, joint: Any, link: Link) -> None:
    for name, attribute in (("damping", "damping"), ("frictionloss", "friction")):
        full = f"{link.joint}_{name}"
        if not correction.difference(full):
            continue
        if joint is None:
            correction.record_left_out(full)
            continue
        dynamics = _child(joint, "dynamics")
        dynamics.tail = dynamics.tail or "\n"
        dynamics.set(attribute, f"{correction.values[full]:.{DIGITS}g}")
        correction.record_change(full)


def _write_urdf_inertial(correction: Correction, link: Any, body: Body, new: spatial.Body) -> None:
    """Only if the link carries no other links rigidly: then it is the body of the twin."""
    own = None if link is None else link.find("inertial")
    mass = None if own is None else own.find("mass")
    held = math.nan if mass is None else float(mass.get("value", "nan"))
    if own is None or mass is None or not math.isclose(held, body.mass, rel_tol=1e-9):
        correction.left_out.append(
            f"mass and inertia of {body.name}, which carries other links rigidly"
        )
        return
    new_mass, centre, second = in_body_frame(body, new)
    inertia = np.trace(second) * np.eye(3) - second
    number = lambda x: f"{float(x):.{DIGITS}g}"  # noqa: E731
    mass.set("value", number(new_mass))
    place = _child(own, "origin")
    place.set("xyz", " ".join(map(number, centre)))
    place.set("rpy", "0 0 0")
    matrix = _child(own, "inertia")
    for i, j in zip(*np.triu_indices(3), strict=True):
        matrix.set(f"i{'xyz'[i]}{'xyz'[j]}", number(inertia[i, j]))
    correction.changed.append(f"inertial of {body.name}: {new_mass:.6g} kg")


def _child(parent: ElementTree.Element, tag: str) -> ElementTree.Element:
    """Its child of that tag, added where it is missing."""
    found = parent.find(tag)
    return ElementTree.SubElement(parent, tag) if found is None else found
