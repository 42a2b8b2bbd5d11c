"""The result of a reader, and what all readers share."""

import contextlib
import errno
import warnings
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sb3_hds.data.columns import Columns
from sb3_hds.errors import TrajectoryError

Table = Mapping[str, np.ndarray]
"""Columns by name, each of shape ``(rows,)``; a value that applies to all rows has shape ``()``."""

_SYSTEM_ERRORS = (errno.EACCES, errno.EPERM, errno.EIO, errno.ENOENT, errno.EISDIR, errno.EMFILE)

_SIGNATURES = {
    b"\x89HDF\r\n\x1a\n": ("an HDF5 file", (".h5", ".hdf5", ".hdf", ".mat")),
    b"PK\x03\x04": ("a zip archive, as NumPy and Excel write", (".npz",)),
    b"\x93NUMPY": ("a NumPy array", (".npy",)),
    b"PAR1": ("a Parquet file", (".parquet",)),
    b"SQLite format 3\x00": ("a SQLite data base, as of rosbag2", (".db3",)),
    b"\x89MCAP": ("an MCAP file", (".mcap",)),
    b"#ROSBAG V": ("a bag of ROS 1", (".bag",)),
    b"MATLAB": ("a MATLAB file", (".mat",)),
    b"\x1f\x8b": ("compressed with gzip", (".gz",)),
    b"\x28\xb5\x2f\xfd": ("compressed with zstd", (".zst",)),
}
"""First bytes of a file -> what it is, and the suffixes of that format."""


class Log(NamedTuple):
    """
    The content of one file.

    :param tables: one or more, with rows in order of time. Columns that are not wanted may be
        missing; if a wanted one does not exist, the names of all are present, for the error message
    :param columns: what the file itself declares about its columns
    :param units: of columns, as the file declares them
    :param notes: sentences on how the values were processed
    """

    tables: Sequence[Table]
    columns: Columns | None = None
    units: Mapping[str, str] = {}
    notes: tuple[str, ...] = ()


@contextlib.contextmanager
def library_errors(
    path: Path, remedy: str = "Restore it from a copy, or record it again."
) -> Iterator[None]:
    """
    Turn exceptions of other libraries into one sentence about the file, and silence warnings.

    :param path: of the file
    :param remedy: last sentence of the message

    :raises TrajectoryError: for any exception raised inside
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    except TrajectoryError:
        raise
    except ImportError:
        raise
    except Exception as error:
        if isinstance(error, OSError) and error.errno in _SYSTEM_ERRORS:
            raise TrajectoryError(f"'{path}' could not be read: {error.strerror}.") from error
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise TrajectoryError(
            _wrong_suffix(path)
            or f"'{path}' is damaged or not a {path.suffix} file ({reason}). {remedy}"
        ) from error


def _wrong_suffix(path: Path) -> str:
    """An error message if the content does not match the suffix, otherwise empty."""
    try:
        with path.open("rb") as file:
            begin = file.read(16)
    except OSError:
        return ""
    for signature, (kind, suffixes) in _SIGNATURES.items():
        if begin.startswith(signature) and path.suffix.lower() not in suffixes:
            return (
                f"'{path}' looks like {kind}, in spite of its name. If it is, rename it to "
                f"'{path.stem}{suffixes[0]}'; otherwise export it again."
            )
    return ""


def base_name(name: str) -> str:
    """:return: ``"x"`` of ``"x[3]"``"""
    return name.partition("[")[0]


def split_columns(name: str, array: np.ndarray, rows: int | None = None) -> dict[str, np.ndarray]:
    """
    :param name: of a vector; the columns of a matrix ``x`` are ``x[0]``, ``x[1]``
    :param array: of one or two axes; others have no columns
    :param rows: number of rows, if known; otherwise the longer axis of a matrix is time
    """
    if array.size == 1:
        return {name or "0": array.reshape(())}
    if array.ndim == 2 and min(array.shape) == 1:
        array = array.ravel()
    if array.ndim == 2:
        rows_first = array.shape[0] >= array.shape[1]
        if rows in array.shape:
            rows_first = array.shape[0] == rows
        by_column = array.T if rows_first else array
        label = f"{name}[{{}}]" if name else "{}"
        return {label.format(i): column for i, column in enumerate(by_column)}
    return {name or "0": array} if array.ndim == 1 else {}


def aliases(names: Collection[str], wanted: Iterable[str]) -> dict[str, str]:
    """:return: existing names of wanted columns: ``x`` and its only element ``x[0]`` are one"""
    found = {}
    for name in set(wanted) - set(names):
        base = base_name(name)
        if name == f"{base}[0]" and base in names:
            found[name] = base
        elif f"{name}[0]" in names and f"{name}[1]" not in names:
            found[name] = f"{name}[0]"
    return found
