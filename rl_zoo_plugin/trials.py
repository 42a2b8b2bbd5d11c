"""
The budget of a trial of ``rl_zoo3 train -optimize``.

The zoo does not pass ``-n`` on to samplers and algorithms. Without it, a trial may spend all of its
steps on random actions, and reserve memory for a million transitions.
"""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, NamedTuple

# At most a quarter of the steps may pass before learning starts.
_STARTS = 4


class Budget(NamedTuple):
    """
    :param trial: its number
    :param n_timesteps: of the trial
    """

    trial: int
    n_timesteps: int


_NOW: ContextVar[Budget | None] = ContextVar("budget", default=None)


def budget() -> Budget | None:
    """:return: of the trial that runs in this thread; None: there is none"""
    return _NOW.get()


@contextmanager
def running(trial: int, n_timesteps: int) -> Iterator[None]:
    """
    :param trial: its number
    :param n_timesteps: of the trial
    """
    token = _NOW.set(Budget(trial, n_timesteps))
    try:
        yield
    finally:
        _NOW.reset(token)


def learning_starts_range() -> tuple[int, int]:
    """:return: the smallest and the largest value to sample"""
    now = budget()
    if now is None:
        return 100, 10_000
    largest = max(1, min(10_000, now.n_timesteps // _STARTS))
    return min(100, max(1, largest // 2)), largest


def capped(hyperparams: dict[str, Any], defaults: Mapping[str, Any]) -> dict[str, Any]:
    """
    :param hyperparams: from a file, from ``-params``, and sampled
    :param defaults: of the algorithm
    :return: limited to the steps of the trial; unchanged outside a trial
    """
    now = budget()
    if now is None:
        return hyperparams
    limits = {"buffer_size": now.n_timesteps, "learning_starts": now.n_timesteps // _STARTS}
    reduced = {
        name: limit
        for name, limit in limits.items()
        if name in defaults and hyperparams.get(name, defaults[name]) > limit
    }
    return hyperparams | reduced
