"""
Measured data in and out: readers, recordings, and an audit before any physics.

Importing it teaches ``Trajectories.load`` to read logs.
"""

from sb3_hds.core.trajectories import Trajectories, read_logs_by
from sb3_hds.data.audit import Audit, audit
from sb3_hds.data.audit.finding import Finding
from sb3_hds.data.columns import Columns, Entry, Label, columns_from
from sb3_hds.data.load import SamplingWarning, load
from sb3_hds.data.recording import Recorder
from sb3_hds.data.resampling.report import Reading, Sampling

__all__ = [
    "Audit",
    "Columns",
    "Entry",
    "Finding",
    "Label",
    "Reading",
    "Recorder",
    "Sampling",
    "SamplingWarning",
    "Trajectories",
    "audit",
    "columns_from",
    "load",
]

read_logs_by(load)
