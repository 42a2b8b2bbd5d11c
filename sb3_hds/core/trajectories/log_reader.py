"""Who reads logs: ``core`` may not know tables."""

from collections.abc import Callable
from typing import Any

LogReader = Callable[[Any, Any], Any]

_reader: LogReader | None = None


def read_logs_by(reader: LogReader) -> None:
    """
    :param reader: of files and columns, as ``Trajectories.load`` takes them
    """
    global _reader
    _reader = reader


def log_reader() -> LogReader | None:
    """:return: the reader; None before ``sb3_hds.data`` is imported"""
    return _reader
