"""Loss-adjusted prioritised replay."""

from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer


class SumTree:
    """
    A binary tree of sums: sample an entry in proportion to its value in ``log(n)`` steps.

    :param n: number of entries, which start at 0
    """

    def __init__(self, n: int) -> None:
        self._depth = max(1, (n - 1).bit_length())
        self._sums = np.zeros(2 << self._depth)

    @property
    def total(self) -> float:
        return float(self._sums[1])

    def set(self, index: np.ndarray, values: np.ndarray | float) -> None:
        """
        :param index: of the entries, shape ``(n,)``
        :param values: at least 0
        """
        node = np.asarray(index) + (1 << self._depth)
        self._sums[node] = values
        for _ in range(self._depth):
            node = np.unique(node >> 1)
            self._sums[node] = self._sums[2 * node] + self._sums[2 * node + 1]

    def draw(self, at: np.ndarray) -> np.ndarray:
        """
        :param at: numbers from 0 to ``total``, shape ``(n,)``
        :return: index of the entry at each number in the cumulative sum
        """
        node, at = np.ones(len(at), np.int64), np.array(at)
        for _ in range(self._depth):
            node = 2 * node
            left = self._sums[node]
            # With rounding, a number may exceed the sum of all entries: never go to an empty one.
            right = (at >= left) & (self._sums[node + 1] > 0.0)
            at = np.where(right, at - left, at)
            node = node + right
        return node - (1 << self._depth)

    def entries(self) -> np.ndarray:
        """:return: all entries, shape ``(m,)`` with ``m`` a power of 2; 0 beyond ``n``"""
        return self._sums[1 << self._depth :].copy()

    def largest(self) -> float:
        return float(self._sums[1 << self._depth :].max())


class LapReplayBuffer(ReplayBuffer):
    r"""
    Loss-adjusted prioritised replay (LAP): transitions are sampled in proportion to
    :math:`\max(|\delta|, 1)^\alpha`, new ones with the highest priority so far.

    Source: Fujimoto, Meger and Precup, *An Equivalence between Loss Functions and Non-Uniform
    Sampling in Experience Replay*, NeurIPS 2020.
    """

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        device: Any = "cpu",
        n_envs: int = 1,
        **kwargs: Any,
    ) -> None:
        super().__init__(
            buffer_size, observation_space, action_space, device, n_envs=n_envs, **kwargs
        )
        self.priorities = SumTree(self.buffer_size * n_envs)
        self.highest = 1.0

    def add(self, *args: Any, **kwargs: Any) -> None:
        rows = self.pos * self.n_envs + np.arange(self.n_envs)
        super().add(*args, **kwargs)
        self.priorities.set(rows, self.highest)

    def draw(self, n: int) -> tuple[np.ndarray, np.ndarray]:
        """:return: rows of the buffer and environments, each of shape ``(n,)``"""
        flat = self.priorities.draw(np.random.rand(n) * self.priorities.total)
        return flat // self.n_envs, flat % self.n_envs

    def set_priorities(self, steps: np.ndarray, copies: np.ndarray, priorities: np.ndarray) -> None:
        """
        :param steps: rows, as drawn
        :param copies: environments, as drawn
        :param priorities: new priorities of these transitions
        """
        self.priorities.set(steps * self.n_envs + copies, priorities)
        self.highest = max(self.highest, float(priorities.max()))

    def forget_highest(self) -> None:
        """Give new transitions the highest priority in the buffer, not the highest ever."""
        self.highest = self.priorities.largest()


# Pickled buffers refer to the public package, whose name does not change.
SumTree.__module__ = LapReplayBuffer.__module__ = "sb3_hds.algos"
