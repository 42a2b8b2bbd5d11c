"""Numbers of recordings, which they keep though old steps are lost."""

from collections.abc import Sequence
from typing import Any

import torch as th


class Recordings:
    """
    Counts the recordings that went through a replay buffer.

    Whether a window is held out depends on the number of its recording. Counted from the oldest
    step that is left, recordings would get other numbers whenever old steps are overwritten, or
    left out of a file, and what was learned from would be held out.

    :param n_before: recordings that there were before any went through the buffer
    """

    def __init__(self, n_before: int = 0) -> None:
        self._n_before = n_before
        #: of each recording, at which step of all environments together it began
        self.starts: list[int] = []
        #: steps of each environment that had gone through the buffer when it was last looked at,
        #: and where it stood
        self._n_steps, self._position = 0, 0

    def look_at(self, buffer: Any) -> None:
        """To be called at least once while the buffer is filled."""
        self._n_steps, self._position = self.n_steps(buffer), buffer.pos

    def n_steps(self, buffer: Any) -> int:
        """:return: steps of each environment that went through the buffer, those lost included"""
        since = (buffer.pos - self._position) % buffer.buffer_size
        return max(self._n_steps + since, buffer.size())

    @property
    def latest(self) -> int:
        """The number that was given last."""
        return max(0, self._n_before + len(self.starts) - 1)

    def numbers(self, buffer: Any, begins: Sequence[tuple[int, int]]) -> list[int]:
        """
        :param begins: of each recording, steps since the oldest one in the buffer, and environment
        :return: its number; -1 for the rest of one whose beginning is lost
        """
        self.look_at(buffer)
        first = self._n_steps - buffer.size()
        starts = [(first + row) * buffer.n_envs + env for row, env in begins]
        # In each environment the first one that is left may have begun earlier.
        oldest = {env: min(row for row, e in begins if e == env) for _, env in begins}
        cut = [first > 0 and row == oldest[env] for row, env in begins]
        known = set(self.starts)
        whole = {s for s, rest in zip(starts, cut, strict=True) if not rest and s not in known}
        self.starts += sorted(whole)
        number = {start: self._n_before + i for i, start in enumerate(self.starts)}
        return [number.get(start, -1) for start in starts]

    def state_dict(self, buffer: Any, n_kept: int) -> dict[str, th.Tensor]:
        """:param n_kept: steps of each environment that are saved, the latest"""
        lost = self.n_steps(buffer) - n_kept
        numbers = {"starts": self.starts, "lost": lost, "before": self._n_before}
        return {name: th.as_tensor(value, dtype=th.int64) for name, value in numbers.items()}

    def load_state_dict(self, saved: dict[str, th.Tensor], buffer: Any, n_saved: int) -> None:
        """
        :param buffer: filled with what was saved, or the latest of it
        :param n_saved: steps of each environment that were saved
        """
        self.starts, self._n_before = saved["starts"].tolist(), int(saved["before"])
        self._n_steps, self._position = int(saved["lost"]) + n_saved, buffer.pos
