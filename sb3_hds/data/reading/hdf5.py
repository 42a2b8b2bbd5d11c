"""HDF5 files, such as those of robomimic and ACT."""

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from sb3_hds.data.columns import Columns
from sb3_hds.data.reading.log import Log, library_errors
from sb3_hds.data.reading.tree import Stored, tables_of
from sb3_hds.errors import TrajectoryError

_SIGNATURE = b"\x89HDF\r\n\x1a\n"


def read_hdf5(path: Path, columns: Columns) -> Log:
    """
    Data sets are named by their path, as ``observations/qpos[0]``; groups ``demo_0``, ``demo_1``
    are episodes.

    :param path: of the file
    :param columns: for ``records`` and the wanted names
    """
    with open_hdf5(path) as file:
        return Log(tables_of(_group(file), columns, path.name, "/"))


def is_hdf5(path: Path) -> bool:
    """:return: whether it is an HDF5 file, possibly after a user block of 512 bytes"""
    with library_errors(path), path.open("rb") as file:
        begin = file.read(1024)
    return _SIGNATURE in (begin[:8], begin[512:520])


@contextlib.contextmanager
def open_hdf5(path: Path) -> Iterator[Any]:
    """
    :param path: of the file
    :return: the open file of h5py
    :raises TrajectoryError: if h5py is not installed, or raises any error
    """
    try:
        import h5py
    except ImportError as error:
        raise TrajectoryError(
            f"'{path}': HDF5 files, and MATLAB files of version 7.3, are read by h5py, which is "
            "not installed. Install it: pip install sb3-hds[hdf5]."
        ) from error
    with library_errors(path), h5py.File(path, "r") as file:
        yield file


def lazy_array(item: Any) -> Stored:
    """:return: a data set that is read only when it is used"""
    return Stored(item.shape or (), lambda: np.asarray(item[()]))


def _group(group: Any) -> dict[str, Any]:
    import h5py

    found: dict[str, Any] = {}
    for name in group:
        item = group.get(name)  # None for a dangling link
        if isinstance(item, h5py.Group):
            found[name] = _group(item)
        elif isinstance(item, h5py.Dataset) and item.dtype.names:
            found[name] = {field: _field(item, field) for field in item.dtype.names}
        elif isinstance(item, h5py.Dataset) and item.dtype.kind in "fiubSO":
            found[name] = _text(item) if item.dtype.kind in "SO" else lazy_array(item)
    return found


def _field(item: Any, field: str) -> Stored:
    inner = item.dtype[field].shape
    return Stored((*item.shape, *inner), lambda: np.asarray(item[field]))


def _text(item: Any) -> Stored:
    return Stored(
        item.shape or (), lambda: np.asarray(item.asstr(errors="replace")[()]).astype(str)
    )
