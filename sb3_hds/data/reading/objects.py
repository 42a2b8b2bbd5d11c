"""JSON, and files of one JSON object per line."""

import json
from pathlib import Path
from typing import Any

from sb3_hds.data.columns import Columns
from sb3_hds.data.reading.log import Log, foreign
from sb3_hds.data.reading.tree import plain_of, tables_of
from sb3_hds.data.recording import is_recording, read_recording


def read_json(path: Path, columns: Columns) -> Log:
    """
    Objects of columns, lists of records, and episodes of either, at any depth.

    :param path: of the file
    :param columns: for ``records`` and for what is wanted
    """
    with foreign(path):
        content = plain_of(json.loads(path.read_text(encoding="utf-8-sig")))
    return Log(tables_of(content, columns, path.name))


def read_json_lines(path: Path, columns: Columns) -> Log:
    """
    What a :class:`sb3_hds.data.Recorder` wrote, or one object per line: a row, or an episode.

    A last line that was cut off is left out.

    :param path: of the file
    :param columns: for what is wanted
    """
    with foreign(path):
        lines = path.read_bytes().split(b"\n")
    whole = [line for line in lines if line.strip()]
    # A recording that was interrupted says so.
    if not whole or is_recording(whole[0]) or (len(whole) == 1 and not _is_object(whole[0])):
        return Log(*read_recording(path))
    with foreign(path):
        objects: list[Any] = []
        for number, line in enumerate(lines, start=1):
            try:
                objects += [json.loads(line)] if line.strip() else []
            except ValueError as error:
                if number < len(lines) or not objects:
                    raise ValueError(f"line {number}: {error}") from error
        content = plain_of(objects)
    return Log(tables_of(content, columns, path.name))


def _is_object(line: bytes) -> bool:
    try:
        return isinstance(json.loads(line), dict)
    except (ValueError, RecursionError):
        return False
