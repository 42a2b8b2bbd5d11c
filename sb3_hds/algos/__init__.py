"""
Learning algorithms behind Stable-Baselines3's API, one file each.

Names are imported on first use: who learns without a twin does not wait for what fits one to data.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sb3_hds.algos.bro import BRO
    from sb3_hds.algos.compiled import Episodes, learn_compiled
    from sb3_hds.algos.crossq import CrossQ
    from sb3_hds.algos.droq import DroQ
    from sb3_hds.algos.every import ALL
    from sb3_hds.algos.executed_actions import ExecutedDictReplayBuffer, ExecutedReplayBuffer
    from sb3_hds.algos.gaussian_policy import GaussianPolicy
    from sb3_hds.algos.gsde_sac import GSDESAC
    from sb3_hds.algos.hds import HDS
    from sb3_hds.algos.open_loop import OpenLoop
    from sb3_hds.algos.oscillator_policy import OscillatorPolicy
    from sb3_hds.algos.pods import PODS
    from sb3_hds.algos.policy_file import load_policy
    from sb3_hds.algos.simba import SimbaSAC
    from sb3_hds.algos.td7 import TD7
    from sb3_hds.algos.tqc import TQC
    from sb3_hds.algos.train_beside import TrainBeside
    from sb3_hds.algos.twin_policy import TwinPolicy

__all__ = [
    "ALL",
    "BRO",
    "GSDESAC",
    "HDS",
    "PODS",
    "TD7",
    "TQC",
    "CrossQ",
    "DroQ",
    "Episodes",
    "ExecutedDictReplayBuffer",
    "ExecutedReplayBuffer",
    "GaussianPolicy",
    "OpenLoop",
    "OscillatorPolicy",
    "SimbaSAC",
    "TrainBeside",
    "TwinPolicy",
    "learn_compiled",
    "load_policy",
]

_MODULES = {
    "ALL": "every",
    "BRO": "bro",
    "CrossQ": "crossq",
    "DroQ": "droq",
    "Episodes": "compiled",
    "ExecutedDictReplayBuffer": "executed_actions",
    "ExecutedReplayBuffer": "executed_actions",
    "GSDESAC": "gsde_sac",
    "GaussianPolicy": "gaussian_policy",
    "HDS": "hds",
    "OpenLoop": "open_loop",
    "OscillatorPolicy": "oscillator_policy",
    "PODS": "pods",
    "SimbaSAC": "simba",
    "TD7": "td7",
    "TQC": "tqc",
    "TrainBeside": "train_beside",
    "TwinPolicy": "twin_policy",
    "learn_compiled": "compiled",
    "load_policy": "policy_file",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    return getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
