"""Deterministic episodes, in which every observation says where it comes from."""

from typing import NamedTuple

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv


def length_of(copy: int, episode: int) -> int:
    """:return: steps of the episode: copies end at different times"""
    return 1 + (2 * copy + episode) % 4


def is_cut(copy: int, episode: int) -> bool:
    """:return: whether the episode is truncated; otherwise it terminates"""
    return (copy + episode) % 2 == 0


def reward_of(copy: int, episode: int, step: int) -> float:
    return 100.0 * copy + 10.0 * episode + step


class Row(NamedTuple):
    """A transition. Observations are copy, episode, step and the action before, 0 at the start."""

    obs: tuple[float, ...]
    action: float
    reward: float
    next_obs: tuple[float, ...]
    done: bool
    cut: bool


def truth(copy: int, actions: np.ndarray) -> list[Row]:
    """:return: the transitions of these actions"""
    rows, episode, step, before = [], 0, 0, 0.0
    for action in actions:
        obs, done = (copy, episode, step, before), step + 1 == length_of(copy, episode)
        reward, after = reward_of(copy, episode, step), (copy, episode, step + 1, float(action))
        cut = done and is_cut(copy, episode)
        rows.append(Row(obs, float(action), reward, after, done, cut))
        episode, step = (episode + 1, 0) if done else (episode, step + 1)
        before = 0.0 if done else float(action)
    return rows


class Counting(gymnasium.Env):
    """Counts its episodes and steps; the grey level of its images is its number."""

    metadata = {"render_modes": ["rgb_array"]}
    observation_space = spaces.Box(-np.inf, np.inf, (4,), np.float32)
    action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)

    def __init__(self, copy: int = 0, render_mode: str | None = None) -> None:
        self.render_mode = render_mode
        self.copy, self.episode, self.step_now, self.colour = copy, -1, 0, "red"

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        # A seed restarts the count of episodes.
        self.episode = 0 if seed is not None else self.episode + 1
        self.step_now = 0
        return self._obs(0.0), {"begun": self.episode, "seed": seed, "options": options}

    def step(self, action):
        reward = reward_of(self.copy, self.episode, self.step_now)
        self.step_now += 1
        done = self.step_now == length_of(self.copy, self.episode)
        cut = done and is_cut(self.copy, self.episode)
        info = {"step": self.step_now}
        return self._obs(float(action[0])), reward, done and not cut, cut, info

    def render(self):
        return np.full((2, 2, 3), self.copy, np.uint8)

    def painted(self, colour: str) -> str:
        """A method that is called through the vectorised environment."""
        return f"{colour} {self.copy}"

    def _obs(self, action: float) -> np.ndarray:
        return np.array([self.copy, self.episode, self.step_now, action], np.float32)


class CountingVector(VectorEnv):
    """A user's own ``VectorEnv``, which reuses one buffer for all observations."""

    def __init__(
        self,
        n: int,
        mode: AutoresetMode,
        final_obs: str | None = "final_obs",
        knows_masks: bool = True,
    ) -> None:
        self.num_envs, self.metadata = n, {"autoreset_mode": mode}
        self.mode, self.final_obs, self.knows_masks = mode, final_obs, knows_masks
        self.single_observation_space = Counting.observation_space
        self.single_action_space = Counting.action_space
        self.observation_space = gymnasium.vector.utils.batch_space(Counting.observation_space, n)
        self.action_space = gymnasium.vector.utils.batch_space(Counting.action_space, n)
        self.copies = [Counting(i) for i in range(n)]
        self.pending = np.zeros(n, bool)
        self._obs = np.zeros((n, 4), np.float32)

    def reset(self, *, seed=None, options=None):
        mask = (options or {}).get("reset_mask") if self.knows_masks else None
        for i, copy in enumerate(self.copies):
            if mask is None or mask[i]:
                self._obs[i] = copy.reset(seed=None if seed is None else seed + i)[0]
                self.pending[i] = False
        return self._obs, {}

    def step(self, actions):
        n = self.num_envs
        rewards, ended, cut, last = np.zeros(n), np.zeros(n, bool), np.zeros(n, bool), {}
        for i, copy in enumerate(self.copies):
            if self.pending[i]:
                self._obs[i], self.pending[i] = copy.reset()[0], False
                continue
            self._obs[i], rewards[i], ended[i], cut[i], _ = copy.step(actions[i])
            if ended[i] or cut[i]:
                self.pending[i] = self.mode is AutoresetMode.NEXT_STEP
                if self.mode is AutoresetMode.SAME_STEP:
                    last[i] = self._obs[i].copy()
                    self._obs[i] = copy.reset()[0]
        infos = {}
        if last and self.final_obs:
            rows = np.full(n, None, object)
            for i, obs in last.items():
                rows[i] = obs
            infos = {self.final_obs: rows, f"_{self.final_obs}": ended | cut}
        return self._obs, rewards, ended, cut, infos
