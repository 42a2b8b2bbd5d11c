"""
Measured data: the type, its files, and where it comes from.

Names are imported on first use, so that a control loop on a robot needs neither JAX nor PyTorch.
"""

from sb3_hds.lazy import lazy_imports

with lazy_imports(__name__):
    from sb3_hds.core.trajectories.trajectories import Trajectories

__all__ = ["Trajectories"]
