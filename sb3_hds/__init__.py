# ruff: noqa: F401  imports for type checkers of names that are imported on first use
"""
Learn through a differentiable simulation of your environment, and find out what it gets wrong.

Importing the package registers its environments with Gymnasium. It imports neither jax nor torch:
names are imported on first use.
"""

import importlib
from typing import TYPE_CHECKING, Any

from sb3_hds.algos.registry import ALGORITHMS
from sb3_hds.envs.registration import register_environments

if TYPE_CHECKING:
    from sb3_hds import data, effects, envs, planning, sysid, twins, wrappers
    from sb3_hds.algos import (
        BRO,
        GSDESAC,
        HDS,
        PODS,
        TD7,
        TQC,
        CrossQ,
        DroQ,
        OpenLoop,
        SimbaSAC,
        load_policy,
    )
    from sb3_hds.data import Trajectories, audit
    from sb3_hds.sysid import calibrate, diagnose

    __version__: str

_MODULES = {
    **dict.fromkeys((entry.name for entry in ALGORITHMS.values()), "algos"),
    "Trajectories": "data",
    "audit": "data",
    "calibrate": "sysid",
    "diagnose": "sysid",
    "load_policy": "algos",
}
_LAYERS = ("data", "effects", "envs", "planning", "sysid", "twins", "wrappers")

__all__ = sorted([*_MODULES, *_LAYERS])  # pyright: ignore[reportUnsupportedDunderAll]

register_environments()


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        return getattr(importlib.import_module(f"sb3_hds.{_MODULES[name]}"), name)
    if name in _LAYERS:
        return importlib.import_module(f"sb3_hds.{name}")
    if name == "__version__":
        return _version()
    raise AttributeError(f"module 'sb3_hds' has no attribute '{name}'")


def _version() -> str:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("sb3-hds")
    except PackageNotFoundError:  # a checkout that is on the path without being installed
        return "0+unknown"


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
