"""Environments with exactly integrated speed commands, as safety layers assume."""

import gymnasium
import numpy as np
from gymnasium import spaces

DT = 0.05  # [s]


class MovingJoints(gymnasium.Env):
    """Joints that move at the commanded speed, except for a lag; best at ``goal``."""

    dt = DT

    def __init__(self, n=1, goal=0.0, angles=False, lag=0.0):
        self.n, self.goal, self.angles, self.lag = n, goal, angles, lag
        self.observation_space = spaces.Box(-10.0, 10.0, ((2 if angles else 1) * n,))
        self.action_space = spaces.Box(-5.0, 5.0, (n,))
        self.q = np.zeros(n)

    def _observe(self):
        q = (np.cos(self.q), np.sin(self.q)) if self.angles else (self.q,)
        return np.concatenate(q).astype(np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        start = None if options is None else options.get("q")
        self.q = self.np_random.uniform(-0.45, 0.45, self.n) if start is None else np.array(start)
        return self._observe(), {}

    def step(self, action):
        self.told = np.array(action)
        self.q = self.q + (1.0 - self.lag) * np.asarray(action, float) * self.dt
        return self._observe(), -float(np.sum((self.q - self.goal) ** 2)), False, False, {}


def walls(obs):
    """The plane right of x = -1, below y = 1 and x + y <= 1, for two joints."""
    normals = np.array([[-1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])
    return normals * DT, 0.5 * (np.ones(3) - normals @ np.asarray(obs, float))


def distances(obs):
    """How far two joints are from these walls."""
    x, y = np.asarray(obs, float)
    return np.array([1.0 + x, 1.0 - y, 1.0 - x - y])


def nobody():
    """Who would end an episode by hand: never anybody."""
    return False


def somebody():
    """Always somebody."""
    return True
