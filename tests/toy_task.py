"""A task in which one property at a time can be made wrong."""

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit

LIMIT = 200


class Toy(gymnasium.Env):
    """A mass on a spring; each step costs ``0.3 (x^2 + v^2)``, of order 1 under random actions."""

    def __init__(
        self,
        units: float = 1.0,
        max_force: float = 1.0,
        reward: str = "cost",
        scale: float = 1.0,
        sees_velocity: bool = True,
        sees_action: bool = False,
        fails: bool = False,
        end: float = 0.0,
        success: bool = False,
    ) -> None:
        self.units, self.max_force, self.reward, self.scale = units, max_force, reward, scale
        self.sees_velocity, self.sees_action = sees_velocity, sees_action
        self.fails, self.end, self.success = fails, end, success
        size = 1 + sees_velocity + sees_action
        self.observation_space = spaces.Box(-np.inf, np.inf, (size,), np.float64)
        self.action_space = spaces.Box(-max_force, max_force, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x, self.v, self.before, self.now = *self.np_random.normal(size=2), 0.0, 0
        return self._obs(), {}

    def step(self, action):
        force = float(action[0]) / (self.max_force if np.isfinite(self.max_force) else 1.0)
        paid = self.scale * self._paid(force)
        self.v += 0.3 * (4.0 * force - self.x - 0.5 * self.v)
        self.x += 0.3 * self.v
        self.before, self.now = force, self.now + 1
        over = self.fails and abs(self.x) > 2.0
        return self._obs(), self.end if over else paid, over, False, {"is_success": self.success}

    def _paid(self, force: float) -> float:
        cost = 0.3 * (self.x**2 + self.v**2)
        return {
            "cost": -cost,
            "constant": -1.0,
            "nothing": 0.0,
            "effort": -(force**2),
            "rare": float(self.x > 3.6),
            "late": float(self.now == 190),
            "jerk": -cost - 2.0 * (force - self.before) ** 2,
        }[self.reward]

    def _obs(self):
        told = [self.x] + [self.v] * self.sees_velocity + [self.before] * self.sees_action
        return self.units * np.array(told)


def toy(limit: int | None = LIMIT, **settings) -> gymnasium.Env:
    """:param limit: steps after which an episode is truncated; None: none"""
    env = Toy(**settings)
    return env if limit is None else TimeLimit(env, limit)
