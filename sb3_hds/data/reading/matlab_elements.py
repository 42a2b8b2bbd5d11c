"""Whether a MATLAB file of version 5 is whole: scipy believes its tags, and may end the process."""

import math
import struct
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO, NamedTuple

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
