"""What to record next: commands within a machine's limits that decide between answers."""

from sb3_hds.sysid.design.experiment import NextExperiment
from sb3_hds.sysid.design.limits import Limits

__all__ = ["Limits", "NextExperiment"]
