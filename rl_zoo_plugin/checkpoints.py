"""A run's clock, and its checkpoints: what it goes on from when it is run again."""

import shutil
import time
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

_MODEL, _BUFFER, _BEST = "model.zip", "replay_buffer.pkl", "best_model.zip"
# Between two lines of the clock [s].
_EVERY = 1.0
_EVALUATIONS, _STATISTICS = "evaluations.npz", "vecnormalize.pkl"


class Clock(BaseCallback):
    """
    Writes how many steps were made by when, and ends the training when its time is up.

    :param path: of a table to write, or to go on with: ``timesteps``, ``seconds`` since the
        training began
    :param minutes: that a training may take, evaluations included; None: any
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
        if now - self._written >= _EVERY:
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
    Writes the model, its replay buffer and the logs so far, all or nothing.

    :param folder: one checkpoint, the last
    :param minutes: from one to the next
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
    # It was stopped between two renames.
    if not folder.exists() and old.exists():
        old.rename(folder)
    return folder / _MODEL if (folder / _MODEL).exists() else None


def go_on(manager: Any, folder: Path) -> None:
    """
    Let evaluations and logs of a run go on where its checkpoint ends.

    :param manager: the zoo's ``ExperimentManager``, with its callbacks
    """
    logs = Path(manager.save_path)
    for file in folder.glob(f"*{Monitor.EXT}"):
        # Not the name of the file that the environment is writing.
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


class Continued:
    """
    What the zoo trains instead of a model that was loaded: the steps that are left.

    :param model: from a checkpoint
    """

    def __init__(self, model: Any) -> None:
        self.model, self.env = model, model.env

    def learn(self, total_timesteps: int, **given: Any) -> Any:
        """:param total_timesteps: of the whole run"""
        done = self.model.num_timesteps
        for callback in given.get("callback", ()):
            callback.n_calls = done // self.model.n_envs
        left = max(total_timesteps - done, 0)
        return self.model.learn(left, reset_num_timesteps=False, **given) if left else self.model
