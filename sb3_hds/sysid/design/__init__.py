"""What to record next: commands within a machine's limits that decide between answers."""

from sb3_hds.sysid.design.limits import Limits
from sb3_hds.sysid.design.result import NextExperiment

__all__ = ["Limits", "NextExperiment"]
