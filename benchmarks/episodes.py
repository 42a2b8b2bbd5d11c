"""Returns of a policy over whole episodes in several environments in parallel."""

from collections.abc import Sequence
from typing import Any

import numpy as np


def returns_of(model: Any, envs: Sequence[Any], first_seed: int) -> np.ndarray:
    """
    :param model: predicts for several observations at a time
    :param first_seed: of the first one's reset, the next of the next one's
    :return: return of an episode in each environment, of deterministic actions
    """
    obs = np.stack([env.reset(seed=first_seed + i)[0] for i, env in enumerate(envs)])
    returns, running = np.zeros(len(envs)), np.ones(len(envs), bool)
    while running.any():
        actions, _ = model.predict(obs, deterministic=True)
        for i in np.flatnonzero(running):
            obs[i], reward, terminated, truncated, _ = envs[i].step(actions[i])
            returns[i] += float(reward)
            running[i] = not (terminated or truncated)
    return returns
