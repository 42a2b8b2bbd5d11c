"""Logs of any kind as ``Trajectories``."""

import dataclasses
import glob
import os
import warnings
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from sb3_hds.core.trajectories import Trajectories
from sb3_hds.data import recording
from sb3_hds.data.columns import Columns, columns_from
from sb3_hds.data.minari_sets import PREFIX, read_minari
from sb3_hds.data.rows import Rows, rows_of
from sb3_hds.data.sampling import at_one_interval
from sb3_hds.data.tables import READERS, Log, read_log
from sb3_hds.errors import TrajectoryError

_SUFFIX = ".npz"  # of what Trajectories.save writes
WITHOUT_COLUMNS = (
    "Say what its columns mean: columns={'time': NAME, 'obs': [NAME, ...], 'actions': [NAME, ...]}."
)

Files = str | os.PathLike[str] | Iterable[str | os.PathLike[str]]


class SamplingWarning(UserWarning):
    """The rows of a log do not lie on one grid of time; says what was done about it."""


def load(files: Files, columns: Any = None) -> Trajectories:
    """
    Read logs; what ``Trajectories.load`` does.

    Row k of a log is observation k, with the action that acts from then on: the action in the last
    row of an episode is not used. Rows of a regular clock stay as they are, also where their stamps
    are rounded, late or jitter; others are resampled. A row that was written twice is left out. A
    gap ends the episode, and so does another label. What was changed is warned of; that, and what
    paced the rows, stays in ``report``.

    :param files: path, pattern with ``*``, ``minari:`` and the name of a data set, or several of
        them; a pattern gives its files in alphabetical order
    :param columns: what the columns mean, as a dict or the path of a yml file; not needed for files
        that ``Trajectories.save`` or a ``Recorder`` wrote
    :return: one trajectory per episode or piece of one; ``origin`` counts the episodes
    :raises TrajectoryError: for a file that cannot be read, a column that is missing or holds no
        finite numbers, or decreasing time; says where
    """
    said = None if columns is None else columns_from(columns)
    paths = _paths(files)
    if said is None and all(_is_own(path) for path in paths):
        return Trajectories.concatenate([Trajectories.load(path) for path in paths])
    episodes: list[Rows] = []
    logs = [_log(path, said) for path in paths]
    meant = [(said or Columns()).over(log.columns) for log in logs]
    for path, log, here in zip(paths, logs, meant, strict=True):
        _check_same(meant[0], here, paths[0], path)
        _check_columns(here, logs[0], log, paths[0], path)
        for i, table in enumerate(log.tables):
            name = path if path.startswith(PREFIX) else Path(path).name
            source = name if len(log.tables) == 1 else f"{name}, episode {i}"
            episodes += rows_of(table, here, source, Path(path).stem)
    steps, report = at_one_interval(episodes, meant[0])
    if report.altered:
        warnings.warn(report.summary(), SamplingWarning, stacklevel=3)
    data = Trajectories.from_arrays(
        steps.obs, steps.actions, dt=report.dt, conditions=steps.conditions
    )
    return dataclasses.replace(data, origin=np.array(steps.origin), report=report)


def _paths(files: Any) -> list[str]:
    """Every file that is meant, patterns expanded."""
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
        matching = sorted(p for p in glob.glob(path, recursive=True) if Path(p).is_file())
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
    if path.startswith(PREFIX):
        return Log(*read_minari(path.removeprefix(PREFIX)))
    if said is None and Path(path).suffix in READERS and Path(path).suffix != recording.SUFFIX:
        raise TrajectoryError(
            f"'{path}' cannot be read without columns: files that end in {_SUFFIX} can, not those "
            f"that end in '{Path(path).suffix}'. "
            f"{WITHOUT_COLUMNS}"
        )
    return read_log(Path(path), frozenset() if said is None else said.wanted)


def _check_columns(columns: Columns, first: Log, here: Log, first_path: str, path: str) -> None:
    ours, theirs = set(first.tables[0]), set(here.tables[0])
    lacking = sorted((columns.wanted & ours) - theirs)
    if lacking:
        raise TrajectoryError(
            f"The files have different columns: '{first_path}' has '{lacking[0]}', '{path}' has "
            f"not; it has: {', '.join(here.tables[0])}. Load them with a map of columns for each, "
            "then join them: Trajectories.concatenate."
        )


def _check_same(first: Columns, here: Columns, first_path: str, path: str) -> None:
    """Recordings say their own channels; those of all files must be the same."""
    for name in ("obs", "actions"):
        ours, theirs = ([e.name for e in getattr(c, name) or ()] for c in (first, here))
        if ours != theirs:
            raise TrajectoryError(
                f"All files must have the same {name}, but '{first_path}' has {ours} and '{path}' "
                f"has {theirs}. Choose those that they share by columns."
            )
    if first.dt != here.dt:
        raise TrajectoryError(
            f"'{first_path}' is sampled every {first.dt} s and '{path}' every {here.dt} s. "
            "Say which interval you want: columns={'dt': SECONDS}."
        )
