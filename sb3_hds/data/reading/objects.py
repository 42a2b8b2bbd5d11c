"""JSON, and files of one JSON object per line."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sb3_hds.data.columns import Columns
from sb3_hds.data.reading.log import Log, library_errors
from sb3_hds.data.reading.tree import from_json, tables_of
from sb3_hds.data.recording import SUFFIX, is_recording, read_recording


def read_json(path: Path, columns: Columns) -> Log:
    """
    Objects of columns, lists of records, and episodes of either, at any depth.

    With one object per line, each is a row or an episode; an incomplete last line is ignored. A
    file of a :class:`sb3_hds.data.Recorder` is recognised by its first line.

    :param path: of the file
    :param columns: for ``records`` and the wanted names
    """
    with library_errors(path):
        content = path.read_bytes()
        lines = [line for line in content.split(b"\n") if line.strip()]
    # Recordings interrupted in their first line have an error message of their own.
    interrupted = len(lines) < 2 and path.suffix == SUFFIX and not _is_object(content)
    if interrupted or is_recording(lines[0] if lines else b""):
        return Log(*read_recording(path))
    with library_errors(path):
        text = content.decode("utf-8-sig")
        several = len(lines) > 1 and _is_object(lines[0].removeprefix(b"\xef\xbb\xbf"))
        tree = from_json(_parse_lines(text.split("\n")) if several else json.loads(text))
    return Log(tables_of(tree, columns, path.name))


def _parse_lines(lines: Sequence[str]) -> list[Any]:
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
