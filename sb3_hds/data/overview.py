"""A listing of a log, and a first map of its columns."""

import dataclasses
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

from sb3_hds.data.columns import Columns, Entry, columns_from
from sb3_hds.data.conversion import unit_of
from sb3_hds.data.load import Files, epoch_unit, first_log
from sb3_hds.data.reading import Log, read_log
from sb3_hds.data.reading.log import base_name

_SHOWN = 200  # columns
_MAX_RADIANS = 7.0  # [rad]
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
    :param rows: number of rows in all episodes; 0 for a value that applies to all rows
    :param kind: dtype of its values
    :param lowest: value; nan for texts
    :param highest: value; nan for texts
    :param step: median difference of two rows; nan if rows decrease
    :param rising: whether each row is above the one before it
    :param example: first value
    """

    name: str
    rows: int
    kind: str
    lowest: float
    highest: float
    step: float
    rising: bool
    example: str

    @property
    def varies(self) -> bool:
        """Whether it is not constant."""
        return self.highest > self.lowest and self.rows > 1


def describe(
    path: Path,
    records: str | None = None,
    skip: int | None = None,
    suggested: str | None = None,
) -> str:
    """
    List the columns of a file, and guess their meaning.

    The text is a valid map of columns, with the list of columns as comments.

    :param path: of a log
    :param records: path to the rows in a nested file
    :param skip: number of lines before the names of a text file
    :param suggested: a map, instead of the guess
    :raises TrajectoryError: if the file cannot be read
    """
    log = read_log(path, Columns(records=records, skip=skip))
    columns = _columns_in(log)
    lines = [*_column_table(path, log, columns), ""]
    if suggested is None and log.columns is not None and log.columns.obs is not None:
        return "\n".join([*lines, "# The file declares its columns and needs no map.", ""])
    hint = "" if suggested else " With --model FILE it is one for a robot's joints."
    lines += [f"# A map to start from. Every line is a guess: check it.{hint}"]
    lines += [f"records: {records}"] if records else []
    lines += [f"skip: {skip}"] if skip else []
    return "\n".join([*lines, *([suggested] if suggested else _guessed_map(log, columns)), ""])


def _columns_in(log: Log) -> list[_Column]:
    return [_column(name, log) for name in dict.fromkeys(n for table in log.tables for n in table)]


def _column(name: str, log: Log) -> _Column:
    parts = [table[name] for table in log.tables if name in table]
    values = np.concatenate([part.ravel() for part in parts])
    rows = sum(part.size for part in parts if part.ndim)
    lowest = highest = step = np.nan
    rising = False
    example = str(values[0])[:20] if len(values) else ""
    if values.dtype.kind in "iufb" and len(values):
        finite = values[np.isfinite(values)].astype(float)
        steps = np.concatenate([np.diff(p.astype(float)) for p in parts if p.ndim] or [[]])
        if len(finite):
            lowest, highest = float(finite.min()), float(finite.max())
        if len(steps) and np.mean(steps < 0.0) < 0.02:
            step, rising = float(np.median(steps)), bool(np.all(steps > 0.0))
    return _Column(name, rows, str(values.dtype), lowest, highest, step, rising, example)


def _column_table(path: Path, log: Log, columns: Sequence[_Column]) -> list[str]:
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


def _guessed_map(log: Log, columns: Sequence[_Column]) -> list[str]:
    own = log.columns or Columns()
    signals = [c for c in columns if not np.isnan(c.lowest)]
    time = None if own.time else _guessed_time(signals)
    episodes = [c for c in signals if c is not time and c.varies and _has_word(c, _EPISODE)]
    rest = [c for c in signals if c.rows > 1 and c is not time and c not in episodes]
    rest = [c for c in rest if not _has_word(c, f"{_INDEX} {_TIME}")]
    rest = [c for c in rest if time is None or c.rows in (time.rows, time.rows - len(log.tables))]
    actions = [c for c in rest if _has_word(c, _ACTION)]
    sensed = [c for c in rest if c not in actions and c.varies]
    obs = [c for c in sensed if _has_word(c, _OBSERVED)] or sensed
    lines = [] if own.time else [_time_line(log, time)]
    nothing = ["obs: []  # nothing changes: name them"]
    lines += _entry_lines("obs", obs, log.units) if obs else nothing
    lines += _entry_lines("actions", actions, log.units) if actions else ["actions: []"]
    if episodes and not own.episode:
        lines.append(f"episode: {_inline_yaml({'column': episodes[0].name})}")
    used = {c.name for c in (*obs, *actions, *episodes[:1])} | {time.name if time else ""}
    others = [c.name for c in columns if c.name not in used]
    lines += [f"# not used: {', '.join(others[:_SHOWN])}"] if others else []
    return lines


def _guessed_time(columns: Sequence[_Column]) -> _Column | None:
    """
    An increasing column whose name suggests a time, or else one that increases steadily. The first
    column may do so less evenly.
    """
    increasing = [c for c in columns if c.step > 0.0]
    called = [c for c in increasing if _has_word(c, _TIME)]
    words = f"{_INDEX} {_OBSERVED} {_ACTION}"
    others = [c for c in increasing if c.varies and not _has_word(c, words)]
    uneven = {c.name: (c.highest - c.lowest) / (c.step * (c.rows - 1)) - 1.0 for c in others}
    steady = [c for c in others if abs(uneven[c.name]) < 0.01]
    first = [c for c in others if c is columns[0] and c.rising and -0.1 < uneven[c.name] < 0.5]
    return next(iter([*called, *first, *steady]), None)


def _time_line(log: Log, time: _Column | None) -> str:
    if time is None:
        return "dt: 0.01  # seconds between two rows: no column looks like time stamps"
    factor, unit = _time_unit(log, time)
    entry = {"column": time.name} | ({"unit": unit} if unit else {})
    step = time.step * factor
    return f"time: {_inline_yaml(entry)}  # a row every {step:.4g} s, {1.0 / step:.4g} Hz"


def _time_unit(log: Log, time: _Column) -> tuple[float, str]:
    """
    The unit that the file declares, or else from the size, name or steps of the stamps.

    :return: the unit in seconds; and its symbol, empty if the file declares it and for seconds
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


def _entry_lines(key: str, columns: Sequence[_Column], units: Mapping[str, str]) -> list[str]:
    lines = [f"{key}:" + ("  # in the order of the twin: sb3-hds twins" if key == "obs" else "")]
    for column in columns[:_SHOWN]:
        unit = unit_of(units.get(column.name, ""))
        largest = max(abs(column.lowest), abs(column.highest))
        comment = ""
        if unit and unit.name:
            comment = f"  # {units[column.name]}, converted to {unit.name}"
        elif _has_word(column, _ANGLE) and largest > _MAX_RADIANS:
            comment = "  # degrees? Then add unit: deg"
        lines.append(f"  - {_inline_yaml({'column': column.name})}{comment}")
    return lines


def _has_word(column: _Column, words: str) -> bool:
    """Whether the last part of the name contains one of these words."""
    return bool(set(_words(column.name)) & set(words.split()))


def _words(name: str) -> list[str]:
    """The words of the last part of a name: ``["pos", "meas"]`` of ``"arm/pos_meas1"``."""
    last = re.split(r"[/:.]", base_name(name))[-1] or name
    split = re.sub(r"([a-z])([A-Z])", r"\1 \2", last)
    return [word for word in re.split(r"[\W\d_]+", split.lower()) if word]


def _inline_yaml(entry: Any) -> str:
    text = yaml.safe_dump(
        entry, default_flow_style=True, allow_unicode=True, width=10_000, sort_keys=False
    )
    return text.strip()


@dataclasses.dataclass(frozen=True)
class ChannelCandidates:
    """
    The columns of a log from which a twin's channels are chosen by name.

    :param observed: columns that may be observations; or any channel, if the map names none
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
        :param actions: names of entries, in the order of a twin's actuators
        :return: a map of columns for ``Trajectories.load``
        """
        known = {entry.name: entry for entry in (*self.observed, *self.commanded)}
        commands = known | {entry.name: entry for entry in self.commanded}
        return dataclasses.replace(
            self.rest,
            obs=tuple(known[name] for name in obs),
            actions=tuple(commands[name] for name in actions),
        )


class Suggestion(NamedTuple):
    """
    A line of a map of columns.

    :param name: of the channel
    :param entry: name of its entry, as in :class:`ChannelCandidates`; empty if unknown
    :param comment: on the line; empty without any
    """

    name: str
    entry: str
    comment: str = ""


def suggested_map(
    known: ChannelCandidates, obs: Iterable[Suggestion], actions: Iterable[Suggestion]
) -> str:
    """
    :param obs: a line for each channel of a twin, in its order
    :param actions: a line for each actuator
    :return: a map of columns as yml, in which ``NAME`` stands for columns that are not known
    """
    entries = {entry.name: entry for entry in (*known.commanded, *known.observed)}
    lines = [_line_of_time(known.rest)]
    for key, suggestions in (("obs", list(obs)), ("actions", list(actions))):
        lines.append(f"{key}:" + ("" if suggestions else " []"))
        for name, entry, comment in suggestions:
            fields = _fields_of(entries.get(entry, Entry(name, "NAME"))) | {"name": name}
            lines.append(f"  - {_inline_yaml(fields)}" + (f"  # {comment}" if comment else ""))
    return "\n".join(lines)


def _line_of_time(rest: Columns) -> str:
    if rest.time is None:
        known = "SECONDS  # or time: NAME" if rest.dt is None else f"{rest.dt:g}"
        return f"dt: {known}"
    fields = [_fields_of(entry) for entry in rest.time]
    return f"time: {_inline_yaml(fields[0] if len(fields) == 1 else fields)}"


def _fields_of(entry: Entry) -> dict[str, Any]:
    """The fields of an entry that differ from their defaults, without its name."""
    if entry.column is None:
        return {"constant": entry.offset}
    fields = entry._asdict() | {"unit": entry.unit or None}
    defaults = Entry._field_defaults
    given = {key: fields[key] for key in ("column", "unit", "scale", "offset", "angle")}
    return {key: x for key, x in given.items() if key == "column" or x != defaults[key]}


def channel_candidates(
    files: Files, columns: str | os.PathLike[str] | dict | None = None
) -> ChannelCandidates | None:
    """
    :param files: as for ``Trajectories.load``; only the first one is read
    :param columns: a map, whose ``obs`` and ``actions`` may be missing
    :return: None for a file written by ``Trajectories.save``, which has no names
    :raises TrajectoryError: if it cannot be read
    """
    given = None if columns is None else columns_from(columns)
    log = first_log(files, given)
    if log is None:
        return None
    merged = (given or Columns()).completed_by(log.columns or Columns())
    guessed = []
    if merged.time is None and merged.dt is None:
        found = _guessed_time(_columns_in(log))
        if found is not None:
            _, unit = _time_unit(log, found)
            entry = Entry(found.name, found.name, unit=unit or None)
            merged = dataclasses.replace(merged, time=(entry,))
            guessed.append(f"Time is taken from '{found.name}'{f' in {unit}' if unit else ''}.")
    table = log.tables[0]
    taken = {entry.column for entry in (*(merged.obs or ()), *(merged.actions or ()))}
    every = tuple(
        Entry(name, name)
        for name, values in table.items()
        if np.ndim(values) and values.dtype.kind in "iuf" and name not in taken
    )
    return ChannelCandidates(
        every if merged.obs is None else merged.obs,
        (merged.actions or ()) if merged.obs is not None or merged.actions else (),
        dataclasses.replace(merged, obs=None, actions=None),
        tuple(guessed),
    )
