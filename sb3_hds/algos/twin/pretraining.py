"""Planning epochs before the first real step, and how callbacks and loggers see them."""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CallbackList,
    CheckpointCallback,
    EventCallback,
    ProgressBarCallback,
)
from stable_baselines3.common.logger import Logger

from sb3_hds.algos.twin.threads import no_poll

# Number of log lines during the pretraining.
_N_LOGS = 10


class PretrainingCallback(CallbackList):
    """
    Run the planning epochs that are due when training starts, after SB3 has set up everything for
    ``learn`` (logger, other callbacks, environment). An interrupted model continues where it
    stopped.

    The other callbacks are called after each epoch as if after a step of the environment, with an
    unchanged ``num_timesteps``, ``locals["pretraining"]`` True, no rewards and no ended episodes;
    also twice a second while programs compile, except those of SB3 that act every n-th call. Their
    counts of calls are restored before the first real step, so that ``eval_freq`` and ``save_freq``
    count steps only.

    :param callbacks: the other callbacks
    :param progress_bar: whether to show a progress bar
    """

    def __init__(self, callbacks: list[BaseCallback], progress_bar: bool) -> None:
        super().__init__(callbacks)
        self.progress_bar = progress_bar

    def _on_training_start(self) -> None:
        super()._on_training_start()
        model: Any = self.model
        self.update_locals(_step_placeholder(model))
        model.poll = self._poll
        try:
            with _own_series(model), _counts_restored(self.callbacks):
                self._run(model)
        except _StoppedError:
            model.stopped = True
        finally:
            model.poll = no_poll
            self.update_locals({"pretraining": False})

    def _run(self, model: Any) -> None:
        model.before_planning()
        due = model.pretraining_due
        every = max(1, due // _N_LOGS)
        bars = [
            each for each in _flattened(self.callbacks) if isinstance(each, ProgressBarCallback)
        ]
        for i in self._shown(range(1, due + 1)):
            model.pretrain_epoch()
            for bar in bars:
                bar.pbar.set_description(f"planning {i}/{due}")
            done = not model.pretraining_due
            if done or i % every == 0:
                model.logger.dump(step=model.num_timesteps)
            _call(self.callbacks, ProgressBarCallback)
            if done:
                break
        for bar in bars:
            bar.pbar.set_description("")

    def _poll(self) -> None:
        """Call callbacks while programs compile; calls are not counted, as there was no epoch."""
        with _counts_restored(self.callbacks):
            _call(self.callbacks, ProgressBarCallback, EventCallback, CheckpointCallback)

    def _on_step(self) -> bool:
        """Keep the step for callbacks that save the model: SB3 stores it after callbacks."""
        model: Any = self.model
        names = ("buffer_actions", "new_obs", "rewards", "dones", "infos")
        model.unstored_step = {name: self.locals[name] for name in names}
        return super()._on_step()

    def _shown(self, epochs: range) -> Iterable[int]:
        if not (self.progress_bar and epochs):
            return epochs
        from rich.progress import track

        return track(epochs, description="planning in the twin")


class _StoppedError(Exception):
    """A callback has returned False."""


class OwnSeries(Logger):
    """
    Log the pretraining under separate names, ``pretrain/...``, over the number of planning epochs:
    its timesteps are all 0.

    :param logger: that writes the lines
    :param n_epochs: returns the number of epochs so far
    """

    def __init__(self, logger: Logger, n_epochs: Callable[[], int]) -> None:
        super().__init__(logger.dir, logger.output_formats)
        self.level = logger.level
        self._logger, self._n_epochs = logger, n_epochs

    def dump(self, step: int = 0) -> None:
        """:param step: ignored"""
        for name, value in self.name_to_value.items():
            own = f"pretrain/{name.removeprefix('train/')}"
            self._logger.record(own, value, exclude=self.name_to_excluded[name])
        self._logger.dump(self._n_epochs())
        for kept in (self.name_to_value, self.name_to_count, self.name_to_excluded):
            kept.clear()


def _step_placeholder(model: Any) -> dict[str, Any]:
    """:return: ``locals`` for callbacks in place of those of a step"""
    space: Any = model.action_space
    n_envs = model.n_envs
    no_action = np.zeros((n_envs, *space.shape), space.dtype)
    return {
        "pretraining": True,
        "env": model.env,
        "replay_buffer": model.replay_buffer,
        "train_freq": model.train_freq,
        "action_noise": model.action_noise,
        "learning_starts": model.learning_starts,
        "continue_training": True,
        "num_collected_steps": 0,
        "num_collected_episodes": 0,
        "actions": no_action,
        "buffer_actions": no_action.copy(),
        "new_obs": model._last_obs,
        "rewards": np.zeros(n_envs, np.float32),
        "dones": np.zeros(n_envs, bool),
        "infos": [{} for _ in range(n_envs)],
    }


def _flattened(callbacks: Iterable[BaseCallback]) -> Iterator[BaseCallback]:
    """:return: all callbacks, also those in nested lists"""
    for callback in callbacks:
        if type(callback) is CallbackList:
            yield from _flattened(callback.callbacks)
        else:
            yield callback


def _call(callbacks: Iterable[BaseCallback], *but: type[BaseCallback]) -> None:
    """
    :param but: classes of callbacks that are not called
    :raises _StoppedError: if a callback ends the training
    """
    called = [each for each in _flattened(callbacks) if not isinstance(each, but)]
    # Call all of them, as in SB3, also after one has returned False.
    if not all([callback.on_step() for callback in called]):
        raise _StoppedError


@contextmanager
def _counts_restored(callbacks: Iterable[BaseCallback]) -> Iterator[None]:
    before = [(callback, callback.n_calls) for callback in _flattened(callbacks)]
    try:
        yield
    finally:
        for callback, n_calls in before:
            callback.n_calls = n_calls


@contextmanager
def _own_series(model: Any) -> Iterator[None]:
    usual = model.logger
    own = OwnSeries(usual, lambda: int(model.policy.progress.n_epochs))
    model._logger = own
    try:
        yield
    finally:
        model._logger = usual
        if own.name_to_value:
            own.dump()
