"""
Measured data: readers of logs, recordings, and an audit before any physics is fitted.

Importing it registers the log readers with ``Trajectories.load``.

Names are imported on first use, so that a control loop on a robot loads neither JAX nor PyTorch.
"""

from typing import Any

from sb3_hds.core.trajectories.storage import register_log_reader
from sb3_hds.lazy import lazy_imports

with lazy_imports(__name__):
    from sb3_hds.core.trajectories import Trajectories
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


def _load(files: Any, columns: Any) -> "Trajectories":
    from sb3_hds.data.load import load

    return load(files, columns)


register_log_reader(_load)
