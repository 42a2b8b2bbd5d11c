"""The smallest task whose values depend on whether its time limit is a truncation."""

import math
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from sb3_hds.errors import ParameterError


class ConstantReward(gymnasium.Env[np.ndarray, np.ndarray]):
    r"""
    Every step pays the same reward, actions have no effect, and the observation is a clock.

    With a time limit of ``period`` steps and the discount :math:`\gamma`, the value of the first
    state is

    .. math::

        V = r \frac{1}{1 - \gamma} \quad \text{if the limit is a truncation,} \qquad
        V = r \frac{1 - \gamma^n}{1 - \gamma} \quad \text{if it is a termination,}

    that is 50 and 3.88 for ``reward=1``, ``period=4`` and :math:`\gamma = 0.98`: a learner that
    confuses them is wrong by a factor of 13. The clock completes one period at the time limit, so
    the last observation is also a start state, and its value is learned.

    Source: the example of A. Raffin's talk *Ingredients for learning locomotion directly on real
    hardware* (2024).

    :param reward: of each step
    :param period: of the clock [steps]; the registered time limit is 4
    :param render_mode: None
    :raises ParameterError: for a period that is not a positive integer, or a reward that is not
        finite
    """

    metadata = {"render_modes": []}

    def __init__(
        self, reward: float = 1.0, period: int = 4, render_mode: str | None = None
    ) -> None:
        if isinstance(period, bool) or not isinstance(period, int) or period < 1:
            raise ParameterError(f"period must be a positive integer, got {period!r}.")
        if not math.isfinite(reward):
            raise ParameterError(f"reward must be finite, got {reward!r}.")
        if render_mode is not None:
            raise ParameterError(f"There is nothing to render: got render_mode={render_mode!r}.")
        self.reward, self.period, self.render_mode = float(reward), period, None
        self.observation_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
        self._elapsed = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self._elapsed = 0
        return self._obs(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self._elapsed += 1
        return self._obs(), self.reward, False, False, {}

    def _obs(self) -> np.ndarray:
        phase = 2.0 * math.pi * (self._elapsed % self.period) / self.period
        return np.array([math.cos(phase), math.sin(phase)], np.float32)
