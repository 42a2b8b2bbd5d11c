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
from sb3_hds.data.resampling.resample import resample
from sb3_hds.data.resampling.rows import Rows, rows_of
from sb3_hds.data.wording import listed
from sb3_hds.errors import TrajectoryError

_SUFFIX = ".npz"  # of what Trajectories.save writes
WITHOUT_COLUMNS = (
    "Say what its columns mean: columns={'time': NAME, 'obs': [NAME, ...], 'actions': [NAME, "
    "...]}. 'sb3-hds columns FILE' prints what there is."
)
_EPOCH_UNITS = {1.0: "s", 1e3: "ms", 1e6: "us", 1e9: "ns"}  # unit by its number per second
_EARLIEST, _LATEST = 9.4e8, 4.1e9  # years 2000 to 2100 [s since 1970]

Files = str | os.PathLike[str] | Iterable[str | os.PathLike[str]]


class SamplingWarning(UserWarning):
    """The rows of a log are not on a regular time grid; reports what was changed."""


def load(files: Files, columns: Any = None) -> Trajectories:
    """
    Read logs; the implementation of ``Trajectories.load``.

    Row k of a log is observation k, with the action that acts from then on; the action in the last
    row of an episode is not used. Rows of a regular clock are kept, even if their stamps are
    rounded, late or jittered; others are resampled. Duplicated rows are dropped. A gap ends the
    episode, and so does a change of label. Changes raise a warning, and are recorded in ``report``
    together with the identified clock.

    :param files: path, pattern with ``*``, ``minari:`` and the name of a data set, or several of
        them; files of a pattern are sorted by name
    :param columns: what the columns mean, as a dict or the path of a yml file; not needed for files
        written by ``Trajectories.save`` or a ``Recorder``
    :return: one trajectory per episode or part of one; ``origin`` counts the episodes
    :raises TrajectoryError: for a file that cannot be read, a column that is missing or not finite,
        or decreasing time; the message says where
    """
    try:
        data = _loaded(files, columns)
    except TrajectoryError as error:
        if len(str(error).splitlines()) < 2:
            raise
        # Names in a damaged file may contain line breaks.
        raise TrajectoryError(" ".join(str(error).split())) from error
    report = data.report
    if isinstance(report, Reading) and report.altered:
        warnings.warn(report.summary(), SamplingWarning, stacklevel=3)
    return data


def _loaded(files: Files, column_map: Any) -> Trajectories:
    given = None if column_map is None else columns_from(column_map)
    paths = paths_of(files)
    if given is None and all(_is_saved(path) for path in paths):
        return Trajectories.concatenate([Trajectories.load(path) for path in paths])
    # One file at a time, of which only the columns that are used are kept in memory.
    episodes, notes = list[Rows](), dict[str, None]()
    first: _FirstFile | None = None
    for path in paths:
        if given is None and _is_saved(path):
            raise TrajectoryError(
                f"'{path}' was written by Trajectories.save and cannot be loaded together with "
                "other files. Load them apart, and join them by Trajectories.concatenate."
            )
        log = _read(path, given)
        columns, remarks = _with_units((given or Columns()).over(log.columns), log)
        first = first or _FirstFile(path, columns, frozenset(log.tables[0]))
        _check_same(first, columns, log.tables[0], path)
        notes |= dict.fromkeys(remarks)
        for i, table in enumerate(log.tables):
            name = path if path.startswith(PREFIX) else Path(path).name
            source = name if len(log.tables) == 1 else f"{name}, episode {i}"
            episodes += rows_of(table, columns, source, Path(path).stem)
    return resample(episodes, first.columns if first else Columns(), tuple(notes))


def first_log(files: Files, given: Columns | None) -> Log | None:
    """
    :param given: the map of columns, if there is one
    :return: the first file as a log; None if it was written by ``Trajectories.save``
    :raises TrajectoryError: if it cannot be read
    """
    path = paths_of(files)[0]
    if given is None and _is_saved(path):
        return None
    return read_log(path, given or Columns())


class _FirstFile(NamedTuple):
    """The first file, whose channels and columns the others must share."""

    path: str
    columns: Columns
    names: frozenset[str]


def paths_of(files: Any) -> list[str]:
    """
    :return: all files, with patterns expanded
    :raises TrajectoryError: for a pattern that no file matches, or a file that is named twice
    """
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
        matches = glob.glob(path, recursive=True)
        matching = sorted(p for p in matches if Path(p).is_file() or is_bag(Path(p)))
        if not matching:
            raise TrajectoryError(f"No file matches '{path}' (in {Path.cwd()}).")
        found += matching
    if not found:
        raise TrajectoryError("files is empty.")
    times = Counter(path if path.startswith(PREFIX) else os.path.realpath(path) for path in found)
    (path, n), *_ = times.most_common(1)
    if n > 1:
        raise TrajectoryError(f"files contains '{path}' {n} times: use each recording once.")
    return found


def _is_saved(path: str) -> bool:
    return Path(path).suffix == _SUFFIX or Path(path + _SUFFIX).is_file()


def _read(path: str, given: Columns | None) -> Log:
    suffix = Path(path).suffix
    known = suffix.lower() in READERS or is_bag(Path(path))
    log = None
    if given is not None or not known or suffix.lower() == recording.SUFFIX:
        log = read_log(path, given or Columns())
    if log is None or (given is None and (log.columns is None or log.columns.obs is None)):
        raise TrajectoryError(
            f"'{path}' cannot be read without columns: files that end in {_SUFFIX} can, and "
            f"recordings, but no other files that end in '{suffix}'. {WITHOUT_COLUMNS}"
        )
    return log


def _with_units(columns: Columns, log: Log) -> tuple[Columns, tuple[str, ...]]:
    """The columns with the units that the file declares, and notes for the report."""
    columns = columns.in_units(log.units)
    notes = list(log.notes)
    used = [*(columns.obs or ()), *(columns.actions or ()), *(columns.time or ())]
    named = {e.column: e.unit for e in used if e.unit and e.unit == log.units.get(e.column or "")}
    if named:
        shown = (f"{name} in {(unit or '').strip('[]()')}" for name, unit in named.items())
        notes.append(f"Units declared by the file: {listed(shown)}.")
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
    :return: their unit, if it is undeclared and they are dates of this century; otherwise empty
    """
    stamps = table.get(entry.column or "", np.zeros(0))
    if entry.unit is not None or not stamps.size or stamps.dtype.kind not in "iuf":
        return ""
    first = float(stamps.ravel()[0])
    for factor, unit in _EPOCH_UNITS.items():
        if _EARLIEST <= first / factor <= _LATEST:
            return "" if unit == "s" else unit
    return ""


def _check_same(first: _FirstFile, here: Columns, table: Table, path: str) -> None:
    """:raises TrajectoryError: if channels, units, interval or columns differ between files"""
    for name in ("obs", "actions"):
        one, other = (getattr(c, name) or () for c in (first.columns, here))
        ours, theirs = ([e.name for e in entries] for entries in (one, other))
        if ours != theirs:
            raise TrajectoryError(
                f"All files must have the same {name}, but '{first.path}' has {ours} and '{path}' "
                f"has {theirs}. Select the common ones with columns."
            )
        for a, b in zip(one, other, strict=True):
            if a.si_unit != b.si_unit:
                raise TrajectoryError(
                    f"'{a.name}' is in {a.unit or 'an undeclared unit'} in '{first.path}' and in "
                    f"{b.unit or 'an undeclared unit'} in '{path}'. Declare its unit: {name}: "
                    f"[{{column: {a.column}, unit: UNIT}}]."
                )
    if first.columns.dt != here.dt:
        raise TrajectoryError(
            f"'{first.path}' is sampled every {first.columns.dt} s and '{path}' every {here.dt} s. "
            "Choose an interval: columns={'dt': SECONDS}."
        )
    lacking = sorted((here.wanted & first.names) - set(table))
    if lacking:
        raise TrajectoryError(
            f"The files have different columns: '{first.path}' has '{lacking[0]}', '{path}' does "
            f"not; it has: {listed(table)}. Load each with its own map of columns, then join them: "
            "Trajectories.concatenate."
        )
