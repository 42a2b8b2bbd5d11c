"""MATLAB files: those that scipy reads, and version 7.3, which is HDF5."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from sb3_hds.data.columns import Columns
from sb3_hds.data.reading.hdf5 import is_hdf5, opened, stored
from sb3_hds.data.reading.log import Log, foreign
from sb3_hds.data.reading.matlab_elements import check_elements
from sb3_hds.data.reading.tree import Cells, tables_of
from sb3_hds.errors import TrajectoryError


def read_mat(path: Path, columns: Columns) -> Log:
    """
    Vectors, matrices, scalars, texts, structs, and cells.

    The longer axis of a matrix is time, its other axis gives the columns ``x[0]``, ``x[1]``. Field
    ``q`` of struct ``s`` is called ``s.q``. Cell i of each cell array belongs to episode i, and so
    does element i of an array of structs.

    :param path: of the file, of any version from 4 on
    :param columns: for what is wanted
    """
    if is_hdf5(path):
        with opened(path) as file:
            tree = {name: _node(file, file[name]) for name in file if not str(name).startswith("#")}
            return Log(tables_of(_known(tree), columns, path.name))
    from scipy.io import loadmat

    with foreign(path):
        check_elements(path)
        variables = loadmat(path)
        tree = {k: _plain(v) for k, v in variables.items() if not k.startswith("__")}
    known = _known(tree)
    tables = tables_of(known, columns, path.name)
    _refuse_objects(path, columns, set(tree) - set(known), tables[0])
    return Log(tables)


def _known(tree: Mapping[str, Any]) -> dict[str, Any]:
    """Without what cannot be read."""
    return {name: value for name, value in tree.items() if value is not None}


def _refuse_objects(
    path: Path, columns: Columns, objects: set[str], table: Mapping[str, Any]
) -> None:
    """:raises TrajectoryError: if what is missing is a table, a timetable or a timeseries"""
    missing = sorted(columns.wanted - set(table))
    if objects and missing:
        raise TrajectoryError(
            f"'{path}' has no '{missing[0]}' that can be read outside of MATLAB: "
            f"{', '.join(sorted(objects))} may be a table, a timetable or a timeseries. Save its "
            "columns as arrays: q = data.q; save('log.mat', 'q', ...)."
        )


def _plain(value: Any) -> Any:
    """Of what scipy makes of a variable; None for objects of classes."""
    if hasattr(value, "toarray"):  # sparse
        return np.asarray(value.toarray())
    if type(value).__name__ in ("MatlabOpaque", "MatlabFunction") or not hasattr(value, "dtype"):
        return None
    if value.dtype.names:
        structs = [
            _known({name: _plain(item[name]) for name in value.dtype.names})
            for item in value.ravel()
        ]
        return structs[0] if len(structs) == 1 else structs
    if value.dtype == object:
        cells = [_plain(item) for item in value.ravel()]
        if cells and all(isinstance(cell, dict) for cell in cells):
            return cells
        return Cells(cells) if all(cell is not None for cell in cells) else None
    return np.asarray(value)


def _node(file: Any, item: Any) -> Any:
    """Of version 7.3: groups are structs, references lead to cells, arrays are transposed."""
    import h5py

    if isinstance(item, h5py.Group):
        fields = {name: _node(file, part) for name, part in item.items()}
        sizes = {len(value) for value in fields.values() if isinstance(value, Cells)}
        if fields and len(sizes) == 1 and all(isinstance(v, Cells) for v in fields.values()):
            structs = [{k: v[i] for k, v in fields.items()} for i in range(sizes.pop())]
            return [_known(fields) for fields in structs]
        return _known(fields)
    if item.attrs.get("MATLAB_empty", 0):
        return np.zeros(0)
    kind = item.attrs.get("MATLAB_class", b"")
    if item.dtype == h5py.ref_dtype:
        # Down the columns, as MATLAB counts.
        cells = [_node(file, file[reference]) for reference in item[()].T.ravel(order="F")]
        return cells if cells and all(isinstance(c, dict) for c in cells) else Cells(cells)
    if kind == b"char":
        return np.array("".join(map(chr, item[()].ravel())))
    if item.dtype.kind not in "fiub":
        return None
    return stored(item)._replace(shape=item.shape[::-1], read=lambda: item[()].T)
