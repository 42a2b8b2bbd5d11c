"""A listing of a log, and a first map of its columns."""

import dataclasses
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import yaml

from sb3_hds.data.columns import Columns, Entry, columns_from
from sb3_hds.data.conversion import unit_of
from sb3_hds.data.load import Files, epoch_unit, first_log
from sb3_hds.data.reading import Log, read_log
from sb3_hds.data.reading.log import base_of

_SHOWN = 200  # columns
_MORE_THAN_A_TURN = 7.0  # [rad]
# Words of a name, without its digits.
_TIME = "t time times timestamp stamp sec secs seconds clock ms us ns millis micros elapsed"
_EPISODE = "episode ep run trial trajectory traj rollout"
_INDEX = "index frame idx row step seq id count counter received"
_ACTION = (
    "u tau torque trq cmd command commands action actions act ctrl control effort pwm voltage "
    "current force goal target desired des ref setpoint throttle con"
)
_OBSERVED = (
    "q dq qd qdot v w x y z pos position positions angle theta phi alpha beta speed vel velocity "
    "velocities omega rate state states obs observation observations qpos qvel meas measured "
    "encoder gyro acc"
)
_ANGLE = "q pos position positions angle theta phi qpos"


class _Column(NamedTuple):
    """
    :param name: of the column
    :param rows: in all episodes together; 0 for a value that holds for all rows
    :param kind: of its values
    :param lowest: not a number for texts
    :param highest: not a number for texts
    :param step: usual difference of two rows; not a number where rows decrease
    :param example: first value
    """

    name: str
    rows: int
    kind: str
    lowest: float
    highest: float
    step: float
    example: str

    @property
    def varies(self) -> bool:
        """Whether it changes at all."""
        return self.highest > self.lowest and self.rows > 1


def describe(path: Path, records: str | None = None, skip: int | None = None) -> str:
    """
    List the columns of a file, and guess what they are.

    The text is a map of columns as a whole: what is listed are comments.

    :param path: of a log
    :param records: where the rows are in a file that nests them
    :param skip: number of lines before the names of a text file
    :raises TrajectoryError: if the file cannot be read
    """
    log = read_log(path, Columns(records=records, skip=skip))
    columns = _columns_in(log)
    lines = [*_listing(path, log, columns), ""]
    if log.columns is not None and log.columns.obs is not None:
        return "\n".join([*lines, "# It says itself what its columns are, and needs no map.", ""])
    lines += ["# A map to start from. Everything in it is a guess: check each line."]
    lines += [f"records: {records}"] if records else []
    lines += [f"skip: {skip}"] if skip else []
    return "\n".join([*lines, *_map(log, columns), ""])


def _columns_in(log: Log) -> list[_Column]:
    return [_column(name, log) for name in dict.fromkeys(n for table in log.tables for n in table)]


def _column(name: str, log: Log) -> _Column:
    parts = [table[name] for table in log.tables if name in table]
    values = np.concatenate([part.ravel() for part in parts])
    rows = sum(part.size for part in parts if part.ndim)
    lowest = highest = step = np.nan
    example = str(values[0])[:20] if len(values) else ""
    if values.dtype.kind in "iufb" and len(values):
        finite = values[np.isfinite(values)].astype(float)
        steps = np.concatenate([np.diff(p.astype(float)) for p in parts if p.ndim] or [[]])
        if len(finite):
            lowest, highest = float(finite.min()), float(finite.max())
        if len(steps) and np.mean(steps < 0.0) < 0.02:
            step = float(np.median(steps))
    return _Column(name, rows, str(values.dtype), lowest, highest, step, example)


def _listing(path: Path, log: Log, columns: Sequence[_Column]) -> list[str]:
    n = len(log.tables)
    counts = sorted({column.rows for column in columns})
    rows = f"{counts[-1]} rows" if counts else "nothing"
    width = max([len("column"), *(len(column.name) for column in columns[:_SHOWN])])
    lines = [
        f"# {path.name}: {rows}{f' in {n} episodes' if n > 1 else ''}, {len(columns)} columns",
        f"#   {'column':<{width}} {'rows':>8} {'type':>9} {'lowest':>12} {'highest':>12}  unit",
    ]
    for c in columns[:_SHOWN]:
        values = f"{c.lowest:>12.6g} {c.highest:>12.6g}"
        if np.isnan(c.lowest):
            values = f"{c.example:>12}{'':13}"
        unit = f"  {log.units[c.name]}" if log.units.get(c.name) else ""
        lines.append(f"#   {c.name:<{width}} {c.rows or 'all':>8} {c.kind:>9} {values}{unit}")
    if len(columns) > _SHOWN:
        lines.append(f"#   and {len(columns) - _SHOWN} more")
    return [line.rstrip() for line in lines]


def _map(log: Log, columns: Sequence[_Column]) -> list[str]:
    own = log.columns or Columns()
    signals = [c for c in columns if not np.isnan(c.lowest)]
    time = None if own.time else _guessed_time(signals)
    episodes = [c for c in signals if c is not time and c.varies and _is(c, _EPISODE)]
    rest = [c for c in signals if c.rows > 1 and c is not time and c not in episodes]
    rest = [c for c in rest if not _is(c, f"{_INDEX} {_TIME}")]
    rest = [c for c in rest if time is None or c.rows in (time.rows, time.rows - len(log.tables))]
    actions = [c for c in rest if _is(c, _ACTION)]
    sensed = [c for c in rest if c not in actions and c.varies]
    obs = [c for c in sensed if _is(c, _OBSERVED)] or sensed
    lines = [] if own.time else [_time_line(log, time)]
    lines += _entries("obs", obs, log.units) if obs else ["obs: []  # nothing changes: name them"]
    lines += _entries("actions", actions, log.units) if actions else ["actions: []"]
    if episodes and not own.episode:
        lines.append(f"episode: {_flow({'column': episodes[0].name})}")
    used = {c.name for c in (*obs, *actions, *episodes[:1])} | {time.name if time else ""}
    others = [c.name for c in columns if c.name not in used]
    lines += [f"# not used: {', '.join(others[:_SHOWN])}"] if others else []
    return lines


def guessed_time(log: Log) -> Entry | None:
    """:return: what looks like the time stamps of a log, with their unit"""
    columns = _columns_in(log)
    found = _guessed_time([c for c in columns if not np.isnan(c.lowest)])
    return found and Entry(found.name, found.name, unit=_time_unit(log, found)[1] or None)


def _guessed_time(columns: Sequence[_Column]) -> _Column | None:
    """An increasing column with the name of a time, or else one that increases steadily."""
    rising = [c for c in columns if c.step > 0.0]
    called = [c for c in rising if _is(c, _TIME)]
    others = [c for c in rising if c.varies and not _is(c, f"{_INDEX} {_OBSERVED} {_ACTION}")]
    steady = [c for c in others if abs((c.highest - c.lowest) / (c.step * (c.rows - 1)) - 1) < 0.01]
    return next(iter([*called, *steady]), None)


def _time_line(log: Log, time: _Column | None) -> str:
    if time is None:
        return "dt: 0.01  # seconds between two rows: nothing here looks like time stamps"
    factor, unit = _time_unit(log, time)
    entry = {"column": time.name} | ({"unit": unit} if unit else {})
    step = time.step * factor
    return f"time: {_flow(entry)}  # a row every {step:.4g} s, {1.0 / step:.4g} Hz"


def _time_unit(log: Log, time: _Column) -> tuple[float, str]:
    """
    From the file, or the size, the name or the steps of the stamps, in that order.

    :return: the unit in seconds; and its symbol, empty where the file names it and for seconds
    """
    declared = unit_of(log.units.get(time.name, ""))
    if declared is not None and declared.name == "s":
        return declared.factor, ""
    abbreviated = {"ms": "ms", "us": "us", "ns": "ns", "millis": "ms", "micros": "us"}
    named = [abbreviated[word] for word in _words(time.name) if word in abbreviated]
    by_step = "ns" if time.step >= 1e5 else "us" if time.step >= 500.0 else "ms"
    by_step = by_step if time.step >= 1.0 else "s"
    unit = epoch_unit(log.tables[0], Entry(time.name, time.name)) or next(iter(named), by_step)
    return Entry("", "", unit=unit).factor, "" if unit == "s" else unit


def _entries(key: str, columns: Sequence[_Column], units: Mapping[str, str]) -> list[str]:
    lines = [f"{key}:" + ("  # in the order of the twin: sb3-hds twins" if key == "obs" else "")]
    for column in columns[:_SHOWN]:
        unit = unit_of(units.get(column.name, ""))
        said = f"  # {units[column.name]}, converted to {unit.name}" if unit and unit.name else ""
        largest = max(abs(column.lowest), abs(column.highest))
        if not said and _is(column, _ANGLE) and largest > _MORE_THAN_A_TURN:
            said = "  # degrees? Then write unit: deg"
        lines.append(f"  - {_flow({'column': column.name})}{said}")
    return lines


def _is(column: _Column, words: str) -> bool:
    """Whether the name has one of these words in it, at its end at first."""
    return bool(set(_words(column.name)) & set(words.split()))


def _words(name: str) -> list[str]:
    """The words of the last part of a name: ``["pos", "meas"]`` of ``"arm/pos_meas1"``."""
    last = re.split(r"[/:.]", base_of(name))[-1] or name
    split = re.sub(r"([a-z])([A-Z])", r"\1 \2", last)
    return [word for word in re.split(r"[\W\d_]+", split.lower()) if word]


def _flow(entry: Mapping[str, str]) -> str:
    text = yaml.safe_dump(dict(entry), default_flow_style=True, allow_unicode=True, width=10_000)
    return text.strip()


@dataclasses.dataclass(frozen=True)
class Named:
    """
    :param observed: columns that may be observations, or anything
    :param commanded: columns that are known to be commands
    :param rest: the map without these two: time, episodes, label
    :param guessed: one sentence for each guess
    """

    observed: tuple[Entry, ...]
    commanded: tuple[Entry, ...]
    rest: Columns
    guessed: tuple[str, ...] = ()

    def chosen(self, obs: Iterable[str], actions: Iterable[str]) -> Columns:
        """
        :param obs: names of entries, in the order of a twin's channels
        :param actions: likewise, of its actuators
        :return: what ``Trajectories.load`` takes
        """
        known = {entry.name: entry for entry in (*self.observed, *self.commanded)}
        commands = known | {entry.name: entry for entry in self.commanded}
        return dataclasses.replace(
            self.rest,
            obs=tuple(known[name] for name in obs),
            actions=tuple(commands[name] for name in actions),
        )


def names_in(files: Files, columns: str | os.PathLike[str] | dict | None = None) -> Named | None:
    """
    :param files: as for ``Trajectories.load``; the first of them is asked
    :param columns: a map, whose ``obs`` and ``actions`` may be left out
    :return: None for a file that ``Trajectories.save`` wrote, which has no names
    :raises TrajectoryError: if it cannot be read
    """
    said = None if columns is None else columns_from(columns)
    log = first_log(files, said)
    if log is None:
        return None
    merged = (said or Columns()).completed_by(log.columns or Columns())
    guessed = []
    if merged.time is None and merged.dt is None:
        entry = guessed_time(log)
        if entry is not None:
            merged = dataclasses.replace(merged, time=(entry,))
            unit = f" in {entry.unit}" if entry.unit else ""
            guessed.append(f"Time is taken from '{entry.column}'{unit}.")
    table = log.tables[0]
    taken = {entry.column for entry in (*(merged.obs or ()), *(merged.actions or ()))}
    every = tuple(
        Entry(name, name)
        for name, values in table.items()
        if np.ndim(values) and values.dtype.kind in "iuf" and name not in taken
    )
    return Named(
        every if merged.obs is None else merged.obs,
        (merged.actions or ()) if merged.obs is not None or merged.actions else (),
        dataclasses.replace(merged, obs=None, actions=None),
        tuple(guessed),
    )
