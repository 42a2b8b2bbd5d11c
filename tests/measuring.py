"""Synthetic recordings, simulated by a twin with known parameters."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from sb3_hds.core import Trajectories, rollout


@functools.partial(jax.jit, static_argnums=0)
def _observed(twin, params, keys, actions):
    def one(key, action):
        return rollout(twin, params, twin.initial(key, params), action).obs

    return jax.vmap(one)(keys, actions)


def measured(twin, n=8, n_steps=60, noise=0.0, seed=0, share=0.8, commands=None):
    """
    :param noise: standard deviation of each channel
    :param share: used share of the range of commands
    :param commands: instead of smooth random ones, shape ``(n, n_steps, n_act)``
    :return: episodes, all from the twin's own start states
    """
    rng = np.random.default_rng(seed)
    actions = wandering(twin, n, n_steps, share, rng) if commands is None else commands
    keys = jax.random.split(jax.random.key(seed), n)
    with jax.enable_x64(True):
        params = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), twin.params)
        obs = np.asarray(_observed(twin, params, keys, jnp.asarray(actions)))
    obs = obs + noise * rng.standard_normal(obs.shape)
    return Trajectories.from_arrays(obs, actions, dt=twin.dt)


def jumping(n, n_levels=20, each=10, size=4.0):
    """:return: piecewise constant commands, shape ``(n, n_levels * each, 1)``"""
    return size * np.random.default_rng(1).standard_normal((n, n_levels, 1)).repeat(each, 1)


def wandering(twin, n, n_steps, share, rng):
    low, high = (np.array([getattr(a, end) for a in twin.actuators]) for end in ("low", "high"))
    wander = rng.standard_normal((n, n_steps, len(low))).cumsum(1)
    wander = np.sin(0.7 * wander + rng.uniform(0.0, 6.0, (n, 1, 1)))
    return low + (0.5 + 0.5 * share * wander) * (high - low)
