"""Files: atomic writes, arrays without pickle, and the reader of logs."""

import contextlib
import io
import os
import secrets
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from sb3_hds.errors import TrajectoryError

_SUFFIX = ".npz"

LogReader = Callable[[Any, Any], Any]

_log_reader: LogReader | None = None


def register_log_reader(reader: LogReader) -> None:
    """
    Set what ``Trajectories.load`` reads logs with: ``core`` does not import ``data``.

    :param reader: takes files and columns as ``Trajectories.load`` does
    """
    global _log_reader
    _log_reader = reader


def log_reader() -> LogReader | None:
    """:return: the reader; None before ``sb3_hds.data`` is imported"""
    return _log_reader


def check_target(path: str | os.PathLike[str]) -> None:
    """:raises OSError: if the folder of that file does not exist, or it is a folder itself"""
    target = Path(path)
    if not target.parent.is_dir():
        raise FileNotFoundError(
            f"{target} cannot be written: there is no such folder (in {Path.cwd()}). Make it first."
        )
    if target.is_dir():
        raise IsADirectoryError(f"{target} is a folder. Name a file.")


@contextlib.contextmanager
def writing(target: Path, *, durable: bool) -> Iterator[io.BufferedWriter]:
    """
    Write atomically: under a temporary name in the same folder, renamed at the end. Also after the
    process was killed, there is either the complete new file or the older one.

    :param target: a file of that name is replaced
    :param durable: flush it to the disk before renaming, so that it survives a loss of power
    :return: the open file
    :raises OSError: if the file cannot be written; an older file there is left as it was
    """
    temporary = target.with_name(f".{target.name}.{secrets.token_hex(8)}.tmp")
    try:
        with temporary.open("xb") as file:
            yield file
            if durable:
                file.flush()
                os.fsync(file.fileno())
        temporary.replace(target)
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink()


def write_bytes(path: str | os.PathLike[str], content: bytes, *, durable: bool = False) -> Path:
    """
    Write a file as :func:`writing` does.

    :param path: a file of that name is replaced
    :param durable: whether it survives a loss of power
    :return: the path of the file
    :raises OSError: if the file cannot be written; an older file there is left as it was
    """
    target = Path(path)
    with writing(target, durable=durable) as file:
        file.write(content)
    return target


def write_npz(path: str | os.PathLike[str], arrays: Mapping[str, Any]) -> Path:
    """
    Write arrays as :func:`write_bytes` does.

    :param path: ``.npz`` is appended where it is missing, as numpy does
    :param arrays: by name; none may hold objects
    :return: the path of the file
    :raises TrajectoryError: if the file cannot be written; an older file there is left as it was
    """
    target = Path(path)
    if target.suffix != _SUFFIX:
        target = target.with_name(target.name + _SUFFIX)
    compressed = io.BytesIO()
    np.savez_compressed(compressed, **arrays)
    try:
        return write_bytes(target, compressed.getvalue(), durable=True)
    except OSError as error:
        raise TrajectoryError(
            f"'{target}' could not be written: {error.strerror}. "
            "The folder must exist and be writable, with space left on the disk."
        ) from error


def read_npz(path: str | os.PathLike[str]) -> dict[str, np.ndarray]:
    """
    :param path: as given to :func:`write_npz`
    :return: all arrays, by name
    :raises TrajectoryError: if the file is missing, damaged or of another kind
    """
    source = Path(path)
    if not source.exists() and source.with_name(source.name + _SUFFIX).exists():
        source = source.with_name(source.name + _SUFFIX)
    if source.suffix != _SUFFIX:
        raise TrajectoryError(
            f"'{source}' cannot be read: files that end in {_SUFFIX} can, "
            f"not those that end in '{source.suffix}'. "
            "Read other files yourself and use Trajectories.from_arrays."
        )
    if not source.is_file():
        raise TrajectoryError(f"There is no file '{source}' (in {Path.cwd()}).")
    try:
        archive = np.load(source, allow_pickle=False)
        if not isinstance(archive, np.lib.npyio.NpzFile):
            raise ValueError("it holds a single array")
        with archive:
            return {name: np.asarray(archive[name]) for name in archive.files}
    except (
        *(OSError, EOFError, ValueError, KeyError, NotImplementedError, RuntimeError),
        *(zipfile.BadZipFile, zlib.error, struct.error),
    ) as error:
        if "allow_pickle" in str(error) and zipfile.is_zipfile(source):
            raise TrajectoryError(
                f"'{source}' was not written by Trajectories.save: it holds Python objects, which "
                "would have to be unpickled, and no file is. Save arrays of numbers."
            ) from error
        message = " ".join(str(error).split())[:200]
        reason = "it holds no arrays of numbers" if "pickle" in message else message
        raise TrajectoryError(
            f"'{source}' is damaged or was not written by Trajectories.save ({reason}). "
            "Restore it from a copy, or record it again."
        ) from error
