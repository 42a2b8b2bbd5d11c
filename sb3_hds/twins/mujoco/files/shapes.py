"""The visual meshes of a model, where their files exist."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from sb3_hds.twins.mujoco.library import mujoco
from sb3_hds.twins.mujoco.mechanism import Place, Shape

# Mesh formats that MuJoCo reads.
_FORMATS = (".obj", ".stl")
# Directions in which the outermost vertex of a mesh is kept.
_N_DIRECTIONS = 64


def shapes_of(model: Any, places: Sequence[Place]) -> tuple[Shape, ...]:
    """
    :param model: compiled with its meshes
    :param places: frames of its bodies, relative to the links
    :return: one for each mesh geom of a body whose name no site has
    """
    frames = {"world": Place("world", -1, (0.0, 0.0, 0.0), tuple(map(tuple, np.eye(3))))}
    sites = {model.site(i).name for i in range(model.nsite)}
    frames |= {place.name: place for place in places if place.name not in sites}
    found = []
    for g in range(model.ngeom):
        place = frames.get(model.body(int(model.geom_bodyid[g])).name)
        if place is None or model.geom_type[g] != mujoco().mjtGeom.mjGEOM_MESH:
            continue
        mesh = int(model.geom_dataid[g])
        begin = int(model.mesh_vertadr[mesh])
        own = np.asarray(model.mesh_vert[begin : begin + int(model.mesh_vertnum[mesh])], float)
        turn = np.zeros(9)
        mujoco().mju_quat2Mat(turn, model.geom_quat[g])
        points = _outermost(own) @ turn.reshape(3, 3).T + model.geom_pos[g]
        points = points @ np.array(place.rotation).T + np.array(place.position)
        found.append(Shape(place.link, tuple(tuple(map(float, row)) for row in points.round(4))))
    return tuple(found)


def visuals_of(text: str, folder: Path) -> Any:
    """
    The visual meshes of a URDF: MuJoCo drops them, and fails if a file is missing.

    :param text: of a URDF
    :param folder: of its file
    :return: a compiled model of loose bodies, named as the links, with the existing meshes; None
        without any, or if they cannot be read
    """
    try:
        return _loose_bodies(ElementTree.fromstring(text), folder)
    except (ElementTree.ParseError, ValueError):
        return None


def _loose_bodies(robot: ElementTree.Element, folder: Path) -> Any:
    mj = mujoco()
    spec, n = mj.MjSpec(), 0
    for link in robot.iter("link"):
        body = None
        for visual in link.findall("visual"):
            mesh, origin = visual.find("geometry/mesh"), visual.find("origin")
            path = None if mesh is None else _found(mesh.get("filename", ""), folder)
            if mesh is None or path is None:
                continue
            at = {} if origin is None else origin.attrib
            scale = [float(x) for x in mesh.get("scale", "1 1 1").split()]
            place, turn = ([float(x) for x in at.get(n, "0 0 0").split()] for n in ("xyz", "rpy"))
            quaternion = np.zeros(4)
            mj.mju_euler2Quat(quaternion, turn, "XYZ")
            spec.add_mesh(name=f"mesh{n}", file=str(path), scale=scale)
            if body is None:
                name, world = link.get("name", ""), spec.worldbody
                body = world if name == "world" else world.add_body(name=name)
            body.add_geom(
                type=mj.mjtGeom.mjGEOM_MESH, meshname=f"mesh{n}", pos=place, quat=quaternion
            )
            n += 1
    return spec.compile() if n else None


def _found(name: str, folder: Path) -> Path | None:
    """Find a mesh by the end of its path, because the root of its package is unknown."""
    parts = Path(name.partition("://")[2] or name).parts
    for first in range(len(parts)):
        path = folder.joinpath(*parts[first:])
        if path.suffix.lower() in _FORMATS and path.is_file():
            return path.resolve()
    return None


def _outermost(points: np.ndarray) -> np.ndarray:
    """Vertices of the convex hull, the outermost in each of many directions."""
    k = np.arange(_N_DIRECTIONS) + 0.5
    z, angle = 1.0 - 2.0 * k / _N_DIRECTIONS, np.pi * (1.0 + np.sqrt(5.0)) * k
    across = np.sqrt(1.0 - z**2)
    directions = np.stack([across * np.cos(angle), across * np.sin(angle), z], 1)
    return points[np.unique(np.argmax(directions @ points.T, axis=1))]
