"""
Environments made from twins, and the twins that mirror environments.

Names are imported on first use, so that registering our ids imports neither jax nor torch.
"""

from sb3_hds.lazy import lazy_imports

with lazy_imports(__name__):
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
