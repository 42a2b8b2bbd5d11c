"""MATLAB files: those that scipy reads, and version 7.3, which is HDF5."""

import math
import struct
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from sb3_hds.data.columns import Columns
from sb3_hds.data.reading.hdf5 import is_hdf5, lazy_array, open_hdf5
from sb3_hds.data.reading.log import Log, library_errors
from sb3_hds.data.reading.tree import Cells, tables_of
from sb3_hds.errors import TrajectoryError


def read_mat(path: Path, columns: Columns) -> Log:
    """
    Vectors, matrices, scalars, texts, structs, and cells.

    The longer axis of a matrix is time, its other axis gives the columns ``x[0]``, ``x[1]``. Field
    ``q`` of struct ``s`` is called ``s.q``. Cell i of each cell array belongs to episode i, and so
    does element i of an array of structs.

    :param path: of the file, of any version from 4 on
    :param columns: for the wanted names
    """
    if is_hdf5(path):
        with open_hdf5(path) as file:
            tree = {
                name: _from_hdf5(file, file[name]) for name in file if not str(name).startswith("#")
            }
            return Log(tables_of(_without_unreadable(tree), columns, path.name))
    from scipy.io import loadmat

    with library_errors(path):
        _check_mat5(path)
        variables = loadmat(path)
        tree = {k: _from_scipy(v) for k, v in variables.items() if not k.startswith("__")}
    known = _without_unreadable(tree)
    tables = tables_of(known, columns, path.name)
    _check_readable(path, columns, set(tree) - set(known), tables[0])
    return Log(tables)


def _without_unreadable(tree: Mapping[str, Any]) -> dict[str, Any]:
    """The variables or fields that can be read."""
    return {name: value for name, value in tree.items() if value is not None}


def _check_readable(
    path: Path, columns: Columns, objects: set[str], table: Mapping[str, Any]
) -> None:
    """:raises TrajectoryError: if a missing column may be in a table, timetable or timeseries"""
    missing = sorted(columns.wanted - set(table))
    if objects and missing:
        raise TrajectoryError(
            f"'{path}' has no '{missing[0]}' that can be read outside MATLAB: "
            f"{', '.join(sorted(objects))} may be a table, a timetable or a timeseries. Save its "
            "columns as arrays: q = data.q; save('log.mat', 'q', ...)."
        )


def _from_scipy(value: Any) -> Any:
    """A variable as scipy reads it; None for objects of classes."""
    if hasattr(value, "toarray"):  # sparse
        return np.asarray(value.toarray())
    if type(value).__name__ in ("MatlabOpaque", "MatlabFunction") or not hasattr(value, "dtype"):
        return None
    if value.dtype.names:
        structs = [
            _without_unreadable({name: _from_scipy(item[name]) for name in value.dtype.names})
            for item in value.ravel()
        ]
        return structs[0] if len(structs) == 1 else structs
    if value.dtype == object:
        cells = [_from_scipy(item) for item in value.ravel()]
        if cells and all(isinstance(cell, dict) for cell in cells):
            return cells
        return Cells(cells) if all(cell is not None for cell in cells) else None
    return np.asarray(value)


def _from_hdf5(file: Any, item: Any) -> Any:
    """Version 7.3: groups are structs, references point to cells, arrays are transposed."""
    import h5py

    if isinstance(item, h5py.Group):
        fields = {name: _from_hdf5(file, part) for name, part in item.items()}
        sizes = {len(value) for value in fields.values() if isinstance(value, Cells)}
        if fields and len(sizes) == 1 and all(isinstance(v, Cells) for v in fields.values()):
            structs = [{k: v[i] for k, v in fields.items()} for i in range(sizes.pop())]
            return [_without_unreadable(fields) for fields in structs]
        return _without_unreadable(fields)
    if item.attrs.get("MATLAB_empty", 0):
        return np.zeros(0)
    kind = item.attrs.get("MATLAB_class", b"")
    if item.dtype == h5py.ref_dtype:
        # In column-major order, as in MATLAB.
        cells = [_from_hdf5(file, file[reference]) for reference in item[()].T.ravel(order="F")]
        return cells if cells and all(isinstance(c, dict) for c in cells) else Cells(cells)
    if kind == b"char":
        return np.array("".join(map(chr, item[()].ravel())))
    if item.dtype.kind not in "fiub":
        return None
    return lazy_array(item)._replace(shape=item.shape[::-1], read=lambda: item[()].T)


_MATRIX, _COMPRESSED = 14, 15
_NUMBERS = (1, 2, 3, 4, 5, 6, 7, 9, 12, 13)
_TEXT = (*_NUMBERS, 16, 17, 18)
_CELL, _STRUCT, _OBJECT, _CHAR, _SPARSE, _FUNCTION, _OPAQUE = 1, 2, 3, 4, 5, 16, 17
_NUMERIC = range(6, 16)
_MAX_DEPTH = 100  # of nested cells


class _Element(NamedTuple):
    """
    :param kind: type of its content
    :param content: None for a matrix, and for more than 1024 bytes
    :param size: of the content [bytes]
    """

    kind: int
    content: bytes | None
    size: int


def _check_mat5(path: Path) -> None:
    """
    Check the structure of the file, on which scipy relies.

    :param path: of a file of version 5; other versions are not checked
    :raises ValueError: if an element has an unknown type, exceeds the file, or lacks a part
    """
    with path.open("rb") as file:
        head, size = file.read(128), path.stat().st_size
        if len(head) == 128 and 0 not in head[:4]:
            _elements(file, "<" if head[126:127] == b"I" else ">", size, 0)


def _elements(file: BinaryIO, order: str, end: int, depth: int) -> list[_Element]:
    """The elements up to byte ``end`` of the file."""
    found = []
    while file.tell() + 8 <= end:
        tag = file.read(8)
        kind, size = struct.unpack(f"{order}II", tag)
        small = kind >> 16  # up to four bytes, inside the tag
        if small:
            found.append(_Element(kind & 0xFFFF, tag[4 : 4 + small], small))
        begin = file.tell()
        if (kind & 0xFFFF if small else kind) not in (*_TEXT, _MATRIX, _COMPRESSED) or small > 4:
            raise ValueError(f"an element of type {kind} at byte {begin - 8}")
        if small:
            continue
        if begin + size > end or depth > _MAX_DEPTH:
            raise ValueError(f"an element of {size} bytes at byte {begin - 8}")
        found.append(
            _Element(kind, file.read(size) if kind < _MATRIX and size <= 1024 else None, size)
        )
        file.seek(begin)
        if kind == _MATRIX and size:
            _check_matrix(_elements(file, order, begin + size, depth + 1), order)
        elif kind == _COMPRESSED:
            zlib.decompress(file.read(size))  # verifies the checksum
        file.seek(begin + size + (0 if kind == _COMPRESSED else -size % 8))
    return found


def _check_matrix(elements: Sequence[_Element], order: str) -> None:
    """An array has flags, dimensions, a name, and as many parts as these require."""
    flags = elements[0].content if elements else None
    if flags is None or len(flags) != 8:
        raise ValueError("an array without flags")
    (word,) = struct.unpack(f"{order}I", flags[:4])
    kind, is_complex = word & 0xFF, bool(word & 0x800)
    if kind in (_FUNCTION, _OPAQUE):
        return
    dims = elements[1].content if len(elements) > 2 else None
    if dims is None or len(dims) % 4:
        raise ValueError("an array without dimensions")
    n = math.prod(struct.unpack(f"{order}{len(dims) // 4}I", dims))
    parts = elements[3:]
    if kind in (_STRUCT, _OBJECT):
        longest, names = parts[kind - _STRUCT : kind] if len(parts) >= kind else (None, None)
        if longest is None or names is None or longest.content is None or len(longest.content) < 4:
            raise ValueError("a struct without names")
        (width,) = struct.unpack(f"{order}I", longest.content[:4])
        parts, n = parts[kind:], n * (names.size // max(width, 1))
    known = {_CHAR: (_TEXT, 1), _SPARSE: (_NUMBERS, 3 + is_complex)}
    known |= dict.fromkeys((_CELL, _STRUCT, _OBJECT), ((_MATRIX,), n))
    known |= dict.fromkeys(_NUMERIC, (_NUMBERS, 1 + is_complex))
    kinds, number = known.get(kind, ((), 1))
    if len(parts) < number or any(part.kind not in kinds for part in parts[:number]):
        raise ValueError(f"an array of class {kind} that lacks a part")
