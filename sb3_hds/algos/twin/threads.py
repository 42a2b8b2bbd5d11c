"""Functions in other threads, while this one waits, polls or computes."""

from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import Any

# Time between two calls of ``poll`` while functions run [s].
_PATIENCE = 0.5


def no_poll() -> None:
    """Do nothing: the value of ``poll`` outside the pretraining."""


def run_in_thread(work: Callable[[], Any]) -> Future[Any]:
    """
    :param work: a function without side effects
    :return: its future result; it runs in another thread, for which Python waits before it exits
    """
    pool = ThreadPoolExecutor(1)
    try:
        return pool.submit(work)
    finally:
        pool.shutdown(wait=False)


def run_in_threads(works: Sequence[Callable[[], Any]], poll: Callable[[], None]) -> list[Any]:
    """
    Run functions in other threads, so that this one can be interrupted.

    An interrupt ends the waiting only: the functions continue, their results are lost, and Python
    waits for them before it exits.

    :param works: functions without side effects
    :param poll: is called twice a second; an error that it raises ends the waiting
    :return: the results of the functions
    """
    pool = ThreadPoolExecutor(len(works))
    try:
        futures = [pool.submit(work) for work in works]
        while wait(futures, _PATIENCE).not_done:
            poll()
        return [future.result() for future in futures]
    finally:
        pool.shutdown(wait=False, cancel_futures=True)


def run_in_parallel(works: Sequence[Callable[[], Any]]) -> list[Any]:
    """
    :param works: functions without side effects; the first one runs in this thread
    :return: their results
    """
    first, *others = works
    if not others:
        return [first()]
    with ThreadPoolExecutor(len(others)) as pool:
        beside = [pool.submit(other) for other in others]
        return [first(), *(each.result() for each in beside)]
