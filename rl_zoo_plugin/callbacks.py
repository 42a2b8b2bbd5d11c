"""Callbacks: progress of a trial; clock and checkpoints of a run, from which it is resumed."""

import shutil
import time
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from rl_zoo_plugin.trials import budget

_MODEL, _BUFFER, _BEST = "model.zip", "replay_buffer.pkl", "best_model.zip"
# Between two lines of the clock, and of the progress of a trial [s].
_CLOCK_INTERVAL, _PROGRESS_INTERVAL = 1.0, 10.0
_EVALUATIONS, _STATISTICS = "evaluations.npz", "vecnormalize.pkl"


class TrialProgress(BaseCallback):
    """Prints the progress of a trial of ``rl_zoo3 train -optimize`` every ten seconds."""

    def __init__(self) -> None:
        super().__init__()
        now = budget()
        self.name = "Trial" if now is None else f"Trial {now.trial}"
        self._begin = self._printed = 0.0

    def _on_training_start(self) -> None:
        self._begin = time.monotonic()
        self._print(f"0 of {self.locals['total_timesteps']} steps")

    def _on_step(self) -> bool:
        if time.monotonic() - self._printed > _PROGRESS_INTERVAL:
            planning = self.locals.get("pretraining", False)
            steps = f"{self.num_timesteps} of {self.locals['total_timesteps']} steps"
            self._print("planning before the first step" if planning else steps)
        return True

    def _print(self, what: str) -> None:
        self._printed = time.monotonic()
        print(f"{self.name}: {what} after {self._printed - self._begin:.0f} s", flush=True)


class Clock(BaseCallback):
    """
    Writes the steps made so far against time, and ends the training when its time is up.

    :param path: of the table to write or continue: ``timesteps``, ``seconds`` since the training
        began
    :param minutes: limit of the training, evaluations included; None: no limit
    """

    def __init__(self, path: Path, minutes: float | None) -> None:
        super().__init__()
        self.path, self.limit = path, None if minutes is None else 60.0 * minutes

    def _on_training_start(self) -> None:
        self._begin = self._written = time.monotonic()
        if not self.path.exists():
            self.path.write_text("timesteps,seconds\n0,0.0\n")
            return
        self._begin -= float(self.path.read_text().split()[-1].partition(",")[2])

    def _on_step(self) -> bool:
        now = time.monotonic()
        if now - self._written >= _CLOCK_INTERVAL:
            self.write()
        return self.limit is None or now - self._begin < self.limit

    def _on_training_end(self) -> None:
        self.write()

    def write(self) -> None:
        self._written = time.monotonic()
        with self.path.open("a") as file:
            file.write(f"{self.num_timesteps},{self._written - self._begin:.3f}\n")


class Checkpoints(BaseCallback):
    """
    Saves the model, its replay buffer and the logs so far, atomically.

    :param folder: of the latest checkpoint
    :param minutes: between checkpoints
    :param logs: the zoo's folder of this run: evaluations, best model, episodes
    :param env_name: of the environment, in names of files
    :param clock: writes the table of steps and seconds
    """

    def __init__(
        self, folder: Path, minutes: float, logs: Path, env_name: str, clock: Clock
    ) -> None:
        super().__init__()
        self.folder, self.every, self.logs, self.clock = folder, 60.0 * minutes, logs, clock
        self.env_name = env_name

    def _on_training_start(self) -> None:
        self._written = time.monotonic()

    def _on_step(self) -> bool:
        if time.monotonic() - self._written >= self.every:
            self.write()
            self._written = time.monotonic()
        return True

    def write(self) -> None:
        new = self.folder.with_name(f"{self.folder.name}.new")
        shutil.rmtree(new, ignore_errors=True)
        (new / self.env_name).mkdir(parents=True)
        self.model.save(new / _MODEL)
        if isinstance(self.model, OffPolicyAlgorithm) and self.model.replay_buffer is not None:
            self.model.save_replay_buffer(new / _BUFFER)
        if (normalizer := self.model.get_vec_normalize_env()) is not None:
            normalizer.save(str(new / self.env_name / _STATISTICS))
        logs = [self.logs / name for name in (_EVALUATIONS, _BEST)]
        self.clock.write()
        logs += [self.clock.path, *self.logs.glob(f"*{Monitor.EXT}")]
        for file in logs:
            if file.exists():
                shutil.copy(file, new / file.name)
        old = self.folder.with_name(f"{self.folder.name}.old")
        shutil.rmtree(old, ignore_errors=True)
        if self.folder.exists():
            self.folder.rename(old)
        new.rename(self.folder)
        shutil.rmtree(old, ignore_errors=True)


def last_checkpoint(folder: Path) -> Path | None:
    """:return: the model of the last checkpoint; None where there is none"""
    old = folder.with_name(f"{folder.name}.old")
    # The process was stopped between the two renames of a checkpoint.
    if not folder.exists() and old.exists():
        old.rename(folder)
    return folder / _MODEL if (folder / _MODEL).exists() else None


def restore_logs(manager: Any, folder: Path) -> None:
    """
    Continue the evaluations and logs of a run from its checkpoint.

    :param manager: the zoo's ``ExperimentManager``, with its callbacks
    """
    logs = Path(manager.save_path)
    for file in folder.glob(f"*{Monitor.EXT}"):
        # The original name is taken by the file that the environment is writing.
        shutil.copy(file, logs / f"before_{file.name}")
    for name in (_BEST, _EVALUATIONS):
        if (folder / name).exists():
            shutil.copy(folder / name, logs / name)
    if not (folder / _EVALUATIONS).exists():
        return
    with np.load(folder / _EVALUATIONS, allow_pickle=False) as before:
        steps, returns, lengths = (before[k] for k in ("timesteps", "results", "ep_lengths"))
    for callback in manager.callbacks:
        if isinstance(callback, EvalCallback):
            callback.evaluations_timesteps = steps.tolist()
            callback.evaluations_results = [list(row) for row in returns]
            callback.evaluations_length = [list(row) for row in lengths]
            callback.best_mean_reward = float(returns.mean(1).max())


class ResumedModel:
    """
    Stands in for a loaded model in the zoo, and trains it for the remaining steps only.

    :param model: from a checkpoint
    """

    def __init__(self, model: Any) -> None:
        self.model, self.env = model, model.env

    def learn(self, total_timesteps: int, **given: Any) -> Any:
        """:param total_timesteps: of the run from its beginning"""
        done = self.model.num_timesteps
        for callback in given.get("callback", ()):
            callback.n_calls = done // self.model.n_envs
        remaining = max(total_timesteps - done, 0)
        if not remaining:
            return self.model
        return self.model.learn(remaining, reset_num_timesteps=False, **given)
