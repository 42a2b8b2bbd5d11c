"""NumPy arrays, and archives of arrays with any names."""

import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from sb3_hds.data.columns import Columns
from sb3_hds.data.reading.log import Log, base_name, library_errors
from sb3_hds.data.reading.tree import tables_of
from sb3_hds.errors import TrajectoryError


def read_npz(path: Path, columns: Columns) -> Log:
    """
    Arrays of one or two axes, or of three, of which the first one counts episodes.

    :param path: of the file
    :param columns: for the wanted names
    :raises TrajectoryError: for a file of ``Trajectories.save``, or if a wanted array contains
        Python objects, which would have to be unpickled
    """
    with library_errors(path):
        if not zipfile.is_zipfile(path):
            raise ValueError("it is not an archive of arrays")
        arrays, objects = _arrays(path, {base_name(name) for name in columns.wanted})
    wanted = sorted(objects & {base_name(name) for name in columns.wanted})
    if wanted:
        raise TrajectoryError(
            f"'{path}' holds Python objects in {', '.join(wanted)}, as NumPy saves lists of "
            "unequal arrays. They would have to be unpickled, which is unsafe. Save numbers: "
            "Trajectories.from_arrays(obs, actions, dt=SECONDS).save(PATH)."
        )
    return Log(tables_of(arrays, columns, path.name))


def read_npy(path: Path, columns: Columns) -> Log:
    """
    One array, whose columns are numbered from 0.

    :param path: of the file
    :param columns: for the wanted names
    """
    with library_errors(path):
        array = np.load(path, allow_pickle=False)
    return Log(tables_of(_fields(array), columns, path.name))


def _arrays(path: Path, wanted: set[str]) -> tuple[dict[str, Any], set[str]]:
    """:return: the wanted arrays, or all; and the names of those that contain objects"""
    arrays, objects = {}, set()
    with np.load(path, allow_pickle=False) as archive:
        names = list(archive.files)
        if {"format", "lengths"} <= set(names):
            raise TrajectoryError(
                f"'{path}' was written by Trajectories.save: it is read without columns."
            )
        for name in names if wanted - set(names) else sorted(wanted) or names:
            try:
                arrays[name] = _fields(np.asarray(archive[name]))
            except ValueError as error:
                if "allow_pickle" not in str(error):
                    raise
                objects.add(name)
    return arrays, objects


def _fields(array: np.ndarray) -> Any:
    """A structured array as an object of its fields."""
    names = array.dtype.names
    return {name: array[name] for name in names} if names else array
