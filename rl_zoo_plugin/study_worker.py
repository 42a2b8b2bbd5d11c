"""
One run of a study: the zoo's ``train``, with a clock and checkpoints.

    python -m rl_zoo_plugin.study_worker CLOCK.csv MINUTES CHECKPOINT EVERY --algo hds --env ...

The process exits when its standard input closes, so that no run outlives the study that started it.
If there is a checkpoint, the run is resumed from it.
"""

import os
import shutil
import sys
import threading
from pathlib import Path
from typing import Any

from rl_zoo_plugin import hook


def main() -> None:
    """Train with the arguments of the command line."""
    clock, minutes = Path(sys.argv[1]), float(sys.argv[2]) or None
    folder, every = Path(sys.argv[3]), float(sys.argv[4])
    del sys.argv[1:5]
    threading.Thread(target=_exit_with_input, daemon=True).start()
    hook.install()
    from rl_zoo3.exp_manager import ExperimentManager
    from rl_zoo3.train import train

    from rl_zoo_plugin.callbacks import (
        Checkpoints,
        Clock,
        ResumedModel,
        last_checkpoint,
        restore_logs,
    )

    before = last_checkpoint(folder)
    if before is not None:
        sys.argv += ["-i", str(before)]
        if (folder / clock.name).exists():
            shutil.copy(folder / clock.name, clock)
    create: Any = ExperimentManager.create_callbacks
    learn: Any = ExperimentManager.learn

    def with_clock(self: Any) -> None:
        create(self)
        if before is not None:
            restore_logs(self, folder)
        watch, logs = Clock(clock, minutes), Path(self.save_path)
        self.callbacks.append(watch)
        if every:
            self.callbacks.append(Checkpoints(folder, every, logs, str(self.env_name), watch))

    def resume_learning(self: Any, model: Any) -> None:
        learn(self, model if before is None else ResumedModel(model))

    ExperimentManager.create_callbacks = with_clock
    ExperimentManager.learn = resume_learning
    train()


def _exit_with_input() -> None:
    # A thread that waits in sys.stdin would hold its lock while the interpreter shuts down.
    while os.read(0, 4096):
        pass
    os._exit(1)


if __name__ == "__main__":
    main()
