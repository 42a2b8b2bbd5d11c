"""Files as named columns: CSV, Parquet, npz, MATLAB and JSON."""

import csv
import json
import zlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sb3_hds.core.storage import read_npz
from sb3_hds.data.columns import Columns
from sb3_hds.data.recording import read_recording
from sb3_hds.data.rows import Table, is_number
from sb3_hds.errors import TrajectoryError

_DAMAGED = (ValueError, EOFError, LookupError, TypeError, NotImplementedError, zlib.error)
"""What the libraries raise for content that they cannot read."""


class Log(NamedTuple):
    """
    What one file holds.

    :param tables: one or more, with rows in order of time
    :param columns: what the file itself says about its columns
    """

    tables: Sequence[Table]
    columns: Columns | None = None


def read_log(path: Path, wanted: frozenset[str]) -> Log:
    """
    :param path: its suffix says how to read it
    :param wanted: the columns that will be used
    :raises TrajectoryError: if there is no such file, if it is damaged, or for another suffix
    """
    if not path.is_file():
        what = "is a folder; name the files in it, as" if path.is_dir() else "does not exist (in"
        rest = f"'{path / '*.csv'}'." if path.is_dir() else f"{Path.cwd()})."
        raise TrajectoryError(f"'{path}' {what} {rest}")
    suffix = path.suffix.lower()
    if suffix not in READERS:
        raise TrajectoryError(
            f"'{path}' cannot be read: there are readers for {', '.join(READERS)}, not for "
            f"'{path.suffix}'. Read it yourself and use Trajectories.from_arrays."
        )
    try:
        return READERS[suffix](path, wanted)
    except TrajectoryError:
        raise
    except OSError as error:
        raise TrajectoryError(f"'{path}' could not be read: {error.strerror or error}.") from error
    except _DAMAGED as error:
        reason = " ".join(str(error).split())[:200]
        raise TrajectoryError(
            f"'{path}' is damaged or not a {suffix} file ({reason}). "
            "Restore it from a copy, or record it again."
        ) from error


def _read_csv(path: Path, wanted: frozenset[str]) -> Log:
    """Text with a line of names; separated by commas, semicolons, tabs or spaces."""
    import pandas

    with path.open(encoding="utf-8-sig") as file:
        lines = (line.strip() for line in file if line.strip())
        head, first = next(lines, ""), next(lines, "")
    separator = _separator(head)
    _refuse_comment(path, head, first)
    names, fields = (_fields_of(line, separator) for line in (head.lstrip("#"), first))
    if names and all(is_number(name) for name in names):
        raise TrajectoryError(
            f"'{path}' begins with numbers: its first line must hold the names of the columns, "
            f"got '{head[:60]}'."
        )
    if len(fields) > len(names):
        raise TrajectoryError(
            f"'{path}' has {len(names)} names in its first line and {len(fields)} fields in the "
            f"next one, '{first[:60]}'. Decimal commas cannot be told from commas between fields: "
            "export the log with decimal points."
        )
    exactly: dict[str, Any] = {"float_precision": "round_trip", "skipinitialspace": True}
    with path.open(encoding="utf-8-sig") as file:
        for _ in range(len(head) - len(head.lstrip("#"))):
            # Otherwise a sign that stands alone would be the name of a column.
            while file.read(1) != "#":
                pass
        table = pandas.read_csv(file, sep=separator, index_col=False, **exactly)
    table.columns = [str(name).strip() for name in table.columns]
    return Log([{name: table[name].to_numpy() for name in table.columns}])


def _separator(line: str) -> str:
    separator = max((",", ";", "\t"), key=line.count)
    return separator if separator in line else r"\s+"


def _refuse_comment(path: Path, head: str, first: str) -> None:
    """:raises TrajectoryError: where the names of columns are not in the first line, but below"""
    names, below = (_fields_of(x.lstrip("#"), _separator(x)) for x in (head, first))
    text = len(below) > 1 and not any(is_number(field) for field in below)
    if first.startswith("#") or (text and len(below) != len(names)):
        raise TrajectoryError(
            f"'{path}' must begin with the names of its columns, and what follows must be numbers, "
            f"got '{head[:60]}' and then '{first[:60]}'. Delete the lines before the names."
        )


def _fields_of(line: str, separator: str) -> list[str]:
    """:return: of one line, without empty ones at its end"""
    if separator == r"\s+":
        return line.split()
    fields = next(csv.reader([line], delimiter=separator, skipinitialspace=True), [])
    while fields and not fields[-1].strip():
        fields.pop()
    return fields


def _read_parquet(path: Path, wanted: frozenset[str]) -> Log:
    import pandas

    try:
        table = pandas.read_parquet(path)
    except ImportError as error:
        raise TrajectoryError(
            f"'{path}': Parquet files are read by pyarrow, which is not installed. "
            "Install it: pip install sb3-hds[parquet]."
        ) from error
    return Log([{str(name): table[name].to_numpy() for name in table.columns}])


def _read_npz(path: Path, wanted: frozenset[str]) -> Log:
    """Arrays of one or two axes; the columns of a matrix ``x`` are called ``x[0]``, ``x[1]``."""
    arrays = read_npz(path)
    if "format" in arrays and "lengths" in arrays:
        raise TrajectoryError(
            f"'{path}' was written by Trajectories.save: it is read without columns."
        )
    return Log([{k: v for name, array in arrays.items() for k, v in columns_of(name, array)}])


def _read_mat(path: Path, wanted: frozenset[str]) -> Log:
    """
    MATLAB files up to version 7: vectors, matrices, scalars, texts, structs, and cells.

    The longer axis of a matrix is time, its other axis gives the columns ``x[0]``, ``x[1]``. Field
    ``q`` of struct ``s`` is called ``s.q``. Cell i of each cell array belongs to episode i.
    """
    from scipy.io import loadmat
    from scipy.io.matlab import MatReadError

    try:
        variables = loadmat(path)
    except NotImplementedError as error:
        raise TrajectoryError(
            f"'{path}' is a MATLAB file of version 7.3. Save it with: save('name.mat', '-v7')."
        ) from error
    except MatReadError as error:
        raise ValueError(str(error)) from error
    flat = {k: v for k, v in variables.items() if not k.startswith("__")}
    plain, cells = {}, {}
    for name, value in _fields(flat):
        if value.dtype == object:
            cells[name] = list(value.ravel())
        else:
            plain |= dict(columns_of(name, value))
    used = {name.partition("[")[0] for name in wanted} & set(cells)
    numbers = {len(cells[name]) for name in used}
    if len(numbers) > 1:
        listed = ", ".join(f"{name} {len(cells[name])}" for name in sorted(used))
        raise TrajectoryError(f"'{path}': cell arrays must have the same number, got {listed}.")
    # All cells are listed where none is used, for the message that a column is missing.
    shown = used or set(cells)
    tables = [
        plain | {k: v for name in shown for k, v in columns_of(name, cells[name][i])}
        for i in range(numbers.pop() if numbers else min(map(len, cells.values()), default=1))
    ]
    return Log(tables if used else tables[:1])


def _fields(variables: Mapping[str, np.ndarray]) -> list[tuple[str, np.ndarray]]:
    """Variables, with structs taken apart."""
    found = []
    for name, value in variables.items():
        if value.dtype.names and value.size == 1:
            inside = {f"{name}.{field}": value.ravel()[0][field] for field in value.dtype.names}
            found += _fields(inside)
        elif not value.dtype.names:
            found.append((name, value))
    return found


def _read_json(path: Path, wanted: frozenset[str]) -> Log:
    """
    A list of records ``[{"t": 0.0, "q": 0.1}, ...]``, or an object of columns
    ``{"t": [0.0, ...]}``, or an object with one list of records. Its other numbers and texts hold
    for all rows.
    """
    content = json.loads(path.read_text(encoding="utf-8"))
    if isinstance(content, list):
        content = {"": content}
    if not isinstance(content, dict):
        raise ValueError("it holds neither an object nor a list")
    columns: dict[str, np.ndarray] = {}
    for name, value in content.items():
        if isinstance(value, list) and value and all(isinstance(row, dict) for row in value):
            keys = dict.fromkeys(key for row in value for key in row)
            columns |= {key: np.array([row.get(key, np.nan) for row in value]) for key in keys}
        elif not isinstance(value, dict) and value is not None:
            columns |= dict(columns_of(name, np.array(value)))
    return Log([columns])


def _read_jsonl(path: Path, wanted: frozenset[str]) -> Log:
    """What :class:`sb3_hds.data.Recorder` wrote."""
    return Log(*read_recording(path))


def columns_of(name: str, array: np.ndarray) -> list[tuple[str, np.ndarray]]:
    """:return: the columns of an array, with their names; its longer axis is time"""
    if array.size == 1:
        return [(name, array.reshape(()))]
    if array.ndim == 2 and min(array.shape) == 1:
        array = array.ravel()
    if array.ndim == 2:
        by_column = array.T if array.shape[0] >= array.shape[1] else array
        return [(f"{name}[{i}]", column) for i, column in enumerate(by_column)]
    return [(name, array)] if array.ndim == 1 else []


READERS: dict[str, Callable[[Path, frozenset[str]], Log]] = {
    ".csv": _read_csv,
    ".tsv": _read_csv,
    ".txt": _read_csv,
    ".parquet": _read_parquet,
    ".npz": _read_npz,
    ".mat": _read_mat,
    ".json": _read_json,
    ".jsonl": _read_jsonl,
}
"""The reader of each suffix. A reader of your own goes in here."""
