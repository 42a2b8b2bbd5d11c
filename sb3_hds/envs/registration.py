"""Our environments' ids. This module imports neither jax nor torch: ``import sb3_hds`` runs it."""

import gymnasium

#: Environments made of a twin: id -> steps after which gymnasium's ``TimeLimit`` cuts an episode.
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

_ENTRY_POINT = "sb3_hds.envs.twin_env:TwinEnv"


def register_environments() -> None:
    """
    Make our ids known to ``gymnasium.make``. Calling it again changes nothing.

    Keyword arguments of ``gymnasium.make`` are settings of the twin: values of parameters by name,
    its options, ``dt`` [s], ``substeps``; those of the stand-ins for hardware and of the tasks
    without a twin are documented in their classes. Where another process makes the environment by
    its id, as with SB3's ``SubprocVecEnv``, name the package too:
    ``"sb3_hds:sb3_hds/CartPoleSwingUp-v0"``.
    """
    for env_id, max_episode_steps in STEP_LIMITS.items():
        if env_id not in gymnasium.registry:
            gymnasium.register(
                env_id,
                entry_point=_ENTRY_POINT,
                max_episode_steps=max_episode_steps,
                kwargs={"twin": env_id},
            )
    for env_id, (entry_point, max_episode_steps) in (HARDWARE | TASKS).items():
        if env_id not in gymnasium.registry:
            gymnasium.register(env_id, entry_point=entry_point, max_episode_steps=max_episode_steps)
