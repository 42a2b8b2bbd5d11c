"""The MuJoCo library, imported on first use."""

from typing import Any


def mujoco() -> Any:
    """:return: the module; its functions come from an extension that type checkers cannot see"""
    import mujoco

    return mujoco
