"""Returns of a policy from initial states that are the same for all policies."""

import gymnasium
import numpy as np
from jaxtyping import Float
from stable_baselines3.common.base_class import BaseAlgorithm

#: seed of the first initial state, outside the seeds of trainings
FIRST_START = 70_000


def returns_of(
    model: BaseAlgorithm, env: gymnasium.Env, n_episodes: int = 50
) -> Float[np.ndarray, " episodes"]:
    """
    Run full episodes of the deterministic policy. Initial states depend on the environment only, so
    that policies can be compared in pairs.

    :param model: with the policy to run
    :param env: not vectorised; not closed
    :param n_episodes: number of episodes
    :return: undiscounted returns
    """
    totals = np.zeros(n_episodes)
    for episode in range(n_episodes):
        obs, _ = env.reset(seed=FIRST_START + episode)
        state, done = None, False
        start = np.ones(1, bool)
        while not done:
            action, state = model.predict(obs, state, start, deterministic=True)
            start = np.zeros(1, bool)
            obs, reward, terminated, truncated, _ = env.step(action)
            totals[episode] += float(reward)
            done = terminated or truncated
    return totals
