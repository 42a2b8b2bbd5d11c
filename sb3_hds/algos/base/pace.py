"""How long a learner's updates take beside the steps that they are made for."""

import time
import warnings
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sb3_hds.algos.base.algorithm import TensorAlgorithm

# Steps per second below which a learner says what would make it faster.
_SLOW = 5.0
# Of the first calls of ``train``, which compile, nothing is seen; then, so many updates are enough,
# or so much time. [s]
_COMPILING, _UPDATES, _SECONDS = 2, 100, 10.0


class Pace:
    """
    Looks at a learner's first hundred updates, once their programs are compiled. The environment,
    and callbacks, may be as slow as they like.
    """

    def __init__(self) -> None:
        self._calls, self._seconds, self._steps, self._updates = 0, 0.0, 0, 0
        self._done = False
        self.pause()

    def pause(self) -> None:
        """What comes next are no updates."""
        self._since: float | None = None

    def collected(self, model: "TensorAlgorithm", n_steps: int) -> None:
        """
        Updates may begin.

        :param n_steps: of the environment, for which they are
        """
        if not self._done:
            self._since = time.perf_counter()
            self._new_steps, self._updates_before = n_steps, model._n_updates

    def updated(self, model: "TensorAlgorithm") -> None:
        """Updates, if there were some, have been made."""
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
                f"{type(model).__name__} makes {rate:.2g} steps/s, since the updates for each of "
                f"them take {1.0 / rate:.2g} s. What would make it faster: {'; '.join(remedies)}."
            )
