"""
Environments made from twins, and the twins that mirror environments.

Names are imported on first use, so that registering our ids imports neither jax nor torch.
"""

from typing import TYPE_CHECKING

from sb3_hds.lazy import lazily

if TYPE_CHECKING:
    from sb3_hds.envs.ground_truth import true_twin
    from sb3_hds.envs.mirror import check_mirrors, twin_of
    from sb3_hds.envs.registration import register_environments
    from sb3_hds.envs.tasks.constant_reward import ConstantReward
    from sb3_hds.envs.tasks.elastic_quadruped import ElasticQuadruped
    from sb3_hds.envs.tasks.inverted_pendulum_friction import InvertedPendulumFriction
    from sb3_hds.envs.tasks.pendulum_real import PendulumReal
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

lazily(
    __name__,
    {
        "tasks.constant_reward": ("ConstantReward",),
        "tasks.elastic_quadruped": ("ElasticQuadruped",),
        "ground_truth": ("true_twin",),
        "tasks.inverted_pendulum_friction": ("InvertedPendulumFriction",),
        "mirror": ("check_mirrors", "twin_of"),
        "tasks.pendulum_real": ("PendulumReal",),
        "registration": ("register_environments",),
        "twin_env": ("TwinEnv",),
        "twin_vec_env": ("TwinVecEnv",),
        "verify": ("verify_mirror",),
    },
)
