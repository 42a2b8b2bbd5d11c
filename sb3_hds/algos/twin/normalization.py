"""``VecNormalize`` around the environment, honoured while planning in the twin."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from stable_baselines3.common.vec_env import VecNormalize

from sb3_hds.algos.twin.state import View
from sb3_hds.core import Twin
from sb3_hds.planning import Problem, best_of_random

# Rollouts and steps from which the first statistics are made.
_N_ROLLOUTS, _N_STEPS = 64, 50


def view_of(normalise: VecNormalize | None, n_obs: int) -> View:
    """
    :param normalise: the environment's normalisation, if it has one
    :return: what it does to an observation of the twin
    """
    if normalise is None or not normalise.norm_obs:
        return View(jnp.zeros(n_obs), jnp.ones(n_obs), jnp.full((), jnp.inf, jnp.float32))
    statistics: Any = normalise.obs_rms
    scale = np.sqrt(statistics.var + normalise.epsilon)
    return View(
        jnp.asarray(statistics.mean, jnp.float32),
        jnp.asarray(scale, jnp.float32),
        jnp.asarray(normalise.clip_obs, jnp.float32),
    )


def prepare_statistics(normalise: VecNormalize | None, twin: Twin, key: jax.Array) -> None:
    """
    Give a fresh ``VecNormalize`` the statistics of episodes in the twin. Otherwise a policy that is
    trained before the first real step would see other numbers afterwards.

    Statistics that are frozen, or already rest on more observations, are left alone.

    :param normalise: changed in place
    """
    if normalise is None or not normalise.norm_obs or not normalise.training:
        return
    statistics: Any = normalise.obs_rms
    if statistics.count >= _N_ROLLOUTS * _N_STEPS:
        return
    problem = Problem(twin, twin.params)
    length = min(_N_STEPS, twin.max_episode_steps or _N_STEPS)

    def wander(k: jax.Array) -> tuple[jax.Array, jax.Array]:
        k_start, k_plan = jax.random.split(k)
        start = twin.initial(k_start, twin.params)
        plan = best_of_random(problem, start, k_plan, length, 1)
        return jax.vmap(problem.observe)(plan.states), plan.alive

    seen, alive = jax.jit(jax.vmap(wander))(jax.random.split(key, _N_ROLLOUTS))
    lived = np.asarray(seen, np.float64)[np.asarray(alive)]
    statistics.update(lived[np.isfinite(lived).all(1)])
