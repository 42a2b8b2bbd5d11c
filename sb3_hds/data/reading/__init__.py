"""Readers of log files: one module for each family of formats."""

from sb3_hds.data.reading.log import Log, Table
from sb3_hds.data.reading.registry import READERS, read_log

__all__ = ["READERS", "Log", "Table", "read_log"]
