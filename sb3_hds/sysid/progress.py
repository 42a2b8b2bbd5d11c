"""How far a diagnosis is: one bar over all of its stages, with an estimate of the time left."""

from collections.abc import Iterable, Iterator
from typing import TypeVar

from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

# Stages in their order, and their usual shares of the time.
STAGES = {
    "reading the log": 3,
    "trying conventions": 5,
    "equation of motion": 20,
    "settling the noise": 17,
    "comparing causes": 30,
    "confirming causes": 10,
    "what is left": 8,
    "sizes and intervals": 7,
}
# Of what is left of a stage, the share that one more round of work takes.
_ROUND = 0.5

_Done = TypeVar("_Done")


class Bar:
    """
    A stage may take several rounds, of which nobody knows the number: each fills half of what the
    ones before have left of it.

    :param shown: whether there is a bar at all
    """

    def __init__(self, shown: bool) -> None:
        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
        )
        self._bar = Progress(*columns, transient=True, disable=not shown)
        self._task = self._bar.add_task(next(iter(STAGES)), total=sum(STAGES.values()))
        self._done = self._end = 0.0

    def __enter__(self) -> "Bar":
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def stage(self, name: str) -> None:
        """:param name: a key of ``STAGES``; what comes before it is done"""
        names = list(STAGES)
        begin = float(sum(STAGES[n] for n in names[: names.index(name)]))
        self._done, self._end = max(self._done, begin), begin + STAGES[name]
        self._bar.update(self._task, completed=self._done, description=name)

    def over(self, done: Iterable[_Done], n: int) -> Iterator[_Done]:
        """:param n: pieces of work in this round"""
        share = _ROUND * max(self._end - self._done, 0.0) / max(n, 1)
        for one in done:
            yield one
            self._done += share
            self._bar.update(self._task, completed=self._done)
