"""A belief over twins of a robot as several model files."""

import os
from pathlib import Path
from typing import Any

import numpy as np

from sb3_hds.core.belief import BeliefTwin
from sb3_hds.errors import ModelFileError
from sb3_hds.twins.mujoco.files.writing import Written, write_model


def write_models(
    belief: BeliefTwin, folder: str | os.PathLike[str], source: Any, n: int = 16
) -> list[Written]:
    """
    Write draws of a belief as corrected copies of a model file, as :func:`write_model` does with
    one: ``NAME_00.xml`` is the likeliest answer, the others are spread evenly over the draws, so
    that each answer has its share.

    :param belief: over twins of a robot that ``twins.from_mujoco`` made
    :param folder: is made where it is missing; files of the same names are replaced
    :param source: of the twin: path or text of an MJCF file, or an ``MjSpec``
    :param n: files; there are no more than draws
    :return: what was written, and what the format cannot say
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
