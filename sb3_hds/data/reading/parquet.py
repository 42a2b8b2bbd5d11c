"""Parquet files with a number, a list of numbers or a struct in each row of a column."""

from pathlib import Path
from typing import Any

import numpy as np

from sb3_hds.data.columns import Columns
from sb3_hds.data.reading.log import Log, base_name, library_errors, split_columns
from sb3_hds.errors import TrajectoryError

_EPISODE = "episode_index"  # of LeRobot


def read_parquet(path: Path, columns: Columns) -> Log:
    """
    Lists of equal length become columns ``x[0]``, ``x[1]``, structs become columns ``x.a``.

    A column ``episode_index``, as LeRobot writes it, separates episodes.

    :param path: of the file
    :param columns: for the wanted names
    :raises TrajectoryError: if pyarrow is not installed
    """
    try:
        from pyarrow.parquet import ParquetFile
    except ImportError as error:
        raise TrajectoryError(
            f"'{path}': Parquet files are read by pyarrow, which is not installed. "
            "Install it: pip install sb3-hds[parquet]."
        ) from error
    with library_errors(path), ParquetFile(path) as file:
        names = list(file.schema_arrow.names)
        tops = {name for name in names for w in columns.wanted if _is_of(w, name)}
        every = not all(any(_is_of(w, name) for name in names) for w in columns.wanted)
        chosen = names if every or not tops else [*tops, *{_EPISODE} & set(names)]
        table: dict[str, np.ndarray] = {}
        for name in chosen:
            # One at a time, so that the file's copy of a column is freed before the next is read.
            table |= _columns(name, file.read([name]).column(name))
    own = Columns(episode=_EPISODE) if _EPISODE in names else None
    return Log([table], own)


def _is_of(wanted: str, name: str) -> bool:
    return wanted == name or base_name(wanted) == name or wanted.startswith(f"{name}.")


def _columns(name: str, column: Any) -> dict[str, np.ndarray]:
    from pyarrow import types
    from pyarrow.compute import call_function

    kind = column.type
    if types.is_struct(kind):
        found: dict[str, np.ndarray] = {}
        for part in kind:
            found |= _columns(f"{name}.{part.name}", _part(column, part.name))
        return found
    if not (types.is_list(kind) or types.is_large_list(kind) or types.is_fixed_size_list(kind)):
        return {name: column.to_numpy()}
    widths = call_function("list_value_length", [column]).unique().to_pylist()
    if len(widths) != 1 or widths[0] is None:
        return {name: column.to_numpy()}
    chunks = [chunk.flatten().to_numpy(zero_copy_only=False) for chunk in column.chunks]
    return split_columns(name, np.concatenate(chunks).reshape(-1, widths[0]), len(column))


def _part(column: Any, name: str) -> Any:
    import pyarrow

    chunks = [chunk.field(name) for chunk in column.chunks]
    return pyarrow.chunked_array(chunks, type=column.type.field(name).type)
