"""The ids of our environments. Imports neither jax nor torch: ``import sb3_hds`` runs it."""

import gymnasium

#: Environments made of a twin: id -> steps after which ``TimeLimit`` truncates an episode.
STEP_LIMITS = {
    "sb3_hds/AcrobotContinuous-v0": 500,
    "sb3_hds/CartPoleSwingUp-v0": 250,
    "sb3_hds/PayloadPendulum-v0": 100,
}

#: Stand-ins for hardware, stepped by MuJoCo's engine: id -> class and step limit.
HARDWARE = {
    "sb3_hds/InvertedPendulumFriction-v5": (
        "sb3_hds.envs.tasks.inverted_pendulum_friction:InvertedPendulumFriction",
        1000,
    ),
    "sb3_hds/PendulumReal-v1": ("sb3_hds.envs.tasks.pendulum_real:PendulumReal", 200),
}

#: Tasks without a twin: id -> class and step limit.
TASKS = {
    "sb3_hds/ConstantReward-v0": ("sb3_hds.envs.tasks.constant_reward:ConstantReward", 4),
    "sb3_hds/ElasticQuadruped-v0": ("sb3_hds.envs.tasks.elastic_quadruped:ElasticQuadruped", 500),
}


def register_environments() -> None:
    """
    Register our ids with ``gymnasium.make``. Calling it again changes nothing.

    Keyword arguments of ``gymnasium.make`` are settings of the twin: values of parameters by name,
    its options, ``dt`` [s], ``substeps``. Those of the stand-ins for hardware and of the tasks
    without a twin are documented in their classes. If another process makes the environment by its
    id, as with SB3's ``SubprocVecEnv``, prefix the package:
    ``"sb3_hds:sb3_hds/CartPoleSwingUp-v0"``.
    """
    twins = {env_id: ("sb3_hds.envs.twin_env:TwinEnv", n) for env_id, n in STEP_LIMITS.items()}
    for env_id, (entry_point, max_episode_steps) in (twins | HARDWARE | TASKS).items():
        if env_id not in gymnasium.registry:
            gymnasium.register(
                env_id,
                entry_point=entry_point,
                max_episode_steps=max_episode_steps,
                kwargs={"twin": env_id} if env_id in twins else {},
            )
