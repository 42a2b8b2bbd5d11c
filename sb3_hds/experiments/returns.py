"""Return of a policy from start states that others can be measured from as well."""

import gymnasium
import numpy as np
from jaxtyping import Float
from stable_baselines3.common.base_class import BaseAlgorithm

#: seed of the first start state, which no training uses
FIRST_START = 70_000


def returns_of(
    model: BaseAlgorithm, env: gymnasium.Env, n_episodes: int = 50
) -> Float[np.ndarray, " episodes"]:
    """
    Run whole episodes of the deterministic policy. Start states depend on the environment only, so
    that policies can be compared in pairs.

    :param model: a policy
    :param env: not vectorised, left as it is after the last episode
    :param n_episodes: how many
    :return: undiscounted
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
