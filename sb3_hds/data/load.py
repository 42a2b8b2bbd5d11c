"""Logs of any kind as ``Trajectories``."""

import dataclasses
import glob
import os
import warnings
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sb3_hds.core.trajectories import Trajectories
from sb3_hds.data import recording
from sb3_hds.data.columns import Columns, Entry, columns_from
from sb3_hds.data.reading import READERS, Log, Table, read_log
from sb3_hds.data.reading.minari import PREFIX
from sb3_hds.data.reading.ros import is_bag
from sb3_hds.data.resampling.report import Reading
from sb3_hds.data.resampling.resample import at_one_interval
from sb3_hds.data.resampling.rows import Rows, rows_of
from sb3_hds.data.wording import listed
from sb3_hds.errors import TrajectoryError

_SUFFIX = ".npz"  # of what Trajectories.save writes
WITHOUT_COLUMNS = (
    "Say what its columns mean: columns={'time': NAME, 'obs': [NAME, ...], 'actions': [NAME, "
    "...]}. 'sb3-hds columns FILE' prints what there is."
)
_EPOCH = {1.0: "s", 1e3: "ms", 1e6: "us", 1e9: "ns"}  # unit by how many there are in a second
_FROM, _TO = 9.4e8, 4.1e9  # years 2000 to 2100 [s since 1970]

Files = str | os.PathLike[str] | Iterable[str | os.PathLike[str]]


class SamplingWarning(UserWarning):
    """The rows of a log do not lie on a regular time grid; says what was changed."""


def load(files: Files, columns: Any = None) -> Trajectories:
    """
    Read logs; what ``Trajectories.load`` does.

    Row k of a log is observation k, with the action that acts from then on; the action in the last
    row of an episode is not used. Rows of a regular clock are kept, even if their stamps are
    rounded, late or jitter; others are resampled. Duplicated rows are dropped. A gap ends the
    episode, and so does a change of label. Changes are warned of, and kept in ``report`` together
    with the clock that was found.

    :param files: path, pattern with ``*``, ``minari:`` and the name of a data set, or several of
        them; a pattern gives its files in alphabetical order
    :param columns: what the columns mean, as a dict or the path of a yml file; not needed for files
        that ``Trajectories.save`` or a ``Recorder`` wrote
    :return: one trajectory per episode or piece of one; ``origin`` counts the episodes
    :raises TrajectoryError: for a file that cannot be read, a column that is missing or holds no
        finite numbers, or decreasing time; says where
    """
    try:
        data = _loaded(files, columns)
    except TrajectoryError as error:
        if len(str(error).splitlines()) < 2:
            raise
        # Names in a damaged file may hold anything.
        raise TrajectoryError(" ".join(str(error).split())) from error
    report = data.report
    if isinstance(report, Reading) and report.altered:
        warnings.warn(report.summary(), SamplingWarning, stacklevel=3)
    return data


def _loaded(files: Files, map_of_columns: Any) -> Trajectories:
    said = None if map_of_columns is None else columns_from(map_of_columns)
    paths = _paths(files)
    if said is None and all(_is_own(path) for path in paths):
        return Trajectories.concatenate([Trajectories.load(path) for path in paths])
    # One file after another, of which only the columns that are used are kept.
    episodes, notes = list[Rows](), dict[str, None]()
    first: _First | None = None
    for path in paths:
        log = _log(path, said)
        columns, remarks = _understood((said or Columns()).over(log.columns), log)
        first = first or _First(path, columns, frozenset(log.tables[0]))
        _check_same(first, columns, log.tables[0], path)
        notes |= dict.fromkeys(remarks)
        for i, table in enumerate(log.tables):
            name = path if path.startswith(PREFIX) else Path(path).name
            source = name if len(log.tables) == 1 else f"{name}, episode {i}"
            episodes += rows_of(table, columns, source, Path(path).stem)
    return at_one_interval(episodes, first.columns if first else Columns(), tuple(notes))


def first_log(files: Files, said: Columns | None) -> Log | None:
    """
    :param said: the map of columns; None: there is none
    :return: the first file as a log; None if ``Trajectories.save`` wrote it
    :raises TrajectoryError: if it cannot be read
    """
    path = _paths(files)[0]
    if said is None and _is_own(path):
        return None
    return read_log(path, said or Columns())


class _First(NamedTuple):
    """The file that the others must agree with."""

    path: str
    columns: Columns
    names: frozenset[str]


def _paths(files: Any) -> list[str]:
    """All files, with patterns expanded."""
    several = not isinstance(files, str | os.PathLike)
    if several and not isinstance(files, Iterable):
        raise TrajectoryError(f"files must be paths or patterns, got {files!r}.")
    found: list[str] = []
    for item in files if several else [files]:
        if not isinstance(item, str | os.PathLike):
            raise TrajectoryError(f"files must be paths or patterns, got {item!r}.")
        path = os.path.expanduser(os.fspath(item))
        if path.startswith(PREFIX) or not glob.has_magic(path) or Path(path).exists():
            found.append(path)
            continue
        matching = sorted(
            p for p in glob.glob(path, recursive=True) if Path(p).is_file() or is_bag(Path(p))
        )
        if not matching:
            raise TrajectoryError(f"No file matches '{path}' (in {Path.cwd()}).")
        found += matching
    if not found:
        raise TrajectoryError("files names no file.")
    times = Counter(path if path.startswith(PREFIX) else os.path.realpath(path) for path in found)
    (path, n), *_ = times.most_common(1)
    if n > 1:
        raise TrajectoryError(f"files names '{path}' {n} times: a recording is evidence only once.")
    return found


def _is_own(path: str) -> bool:
    return Path(path).suffix == _SUFFIX or Path(path + _SUFFIX).is_file()


def _log(path: str, said: Columns | None) -> Log:
    suffix = Path(path).suffix
    known = suffix.lower() in READERS or is_bag(Path(path))
    log = None
    if said is not None or not known or suffix.lower() == recording.SUFFIX:
        log = read_log(path, said or Columns())
    if log is None or (said is None and (log.columns is None or log.columns.obs is None)):
        raise TrajectoryError(
            f"'{path}' cannot be read without columns: files that end in {_SUFFIX} can, and "
            f"recordings, not what else ends in '{suffix}'. {WITHOUT_COLUMNS}"
        )
    return log


def _understood(columns: Columns, log: Log) -> tuple[Columns, tuple[str, ...]]:
    """Columns with the units that the file declares, and notes on them."""
    columns = columns.in_units(log.units)
    notes = list(log.notes)
    used = [*(columns.obs or ()), *(columns.actions or ()), *(columns.time or ())]
    named = {e.column: e.unit for e in used if e.unit and e.unit == log.units.get(e.column or "")}
    if named:
        shown = (f"{name} in {(unit or '').strip('[]()')}" for name, unit in named.items())
        notes.append(f"Units as the file names them: {listed(shown)}.")
    if columns.time is not None and len(columns.time) == 1:
        [entry] = columns.time
        unit = epoch_unit(log.tables[0], entry)
        if unit:
            columns = dataclasses.replace(columns, time=(entry._replace(unit=unit),))
            notes.append(f"{entry.column} counts {unit} since 1970.")
    return columns, tuple(notes)


def epoch_unit(table: Table, entry: Entry) -> str:
    """
    :param table: of a file
    :param entry: of its stamps
    :return: their unit, if they are dates of this century and nobody names it; otherwise empty
    """
    stamps = table.get(entry.column or "", np.zeros(0))
    if entry.unit is not None or not stamps.size or stamps.dtype.kind not in "iuf":
        return ""
    first = float(stamps.ravel()[0])
    units = [unit for factor, unit in _EPOCH.items() if _FROM <= first / factor <= _TO]
    return units[0] if units and units[0] != "s" else ""


def _check_same(first: _First, here: Columns, table: Table, path: str) -> None:
    """:raises TrajectoryError: if channels, units, interval or columns differ between files"""
    for name in ("obs", "actions"):
        one, other = (getattr(c, name) or () for c in (first.columns, here))
        ours, theirs = ([e.name for e in entries] for entries in (one, other))
        if ours != theirs:
            raise TrajectoryError(
                f"All files must have the same {name}, but '{first.path}' has {ours} and '{path}' "
                f"has {theirs}. Choose those that they share by columns."
            )
        for a, b in zip(one, other, strict=True):
            if a.si_unit != b.si_unit:
                raise TrajectoryError(
                    f"'{a.name}' is in {a.unit or 'a unit that is not named'} in '{first.path}' "
                    f"and in {b.unit or 'a unit that is not named'} in '{path}'. Say in which "
                    f"unit it is: {name}: [{{column: {a.column}, unit: UNIT}}]."
                )
    if first.columns.dt != here.dt:
        raise TrajectoryError(
            f"'{first.path}' is sampled every {first.columns.dt} s and '{path}' every {here.dt} s. "
            "Say which interval you want: columns={'dt': SECONDS}."
        )
    lacking = sorted((here.wanted & first.names) - set(table))
    if lacking:
        raise TrajectoryError(
            f"The files have different columns: '{first.path}' has '{lacking[0]}', '{path}' has "
            f"not; it has: {listed(table)}. Load them with a map of columns for each, "
            "then join them: Trajectories.concatenate."
        )
