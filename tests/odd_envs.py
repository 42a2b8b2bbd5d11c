"""Environments with one peculiarity: arbitrary spaces, or a sensor that fails."""

import gymnasium
import numpy as np
from gymnasium import spaces

#: of three numbers, and of one
OBS, ACT = spaces.Box(-1.0, 1.0, (3,)), spaces.Box(-1.0, 1.0, (1,))


class AnySpaces(gymnasium.Env):
    """Observations are samples of its space. Episodes have ten steps with a reward of 1 each."""

    def __init__(self, observation_space: spaces.Space = OBS, action_space=ACT) -> None:
        self.observation_space, self.action_space = observation_space, action_space

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.n = 0
        return self.observation_space.sample(), {}

    def step(self, action):
        assert self.action_space.contains(action)
        self.n += 1
        return self.observation_space.sample(), 1.0, False, self.n == 10, {}


class Dead(gymnasium.Wrapper):
    """Pendulum-v1 whose sensor, or reward, is ``value`` from the tenth step on."""

    def __init__(self, value: float, of_reward: bool = False) -> None:
        super().__init__(gymnasium.make("Pendulum-v1"))
        self.value, self.of_reward, self.n_steps = value, of_reward, 0

    def step(self, action):
        self.n_steps += 1
        obs, reward, *ends = super().step(action)
        if self.n_steps >= 10 and self.of_reward:
            reward = self.value
        elif self.n_steps >= 10:
            obs = np.full_like(obs, self.value)
        return obs, reward, *ends
