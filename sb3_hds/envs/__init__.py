"""
Environments made of twins, and the way back: the twin that mirrors an environment.

Names are imported on first use, so that registering our ids costs neither jax nor torch.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sb3_hds.envs.constant_reward import ConstantReward
    from sb3_hds.envs.elastic_quadruped import ElasticQuadruped
    from sb3_hds.envs.ground_truth import true_twin
    from sb3_hds.envs.inverted_pendulum_friction import InvertedPendulumFriction
    from sb3_hds.envs.mirror import check_mirrors, twin_of
    from sb3_hds.envs.pendulum_real import PendulumReal
    from sb3_hds.envs.registration import register_environments
    from sb3_hds.envs.twin_env import TwinEnv
    from sb3_hds.envs.twin_vec_env import TwinVecEnv
    from sb3_hds.envs.verify import verify_mirror

__all__ = [
    "ConstantReward",
    "ElasticQuadruped",
    "InvertedPendulumFriction",
    "PendulumReal",
    "TwinEnv",
    "TwinVecEnv",
    "check_mirrors",
    "register_environments",
    "true_twin",
    "twin_of",
    "verify_mirror",
]

_MODULES = {
    "ConstantReward": "constant_reward",
    "ElasticQuadruped": "elastic_quadruped",
    "InvertedPendulumFriction": "inverted_pendulum_friction",
    "PendulumReal": "pendulum_real",
    "TwinEnv": "twin_env",
    "TwinVecEnv": "twin_vec_env",
    "check_mirrors": "mirror",
    "register_environments": "registration",
    "true_twin": "ground_truth",
    "twin_of": "mirror",
    "verify_mirror": "verify",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    return getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
