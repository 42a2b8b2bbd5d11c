"""The ways in which an algorithm may be called."""

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import jax
from stable_baselines3.common.vec_env import VecEnv


def policy_and_env(policy: Any, env: Any, aliases: Mapping[str, Any]) -> tuple[Any, Any]:
    """
    A lone environment, or a lone string that names no policy, is the environment:
    ``HDS("Pendulum-v1")`` means ``HDS("MlpPolicy", "Pendulum-v1")``.

    :return: policy and environment in SB3's order
    """
    if env is None and (
        isinstance(policy, gym.Env | VecEnv) or (isinstance(policy, str) and policy not in aliases)
    ):
        return "MlpPolicy", policy
    return policy, env


def jax_device(device: Any) -> jax.Device:
    """
    :param device: ``"auto"``, ``"cpu"``, ``"cuda"``, ``"cuda:1"`` or a ``torch.device``
    :return: the JAX device of that name
    :raises ValueError: if JAX has no such device
    """
    kind, _, index = str(device).partition(":")
    if kind == "auto":
        return jax.devices()[0]
    platform = {"cuda": "gpu"}.get(kind, kind)
    try:
        return jax.devices(platform)[int(index or 0)]
    except (RuntimeError, IndexError, ValueError):
        available = ", ".join(str(d) for d in jax.devices())
        raise ValueError(
            f"device='{device}' asks for something JAX does not have here; it has: {available}. "
            "Use device='auto', or install JAX for your accelerator (pip install 'jax[cuda13]')."
        ) from None
