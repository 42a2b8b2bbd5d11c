# ruff: noqa: F401  what editors know of names that are imported on first use
"""
Learning algorithms behind Stable-Baselines3's API.

Names are imported on first use, so that model-free learning does not import system identification.
"""

import importlib
from typing import TYPE_CHECKING, Any

from sb3_hds.algos import registry

if TYPE_CHECKING:
    from sb3_hds.algos.base.executed_actions import ExecutedDictReplayBuffer, ExecutedReplayBuffer
    from sb3_hds.algos.base.policy_file import load_policy
    from sb3_hds.algos.base.threaded_training import TrainBeside
    from sb3_hds.algos.model_free.sac.bro import BRO
    from sb3_hds.algos.model_free.sac.compiled.learn import Episodes, learn_compiled
    from sb3_hds.algos.model_free.sac.crossq import CrossQ
    from sb3_hds.algos.model_free.sac.droq import DroQ
    from sb3_hds.algos.model_free.sac.gsde_sac import GSDESAC
    from sb3_hds.algos.model_free.sac.policy import GaussianPolicy
    from sb3_hds.algos.model_free.sac.simba import SimbaSAC
    from sb3_hds.algos.model_free.sac.tqc import TQC
    from sb3_hds.algos.model_free.td7.algorithm import TD7
    from sb3_hds.algos.model_free.td7.prioritized_replay import LapReplayBuffer, SumTree
    from sb3_hds.algos.open_loop.algorithm import OpenLoop
    from sb3_hds.algos.open_loop.policy import OscillatorPolicy
    from sb3_hds.algos.twin.hds.algorithm import HDS
    from sb3_hds.algos.twin.pods import PODS
    from sb3_hds.algos.twin.policy import TwinPolicy

    #: every algorithm by its id in the zoo
    ALL: dict[str, Any]

# Public names besides algorithms and policies.
_OTHERS = {
    "Episodes": "model_free.sac.compiled.learn",
    "ExecutedDictReplayBuffer": "base.executed_actions",
    "ExecutedReplayBuffer": "base.executed_actions",
    "LapReplayBuffer": "model_free.td7.prioritized_replay",
    "SumTree": "model_free.td7.prioritized_replay",
    "TrainBeside": "base.threaded_training",
    "learn_compiled": "model_free.sac.compiled.learn",
    "load_policy": "base.policy_file",
}
_MODULES = registry.MODULES | _OTHERS

__all__ = ["ALL", *sorted(_MODULES)]  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name == "ALL":
        globals()["ALL"] = found = registry.load_all()
        return found
    if name not in _MODULES:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    return getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
