"""Loading of model files and environments as compiled MuJoCo models."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from sb3_hds.errors import ModelFileError
from sb3_hds.twins.mujoco.files.locking import Coupling
from sb3_hds.twins.mujoco.files.shapes import visuals_of
from sb3_hds.twins.mujoco.library import mujoco


class Loaded(NamedTuple):
    """
    :param model: an ``MjModel``
    :param dt: control interval of an environment [s]
    :param urdf: whether it comes from a URDF, which has neither drives nor an integrator
    :param mimics: joints of a URDF that follow another, where an older version of MuJoCo leaves
        them free
    :param drawn: a compiled model with the visual meshes; None without any
    """

    model: Any
    dt: float | None = None
    urdf: bool = False
    mimics: tuple[Coupling, ...] = ()
    drawn: Any = None


def load(source: Any) -> Loaded:
    """
    :param source: path of an MJCF or URDF file, or its text; an ``MjSpec`` or ``MjModel``; or an
        environment of Gymnasium that has a model of MuJoCo
    :raises ModelFileError: if there is no such file, or MuJoCo refuses it
    """
    mj = mujoco()
    if isinstance(source, mj.MjModel):
        return Loaded(source, drawn=source)
    if isinstance(source, mj.MjSpec):
        model = _compiled(source.copy, "this MjSpec")[0]
        return Loaded(model, drawn=model)
    if isinstance(source, str | os.PathLike):
        return _from_text_or_file(source)
    model = getattr(getattr(source, "unwrapped", None), "model", None)
    if isinstance(model, mj.MjModel):
        return Loaded(model, float(source.unwrapped.dt), drawn=model)
    raise ModelFileError(
        "A model is the path of an MJCF or URDF file, an MjSpec, an MjModel, or a MuJoCo "
        f"environment of Gymnasium, got {type(source).__name__}."
    )


def _from_text_or_file(source: str | os.PathLike[str]) -> Loaded:
    text, urdf, parsed, where = _parser_of(source)
    model = _compiled(parsed, where)[0]
    mimics = tuple(_mimics(text)) if urdf and not model.neq else ()
    if not urdf:
        return Loaded(model, drawn=model)
    folder = Path.cwd() if text == str(source).lstrip() else Path(source).parent
    return Loaded(model, urdf=True, mimics=mimics, drawn=visuals_of(text, folder))


def spec_of(source: Any) -> tuple[Any, Any, bool]:
    """
    :param source: path of an MJCF or URDF file, or its text; or an ``MjSpec``
    :return: an ``MjSpec`` that compiles, its model, and whether it comes from a URDF
    :raises ModelFileError: if there is no such file, or MuJoCo refuses it
    """
    if isinstance(source, mujoco().MjSpec):
        model, spec = _compiled(source.copy, "this MjSpec")
        return spec, model, False
    if not isinstance(source, str | os.PathLike):
        raise ModelFileError(
            "A model is written into a copy of its source: the path of an MJCF or URDF file, its "
            f"text, or an MjSpec; got {type(source).__name__}."
        )
    _, urdf, parsed, where = _parser_of(source)
    model, spec = _compiled(parsed, where)
    return spec, model, urdf


def _parser_of(
    source: str | os.PathLike[str],
) -> tuple[str, bool, Callable[[], Any], str]:
    """Text, whether it is a URDF, a function that returns its ``MjSpec``, and a name for errors."""
    text = str(source).lstrip()
    inline = text.startswith("<")
    where = "this text" if inline else f"'{source}'"
    if not inline:
        path = Path(source)
        if not path.is_file():
            raise ModelFileError(
                f"There is no file {where}. Pass the path of an MJCF or URDF file."
            )
        text = path.read_text(errors="replace")
    urdf = "<robot" in text

    def parsed() -> Any:
        mj = mujoco()
        read = mj.MjSpec.from_string if inline else mj.MjSpec.from_file
        spec = read(text if inline else str(source))
        if urdf:
            # Keep the names of tools and flanges as places for a payload.
            spec.compiler.fusestatic = False
        return spec

    return text, urdf, parsed, where


def _compiled(parsed: Callable[[], Any], where: str) -> tuple[Any, Any]:
    """The model and its spec; without meshes and textures if their files are missing."""
    mj = mujoco()
    try:
        spec = parsed()
        return spec.compile(), spec
    except ValueError as error:
        about_files = ("file", "mesh", "texture", "resource")
        if not any(word in str(error).lower() for word in about_files):
            raise ModelFileError(f"MuJoCo refuses {where}: {_first_line(error)}.") from None
    spec = parsed()
    shapes = [getattr(mj.mjtGeom, name) for name in ("mjGEOM_MESH", "mjGEOM_HFIELD", "mjGEOM_SDF")]
    shaped = [geom for geom in spec.geoms if geom.type in shapes]
    bare = {geom.parent.name for geom in shaped if not geom.parent.explicitinertial}
    assets = (spec.skins, spec.meshes, spec.hfields, spec.materials, spec.textures)
    for part in (*shaped, *(part for parts in assets for part in parts)):
        spec.delete(part)
    try:
        return spec.compile(), spec
    except ValueError as error:
        hint = ""
        if bare:
            names = ", ".join(sorted(bare))
            hint = f" No inertial says what {names} weighs, and its mesh is missing."
        raise ModelFileError(f"MuJoCo refuses {where}: {_first_line(error)}.{hint}") from None


def _mimics(text: str) -> list[Coupling]:
    from xml.etree import ElementTree

    try:
        joints = ElementTree.fromstring(text).iter("joint")
    except ElementTree.ParseError:
        return []
    found = []
    for joint in joints:
        mimic = joint.find("mimic")
        if mimic is not None:
            powers = float(mimic.get("offset", "0")), float(mimic.get("multiplier", "1"))
            found.append(Coupling(joint.get("name", ""), mimic.get("joint", ""), powers))
    return found


def _first_line(error: Exception) -> str:
    return str(error).strip().splitlines()[0].removeprefix("Error: ").rstrip(".")
