"""The rows of a table, in the channels of the result, checked at the door."""

import itertools
import re
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int

from sb3_hds.data.columns import Columns, Entry
from sb3_hds.errors import TrajectoryError, did_you_mean

Table = Mapping[str, np.ndarray]
"""Columns by name, each of shape ``(rows,)``; a value that holds for all rows has shape ``()``."""


class Rows(NamedTuple):
    """
    Rows of one episode of a log.

    :param source: file and episode, for people
    :param numbers: of the rows in the file, from 0
    :param times: when each was measured [s]; never decreasing
    :param obs: shape ``(rows, n_obs)``
    :param actions: the one that acts from each row on; shape ``(rows, n_act)``
    :param condition: label
    """

    source: str
    numbers: Int[np.ndarray, " rows"]
    times: Float64[np.ndarray, " rows"]
    obs: Float64[np.ndarray, "rows n_obs"]
    actions: Float64[np.ndarray, "rows n_act"]
    condition: str

    def part(self, chosen: np.ndarray | slice) -> "Rows":
        """:return: some of the rows"""
        numbers, times = self.numbers[chosen], self.times[chosen]
        obs, actions = self.obs[chosen], self.actions[chosen]
        return Rows(self.source, numbers, times, obs, actions, self.condition)


def rows_of(table: Table, columns: Columns, source: str, filename: str) -> list[Rows]:
    """
    :param table: all columns of a file
    :param columns: which of them are used, and for what
    :param source: where it is from, for messages
    :param filename: without folder and suffix, for a label
    :return: one for each episode
    :raises TrajectoryError: if a column is missing, is of another length, or holds no finite
        numbers; if time decreases within an episode
    """
    n = _length(table, columns, source)
    obs, actions = (
        np.stack([*(_values(table, e, n, source) for e in entries or ()), np.zeros(n)], 1)[:, :-1]
        for entries in (columns.obs, columns.actions)
    )
    if columns.time is not None:
        times = _values(table, columns.time, n, source)
    else:
        times = (columns.dt or np.nan) * np.arange(n)
    said = columns.condition
    labels = _labels(table, said.column if said else None, n, filename if said else "default")
    numbers = _labels(table, columns.episode, n, "")
    begins = (labels[1:] != labels[:-1]) | (numbers[1:] != numbers[:-1])
    bounds = [0, *(np.flatnonzero(begins) + 1).tolist(), n]
    found = []
    for i, (a, b) in enumerate(itertools.pairwise(bounds)):
        name = source if len(bounds) == 2 else f"{source}, episode {i}"
        label = str(labels[a])
        found.append(Rows(name, np.arange(a, b), times[a:b], obs[a:b], actions[a:b], label))
        _check(found[-1], columns)
    return found


def _length(table: Table, columns: Columns, source: str) -> int:
    """Number of rows; all columns that are used must exist and have it."""
    missing = sorted(columns.wanted - set(table))
    if missing:
        hint = did_you_mean(missing[0], table, cutoff=0.75)
        names = ", ".join(f"'{name}'" for name in missing)
        raise TrajectoryError(
            f"'{source}' has no column {names}. It has: {', '.join(table) or 'none'}.{hint}"
        )
    lengths = {name: len(table[name]) for name in sorted(columns.wanted) if table[name].ndim}
    if len(set(lengths.values())) != 1:
        listed = ", ".join(f"{name} {n}" for name, n in lengths.items()) or "single values only"
        raise TrajectoryError(f"The columns of '{source}' must have the same length, got {listed}.")
    n = next(iter(lengths.values()))
    if n == 0:
        raise TrajectoryError(f"'{source}' has names of columns and no row: nothing was logged.")
    return n


def _values(table: Table, entry: Entry, n: int, source: str) -> np.ndarray:
    """One channel, scaled; shape ``(n,)``."""
    if entry.column is None:
        return np.full(n, entry.offset)
    column = table[entry.column]
    if column.ndim > 1:
        raise TrajectoryError(
            f"Column '{entry.column}' of '{source}' must hold one number in each row, got "
            f"{column.shape[1]}: write each into a column of its own."
        )
    if column.dtype.kind in "mM":
        # Dates and durations, of whatever resolution, count from the first row.
        passed = (column - column.ravel()[0]) / np.timedelta64(1, "s")
        return np.broadcast_to(entry.scale * passed + entry.offset, n)
    try:
        numbers = column.astype(np.float64)
    except (TypeError, ValueError) as error:
        raise TrajectoryError(
            f"Column '{entry.column}' of '{source}' must hold numbers, got {_first_text(column)}. "
            f"{_way_out(column)}"
        ) from error
    return np.broadcast_to(entry.scale * numbers + entry.offset, n)


def _first_text(column: np.ndarray) -> str:
    for row, value in enumerate(column.ravel()):
        try:
            float(value)
        except (TypeError, ValueError):
            return f"{value!r} in row {row}, counted from 0"
    return f"the type {column.dtype}"


def _way_out(column: np.ndarray) -> str:
    values = [str(value) for value in column.ravel()[:2]]
    if any(re.search(r"\d[-/.:]\d+[-/.:]\d", value) for value in values):
        return "Convert dates and times of day to seconds before."
    if not all(map(is_number, values[:1])) and all(map(is_number, values[1:])):
        return "If that is the row of units below the names (line 2 of the file), delete it."
    return "Correct it, or delete that row."


def is_number(text: str) -> bool:
    """:return: whether a field of a text file is one"""
    try:
        float(text)
    except ValueError:
        return False
    return True


def _labels(table: Table, column: str | None, n: int, constant: str) -> np.ndarray:
    if column is None:
        return np.full(n, constant)
    values = table[column]
    if values.dtype.kind == "f":  # 100.0 is the label 100
        values = np.array([f"{value:.12g}" for value in values.ravel()]).reshape(values.shape)
    return np.broadcast_to(values.astype(str), n)


def _check(rows: Rows, columns: Columns) -> None:
    """Finite numbers, except for the last action, which acts on nothing; time never decreases."""
    checked = (
        ((columns.time,), rows.times[:, None]),
        (columns.obs or (), rows.obs),
        (columns.actions or (), rows.actions[:-1]),
    )
    for entries, values in checked:
        bad = np.argwhere(~np.isfinite(values))
        if len(bad):
            row, channel = bad[0]
            entry = entries[channel]
            raise TrajectoryError(
                f"Column '{entry.column if entry else 'time'}' of '{rows.source}' must be finite, "
                f"got {values[row, channel]} in row {rows.numbers[row]}, counted from 0 "
                f"({len(bad)} such values in all). Cut the log before it, or leave those rows out: "
                "a gap of up to five intervals is interpolated, a longer one ends the episode "
                "(gap: SECONDS in columns says when)."
            )
    back = np.flatnonzero(np.diff(rows.times) < 0.0)
    if len(back):
        k = int(back[0])
        raise TrajectoryError(
            f"Time decreases in '{rows.source}', from {rows.times[k]:g} to {rows.times[k + 1]:g} s "
            f"at row {rows.numbers[k + 1]}, counted from 0. If a new episode begins there, name "
            "the column that tells: episode: {column: NAME}."
        )
