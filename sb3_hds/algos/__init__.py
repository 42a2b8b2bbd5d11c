"""Learning algorithms behind Stable-Baselines3's API, one file each."""

from sb3_hds.algos.hds import HDS
from sb3_hds.algos.pods import PODS
from sb3_hds.algos.twin_policy import TwinPolicy

#: every algorithm by its id in the zoo: listed here, it is tested, registered and documented
ALL = {"pods": PODS, "hds": HDS}

__all__ = ["ALL", "HDS", "PODS", "TwinPolicy"]
