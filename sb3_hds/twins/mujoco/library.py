"""MuJoCo itself, which only those pay for who read a model."""

from typing import Any


def mujoco() -> Any:
    """:return: the module; its functions come from an extension that type checkers cannot see"""
    import mujoco

    return mujoco
