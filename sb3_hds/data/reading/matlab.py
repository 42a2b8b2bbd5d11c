"""MATLAB files: those that scipy reads, and version 7.3, which is HDF5."""

import math
import struct
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from sb3_hds.data.columns import Columns
from sb3_hds.data.reading.hdf5 import is_hdf5, opened, stored
from sb3_hds.data.reading.log import Log, foreign
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


_MATRIX, _COMPRESSED = 14, 15
_NUMBERS = (1, 2, 3, 4, 5, 6, 7, 9, 12, 13)
_TEXT = (*_NUMBERS, 16, 17, 18)
_CELL, _STRUCT, _OBJECT, _CHAR, _SPARSE, _FUNCTION, _OPAQUE = 1, 2, 3, 4, 5, 16, 17
_NUMERIC = range(6, 16)
_DEEPEST = 100  # cells in cells


class _Element(NamedTuple):
    """
    :param kind: of its content
    :param content: None for a matrix, and for what is long
    """

    kind: int
    content: bytes | None
    size: int


def check_elements(path: Path) -> None:
    """
    :param path: of a file of version 5; others are not looked at
    :raises ValueError: if an element is of no known type, ends after its file, or lacks a part
    """
    with path.open("rb") as file:
        head, size = file.read(128), path.stat().st_size
        if len(head) == 128 and 0 not in head[:4]:
            _elements(file, "<" if head[126:127] == b"I" else ">", size, 0)


def _elements(file: BinaryIO, order: str, end: int, depth: int) -> list[_Element]:
    """Those up to a place in the file."""
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
        if begin + size > end or depth > _DEEPEST:
            raise ValueError(f"an element of {size} bytes at byte {begin - 8}")
        found.append(
            _Element(kind, file.read(size) if kind < _MATRIX and size <= 1024 else None, size)
        )
        file.seek(begin)
        if kind == _MATRIX and size:
            _check_matrix(_elements(file, order, begin + size, depth + 1), order)
        elif kind == _COMPRESSED:
            zlib.decompress(file.read(size))  # it has a check sum
        file.seek(begin + size + (0 if kind == _COMPRESSED else -size % 8))
    return found


def _check_matrix(elements: Sequence[_Element], order: str) -> None:
    """Flags, dimensions, a name, and as many parts as these call for."""
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
