"""A task that a clipped linear controller solves: push a mass to the origin."""

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from free_mass import Mass
from gymnasium import spaces
from scipy.linalg import solve_discrete_are

from sb3_hds.core import Actuator, Channel, Parameter, State
from sb3_hds.envs import TwinEnv

N_STEPS = 20
_LOW, _HIGH = -1.0, 3.0  # [N]
_DRAG = 0.5  # [N s/m]


class PointMass(Mass):
    r""":math:`m\dot v = u - 0.5\,v`, -1 to 3 N; the reward is that of where the mass was."""

    name = "PointMass"
    dt = 0.2
    max_episode_steps = N_STEPS
    actuators = (Actuator("force", "N", _LOW, _HIGH),)
    channels = (Channel("x", "m", -10.0, 10.0), Channel("v", "m/s", -10.0, 10.0))
    parameters = {"mass": Parameter(null=1.0, scale=0.2, unit="kg", lower=1e-3)}

    def initial(self, key, params):
        start = jax.random.uniform(key, (1,), minval=-1.0, maxval=1.0)
        return State(start, jnp.zeros(1), {})

    def actuate(self, state, action, params):
        return jnp.clip(action, _LOW, _HIGH)

    def bias(self, q, v, params):
        return _DRAG * v

    def reward(self, state, action, next_state, params):
        return -jnp.sum(state.q**2 + 0.1 * state.v**2 + 0.01 * action**2)


def point_mass_env(dtype: type = np.float32) -> gymnasium.Env:
    """:param dtype: of the action space"""
    env = TwinEnv(PointMass())
    env.action_space = spaces.Box(_LOW, _HIGH, (1,), dtype)
    return gymnasium.wrappers.TimeLimit(env, N_STEPS)


def returns_of(policy, n_episodes: int = 20) -> np.ndarray:
    """Of the first episodes, whose starts are always the same."""
    env, returns = point_mass_env(), []
    for seed in range(n_episodes):
        obs, _ = env.reset(seed=seed)
        total, over = 0.0, False
        while not over:
            obs, reward, _, over, _ = env.step(policy(obs))
            total += reward
        returns.append(total)
    return np.array(returns)


def linear_controller():
    """:return: the optimal policy of the linear-quadratic problem, clipped to the limits"""
    dt = PointMass.dt
    # Semi-implicit Euler: the new speed moves the mass.
    speed = np.array([[0.0, 1.0 - dt * _DRAG]])
    A = np.vstack([[1.0, 0.0] + dt * speed, speed])
    B = np.array([[dt * dt], [dt]])
    Q, R = np.diag([1.0, 0.1]), np.array([[0.01]])
    P = solve_discrete_are(A, B, Q, R)
    gain = np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
    return lambda obs: np.clip(-gain @ obs, _LOW, _HIGH)
