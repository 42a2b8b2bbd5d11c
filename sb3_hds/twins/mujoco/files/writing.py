"""Export of corrected twins to model files, MJCF or URDF."""

import dataclasses
import os
from pathlib import Path
from typing import Any

import numpy as np

from sb3_hds.core import Twin
from sb3_hds.core.belief import BeliefTwin
from sb3_hds.core.trajectories.storage import check_target, write_bytes
from sb3_hds.core.twin import plant_of
from sb3_hds.errors import ModelFileError
from sb3_hds.twins.mujoco.files.correction import Correction
from sb3_hds.twins.mujoco.files.mjcf import mjcf_of
from sb3_hds.twins.mujoco.files.urdf import urdf_of
from sb3_hds.twins.mujoco.twin import MechanismTwin


@dataclasses.dataclass(frozen=True)
class Written:
    """
    :param path: of the file
    :param changed: changes relative to the source, a line each
    :param left_out: properties of the twin that the format cannot express, a line each
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
    Write a calibrated or extended twin of a model file as a corrected copy of that file.

    MJCF gets friction loss, damping, armature, stiffness, gains, gravity, masses with centres and
    inertias, a payload, and delays, time constants and limits of actuators; also the time step and
    integrator of the twin, so that ``substeps`` calls of ``mj_step`` per control interval reproduce
    it. Dry friction is then MuJoCo's, which sticks. A URDF gets damping, friction and inertials.
    Changes that the format cannot express are listed. Missing meshes are left out of MJCF.

    :param twin: made by ``twins.from_mujoco``, with other parameters or with effects
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
    correction = Correction.of(twin, plant)
    content = (
        urdf_of(correction, source) if kind == ".urdf" else mjcf_of(correction, source, target)
    )
    write_bytes(target, content.encode())
    return Written(target, tuple(correction.changed), tuple(correction.left_out))


def write_models(
    belief: BeliefTwin, folder: str | os.PathLike[str], source: Any, n: int = 16
) -> list[Written]:
    """
    Write draws of a belief as corrected copies of a model file, each as :func:`write_model` does.
    ``NAME_00.xml`` is the likeliest answer; the others are spread evenly over the draws, so that
    each answer has its share.

    :param belief: over a twin that ``twins.from_mujoco`` made
    :param folder: made if missing; files of the same names are replaced
    :param source: of the twin: path or text of an MJCF file, or an ``MjSpec``
    :param n: number of files, at most that of the draws
    :return: one result for each file
    :raises ModelFileError: for fewer than one file, or a twin that was not made from a model file
    """
    if n < 1:
        raise ModelFileError(f"n must be at least one file, got {n}.")
    numbers = np.unique(np.linspace(0, belief.n_draws - 1, n).round().astype(int))
    members = [belief.member(int(i)) for i in numbers]
    Path(folder).mkdir(parents=True, exist_ok=True)
    digits = max(2, len(str(len(members) - 1)))
    return [
        write_model(member, Path(folder) / f"{belief.name}_{i:0{digits}d}.xml", source)
        for i, member in enumerate(members)
    ]
