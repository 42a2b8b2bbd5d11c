"""JSON, and files of one JSON object per line."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sb3_hds.data.columns import Columns
from sb3_hds.data.reading.log import Log, foreign
from sb3_hds.data.reading.tree import plain_of, tables_of
from sb3_hds.data.recording import SUFFIX, is_recording, read_recording


def read_json(path: Path, columns: Columns) -> Log:
    """
    Objects of columns, lists of records, and episodes of either, at any depth.

    One object per line is a list of them: each is a row, or an episode. A last line that was cut
    off is left out. What a :class:`sb3_hds.data.Recorder` wrote is known by its first line.

    :param path: of the file
    :param columns: for ``records`` and for what is wanted
    """
    with foreign(path):
        content = path.read_bytes()
        lines = [line for line in content.split(b"\n") if line.strip()]
    # A recording that was interrupted in its first line says so.
    begun = len(lines) < 2 and path.suffix == SUFFIX and not _is_object(content)
    if begun or is_recording(lines[0] if lines else b""):
        return Log(*read_recording(path))
    with foreign(path):
        text = content.decode("utf-8-sig")
        several = len(lines) > 1 and _is_object(lines[0].removeprefix(b"\xef\xbb\xbf"))
        tree = plain_of(_objects(text.split("\n")) if several else json.loads(text))
    return Log(tables_of(tree, columns, path.name))


def _objects(lines: Sequence[str]) -> list[Any]:
    found: list[Any] = []
    for number, line in enumerate(lines, start=1):
        try:
            found += [json.loads(line)] if line.strip() else []
        except ValueError as error:
            if number < len(lines):
                raise ValueError(f"line {number}: {error}") from error
    return found


def _is_object(line: bytes) -> bool:
    try:
        return isinstance(json.loads(line), dict)
    except (ValueError, RecursionError):
        return False
