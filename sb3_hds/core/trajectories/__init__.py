"""Measured data: the type, its files, and where it comes from."""

from sb3_hds.core.trajectories.trajectories import Trajectories, read_logs_by

__all__ = ["Trajectories", "read_logs_by"]
