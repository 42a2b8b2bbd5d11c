"""
One run of a study: the zoo's ``train``, with a clock.

    python -m rl_zoo_plugin.study_worker CLOCK.csv MINUTES --algo hds --env Pendulum-v1 ...

It ends when its standard input does, so that no run outlives the study that started it.
"""

import os
import sys
import threading
import time
from pathlib import Path
from typing import Any

from stable_baselines3.common.callbacks import BaseCallback

from rl_zoo_plugin import hook

# Between two lines of the clock [s].
_EVERY = 1.0


class Clock(BaseCallback):
    """
    Writes how many steps were made by when, and ends the training when its time is up.

    :param path: of a table to write: ``timesteps``, ``seconds`` since the training began
    :param minutes: that a training may take, evaluations included; None: any
    """

    def __init__(self, path: Path, minutes: float | None) -> None:
        super().__init__()
        self.path, self.limit = path, None if minutes is None else 60.0 * minutes

    def _on_training_start(self) -> None:
        self._begin = self._written = time.monotonic()
        self.path.write_text("timesteps,seconds\n0,0.0\n")

    def _on_step(self) -> bool:
        now = time.monotonic()
        if now - self._written >= _EVERY:
            self._write(now)
        return self.limit is None or now - self._begin < self.limit

    def _on_training_end(self) -> None:
        self._write(time.monotonic())

    def _write(self, now: float) -> None:
        self._written = now
        with self.path.open("a") as file:
            file.write(f"{self.num_timesteps},{now - self._begin:.3f}\n")


def main() -> None:
    """Train as the arguments say."""
    path, minutes = Path(sys.argv[1]), float(sys.argv[2]) or None
    del sys.argv[1:3]
    threading.Thread(target=_end_with_input, daemon=True).start()
    hook.install()
    from rl_zoo3.exp_manager import ExperimentManager
    from rl_zoo3.train import train

    create: Any = ExperimentManager.create_callbacks

    def with_clock(self: Any) -> None:
        create(self)
        self.callbacks.append(Clock(path, minutes))

    ExperimentManager.create_callbacks = with_clock
    train()


def _end_with_input() -> None:
    # Not by sys.stdin, whose lock a thread that waits would hold while the interpreter ends.
    while os.read(0, 4096):
        pass
    os._exit(1)


if __name__ == "__main__":
    main()
