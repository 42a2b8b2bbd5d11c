"""
What a trial of ``rl_zoo3 train -optimize`` has to get by with.

The zoo tells samplers and algorithms nothing of ``-n``: without it, a trial may spend all of its
steps on random actions, and reserve memory for a million transitions.
"""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, NamedTuple

# A quarter of the steps may pass before learning starts.
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
    """:return: of the trial that runs in this thread; None: none does"""
    return _NOW.get()


@contextmanager
def running(trial: int, n_timesteps: int) -> Iterator[None]:
    """
    :param trial: its number
    :param n_timesteps: that it has
    """
    token = _NOW.set(Budget(trial, n_timesteps))
    try:
        yield
    finally:
        _NOW.reset(token)


def learning_starts_range() -> tuple[int, int]:
    """:return: the least and the most that a trial is worth trying with"""
    now = budget()
    if now is None:
        return 100, 10_000
    most = max(1, min(10_000, now.n_timesteps // _STARTS))
    return min(100, max(1, most // 2)), most


def capped(hyperparams: dict[str, Any], defaults: Mapping[str, Any]) -> dict[str, Any]:
    """
    :param hyperparams: from a file, from ``-params``, and sampled
    :param defaults: of the algorithm
    :return: with no more than the trial has steps for; without a trial, as they were
    """
    now = budget()
    if now is None:
        return hyperparams
    most = {"buffer_size": now.n_timesteps, "learning_starts": now.n_timesteps // _STARTS}
    too_many = {
        name: limit
        for name, limit in most.items()
        if name in defaults and hyperparams.get(name, defaults[name]) > limit
    }
    return hyperparams | too_many
