"""The result of an experiment design, which prints itself and writes its commands."""

import dataclasses
import io
import math
import os
import textwrap
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from sb3_hds.core import Trajectories
from sb3_hds.core.trajectories.storage import check_target, write_bytes
from sb3_hds.errors import ParameterError

_WIDTH = 80
# Probability with which answers count as decided.
SURE = 0.9


class Pair(NamedTuple):
    """
    How well the recordings discriminate between two answers.

    :param true: the answer that is right
    :param other: the answer to rule out
    :param ratio: expected logarithm of the likelihood ratio
    :param chance: probability of odds beyond 19 to 1 for the right one
    :param needed: number of such recordings for a probability of 90 %
    """

    true: str
    other: str
    ratio: float
    chance: float
    needed: float


@dataclasses.dataclass(frozen=True, repr=False)
class NextExperiment:
    """
    What to record next, from ``Diagnosis.next_experiment``. Prints itself.

    :param commands: one trajectory for each recording: its actions are the commands, its
        observations what the likeliest answer predicts
    :param answers: names of the answers, the likeliest first
    :param predicted: channels as each answer predicts them, shape ``(m, n, steps + 1, n_obs)``
    :param channels: name and unit of each
    :param actuators: name and unit of each
    :param pairs: of answers, the hardest to discriminate first; none if there is one answer
    :param information: gained about the parameters of the likeliest answer [nats]
    :param narrower: by its parameters, their standard deviation now and after the recordings
    :param usage: by limit and joint, the largest share that any answer uses
    :param decides: whether a feasible number of such recordings would decide
    :param would_tell: what would decide if they do not, in words
    """

    commands: Trajectories
    answers: tuple[str, ...]
    predicted: Float[np.ndarray, "m n rows obs"]
    channels: tuple[tuple[str, str], ...]
    actuators: tuple[tuple[str, str], ...]
    pairs: tuple[Pair, ...]
    information: float
    narrower: Mapping[str, tuple[float, float]]
    usage: Mapping[str, float]
    decides: bool
    would_tell: tuple[str, ...] = ()

    @property
    def chance(self) -> float:
        """Probability that the recordings decide between the hardest pair of answers."""
        return self.pairs[0].chance if self.pairs else math.nan

    @property
    def needed(self) -> float:
        """Number of recordings that decide between this pair with a probability of 90 %."""
        return self.pairs[0].needed if self.pairs else math.nan

    @property
    def sentence(self) -> str:
        """What to do, in one sentence."""
        n, seconds = len(self.commands), self.commands.n_steps / len(self.commands)
        what = "this recording" if n == 1 else f"these {n} recordings"
        what += f" of {seconds * self.commands.dt:.3g} s"
        if not self.pairs:
            return f"Play {what}: it is worth {self.information:.1f} nats about the parameters."
        worst = self.pairs[0]
        if not self.decides:
            every = {frozenset(p[:2]) for p in self.pairs}
            sure = every - {frozenset(p[:2]) for p in self.pairs if p.chance < SURE}
            some = f" Of {len(every)} pairs of answers, it tells {len(sure)} apart." if sure else ""
            return (
                f"No recording within these limits tells {worst.true} from {worst.other}: the best "
                f"that was found would have to be made {_number(worst.needed)} times.{some}"
            )
        if worst.chance >= SURE:
            return f"Play {what}: the answers are told apart with a chance of {worst.chance:.0%}."
        return (
            f"Play {what}, {math.ceil(worst.needed)} times in all: one of them tells "
            f"{worst.true} from {worst.other} with a chance of {worst.chance:.0%}."
        )

    def summary(self) -> str:
        """:return: all of it in 80 columns"""
        lines = [*textwrap.wrap(self.sentence, _WIDTH), "=" * _WIDTH]
        lines += [f"Answers that the data leave open: {len(self.answers)}"]
        lines += [f"  {name}" for name in self.answers]
        if self.pairs:
            lines.append("   chance, and recordings for one of 90 %, to find")
            for name, chance, needed in self.told_apart():
                row = f"  {chance:>7} {needed:>8}   {name}"
                lines += textwrap.wrap(row, _WIDTH, subsequent_indent=" " * 21)
        for name, (now, then) in self.narrower.items():
            lines.append(f"  {name}: standard deviation {now:.3g} -> {then:.3g}")
        lines.append("Most of each limit that any answer takes:")
        lines += [f"  {name}: {share:.0%}" for name, share in self.usage.items()]
        for words in self.would_tell:
            lines += textwrap.wrap(words, _WIDTH)
        return "\n".join(lines)

    __str__ = __repr__ = summary

    def told_apart(self) -> list[tuple[str, str, str]]:
        """:return: of each pair its answers, probability to decide, and recordings for 90 %"""
        return [
            (f"{p.true}, not {p.other}", f"{p.chance:.0%}", _number(p.needed)) for p in self.pairs
        ]

    def to_dict(self) -> dict[str, Any]:
        """:return: plain data for JSON"""
        return {
            "sentence": self.sentence,
            "decides": self.decides,
            "answers": list(self.answers),
            "pairs": [pair._asdict() for pair in self.pairs],
            "information": self.information,
            "narrower": {name: list(pair) for name, pair in self.narrower.items()},
            "usage": dict(self.usage),
            "would_tell": list(self.would_tell),
            "dt": self.commands.dt,
            "commands": self.commands.actions.tolist(),
            "start": self.commands.obs[:, 0].tolist(),
        }

    def save(self, path: str | os.PathLike[str]) -> Path:
        """
        Write the commands.

        :param path: ``.csv``: time, recording, commands and predicted channels by name, a row for
            each step; ``.npz``: ``commands``, for ``Trajectories.load``. An existing file is
            replaced.
        :return: its path
        :raises ParameterError: for another ending
        :raises OSError: if there is no folder to write it in
        """
        check_file(path)
        if Path(path).suffix == ".npz":
            return self.commands.save(path)
        import pandas

        data = self.commands
        parts = []
        for i in range(len(data)):
            obs, actions = data.episode(i)
            columns = {"recording": np.full(len(actions), i)}
            columns["time"] = data.dt * np.arange(len(actions))
            columns |= {n: actions[:, j] for j, (n, _) in enumerate(self.actuators)}
            columns |= {f"predicted {n}": obs[:-1, j] for j, (n, _) in enumerate(self.channels)}
            parts.append(pandas.DataFrame(columns))
        text = io.StringIO()
        pandas.concat(parts).to_csv(text, index=False, float_format="%.8g")
        return write_bytes(path, text.getvalue().encode())

    def plot(self, path: str | os.PathLike[str]) -> None:
        """
        Draw the commands and what each answer predicts.

        :param path: of the picture, for example ``"next.png"``
        """
        self.figure().savefig(path, dpi=150)

    def figure(self, narrow: bool = False) -> Any:
        """:return: the same as a figure of matplotlib, for a narrow page or a wide one"""
        from sb3_hds.sysid.reporting.figures import plot_next

        own = (self.predicted, self.answers, self.channels, self.actuators)
        return plot_next(self.commands, *own, narrow=narrow)


def check_file(path: str | os.PathLike[str]) -> None:
    """
    :raises ParameterError: for an ending other than ``.csv`` and ``.npz``
    :raises OSError: if there is no folder to write the file in
    """
    if Path(path).suffix not in (".csv", ".npz"):
        raise ParameterError(f"Commands are written as .csv or .npz, got {path}.")
    check_target(path)


def _number(recordings: float) -> str:
    return "1,000 or more" if recordings >= 1000 else f"{math.ceil(recordings):d}"
