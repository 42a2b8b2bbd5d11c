"""Planning epochs before the first real step, and what callbacks and loggers make of them."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
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

# Log lines written during pretraining.
_N_LOGS = 10
# Between two calls of callbacks while programs compile. [s]
_PATIENCE = 0.5


class Pretraining(CallbackList):
    """
    Runs the planning epochs that are due when training starts, so that everything SB3 sets up for
    ``learn`` (logger, other callbacks, environment) is there. Interrupted, it leaves a model that
    goes on where it stopped.

    The other callbacks are called after each epoch, and twice a second while programs compile, but
    for those of SB3 that act every n-th call, as if a step of the environment had been made:
    ``num_timesteps`` stays, ``locals["pretraining"]`` is True, there are no rewards, and no episode
    ended. What they count as calls meanwhile is forgotten before the first real step, so that
    ``eval_freq`` and ``save_freq`` go on counting steps alone.

    :param callbacks: the others
    :param progress_bar: whether to show one
    """

    def __init__(self, callbacks: list[BaseCallback], progress_bar: bool) -> None:
        super().__init__(callbacks)
        self.progress_bar = progress_bar

    def _on_training_start(self) -> None:
        super()._on_training_start()
        model: Any = self.model
        self.update_locals(_no_step(model))
        model.poll = self._poll
        try:
            with _own_series(model), _counts_restored(self.callbacks):
                self._run(model)
        except _StoppedError:
            model.stopped = True
        finally:
            model.poll = nothing
            self.update_locals({"pretraining": False})

    def _run(self, model: Any) -> None:
        model.before_planning()
        due = model.pretraining_due
        every = max(1, due // _N_LOGS)
        bars = [each for each in _each(self.callbacks) if isinstance(each, ProgressBarCallback)]
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
        """While programs compile: there is no epoch yet that anybody could count."""
        with _counts_restored(self.callbacks):
            _call(self.callbacks, ProgressBarCallback, EventCallback, CheckpointCallback)

    def _on_step(self) -> bool:
        """SB3 stores a step after the callbacks have seen it, checkpoints among them."""
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
    Logs what comes before the first real step under names of its own, ``pretrain/...``, with the
    number of planning epochs as the step: on the axis of timesteps, all of it would be at 0.

    :param logger: that writes it
    :param n_epochs: so far
    """

    def __init__(self, logger: Logger, n_epochs: Callable[[], int]) -> None:
        super().__init__(logger.dir, logger.output_formats)
        self.level = logger.level
        self._logger, self._n_epochs = logger, n_epochs

    def dump(self, step: int = 0) -> None:
        """
        :param step: ignored
        """
        for name, value in self.name_to_value.items():
            own = f"pretrain/{name.removeprefix('train/')}"
            self._logger.record(own, value, exclude=self.name_to_excluded[name])
        self._logger.dump(self._n_epochs())
        for kept in (self.name_to_value, self.name_to_count, self.name_to_excluded):
            kept.clear()


def nothing() -> None:
    """Does nothing: there is no callback to call while programs compile."""


def beside(work: Callable[[], Any]) -> Future[Any]:
    """
    :param work: changes nothing
    :return: what it will return; it is done in a thread of its own, which Python waits for before
        it exits
    """
    pool = ThreadPoolExecutor(1)
    try:
        return pool.submit(work)
    finally:
        pool.shutdown(wait=False)


def meanwhile(works: Sequence[Callable[[], Any]], poll: Callable[[], None]) -> list[Any]:
    """
    Work in other threads, so that this one can be interrupted.

    An interrupt ends the waiting only: the work goes on, its result is lost, and Python waits for
    it before it exits.

    :param works: change nothing
    :param poll: is called now and then; what it raises ends the waiting
    :return: what they returned
    """
    pool = ThreadPoolExecutor(len(works))
    try:
        futures = [pool.submit(work) for work in works]
        while wait(futures, _PATIENCE).not_done:
            poll()
        return [future.result() for future in futures]
    finally:
        pool.shutdown(wait=False, cancel_futures=True)


def _no_step(model: Any) -> dict[str, Any]:
    """:return: what callbacks find in ``locals`` after a step, of one that was not made"""
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


def _each(callbacks: Iterable[BaseCallback]) -> Iterator[BaseCallback]:
    """:return: those in lists, too"""
    for callback in callbacks:
        if type(callback) is CallbackList:
            yield from _each(callback.callbacks)
        else:
            yield callback


def _call(callbacks: Iterable[BaseCallback], *but: type[BaseCallback]) -> None:
    """
    :param but: those that act every n-th step of the environment, or count steps
    :raises _StoppedError: if one of them wants training to stop
    """
    called = [each for each in _each(callbacks) if not isinstance(each, but)]
    # All of them, as in SB3, also where the first one says no.
    if not all([callback.on_step() for callback in called]):
        raise _StoppedError


@contextmanager
def _counts_restored(callbacks: Iterable[BaseCallback]) -> Iterator[None]:
    before = [(callback, callback.n_calls) for callback in _each(callbacks)]
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
