"""A warning of updates that are slow, with settings that make them faster."""

import time
import warnings
from typing import Protocol

# Steps per second below which a learner warns and suggests faster settings.
_SLOW = 5.0
# Calls of ``train`` that compile and are not timed; then the number of updates to time, or the time
# after which fewer are enough [s].
_COMPILING, _UPDATES, _SECONDS = 2, 100, 10.0


class Learner(Protocol):
    """What is timed."""

    _n_updates: int

    def remedies(self, updates_per_step: float) -> list[str]:
        """:return: arguments that would make it faster"""
        ...


class Pace:
    """
    Times a learner's first hundred updates after compilation and warns if they are slow. Time spent
    in the environment and in callbacks does not count.
    """

    def __init__(self) -> None:
        self._calls, self._seconds, self._steps, self._updates = 0, 0.0, 0, 0
        self._done = False
        self.pause()

    def pause(self) -> None:
        """Stop timing until the next collection of steps ends."""
        self._since: float | None = None

    def collected(self, model: Learner, n_steps: int) -> None:
        """Start timing: ``n_steps`` steps were collected, and their updates follow."""
        if not self._done:
            self._since = time.perf_counter()
            self._new_steps, self._updates_before = n_steps, model._n_updates

    def updated(self, model: Learner) -> None:
        """Count the updates since :meth:`collected`, if there were any."""
        if self._since is None or model._n_updates == self._updates_before:
            return
        seconds, self._since = time.perf_counter() - self._since, None
        self._calls += 1
        if self._calls <= _COMPILING:
            return
        self._seconds += seconds
        self._steps += self._new_steps
        self._updates += model._n_updates - self._updates_before
        if self._updates < _UPDATES and self._seconds < _SECONDS:
            return
        self._done = True
        rate = self._steps / max(self._seconds, 1e-9)
        if rate < _SLOW:
            remedies = model.remedies(self._updates / max(self._steps, 1))
            warnings.warn(
                f"{type(model).__name__} makes {rate:.2g} steps/s, since the updates for each step "
                f"take {1.0 / rate:.2g} s. What would make it faster: {'; '.join(remedies)}."
            )
