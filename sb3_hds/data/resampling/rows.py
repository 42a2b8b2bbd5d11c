"""The rows of a table as validated channels."""

import itertools
import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int

from sb3_hds.data.columns import Columns, Entry
from sb3_hds.data.reading.log import Table, base_name
from sb3_hds.data.wording import listed
from sb3_hds.errors import TrajectoryError, did_you_mean

_LARGEST_EXACT = 2**53  # larger integers are not exact in double precision


class Rows(NamedTuple):
    """
    Rows of one episode of a log.

    :param source: file and episode, for messages
    :param numbers: of the rows in the file, from 0
    :param times: of measurement [s]; never decreasing
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
        return self._replace(
            numbers=self.numbers[chosen],
            times=self.times[chosen],
            obs=self.obs[chosen],
            actions=self.actions[chosen],
        )


def rows_of(table: Table, columns: Columns, source: str, filename: str) -> list[Rows]:
    """
    :param table: columns of a file, at least those that are used
    :param columns: which of them are used, and for what
    :param source: file and episode, for messages
    :param filename: without folder and suffix, for a label
    :return: one for each episode
    :raises TrajectoryError: if a column is missing, has another length, or is not finite; if time
        decreases within an episode
    """
    n = _length(table, columns, source)
    obs = _matrix(table, columns.obs or (), n, source)
    actions = _matrix(table, columns.actions or (), n, source)
    times = _stamps(table, columns, n, source)
    label = columns.condition
    labels = _labels(table, label.column if label else None, n, filename if label else "default")
    numbers = _labels(table, columns.episode, n, "")
    begins = (labels[1:] != labels[:-1]) | (numbers[1:] != numbers[:-1])
    bounds = [0, *(np.flatnonzero(begins) + 1).tolist(), n]
    found = []
    for i, (a, b) in enumerate(itertools.pairwise(bounds)):
        name = source if len(bounds) == 2 else f"{source}, episode {i}"
        rows = (np.arange(a, b), times[a:b], obs[a:b], actions[a:b])
        found.append(Rows(name, *rows, str(labels[a])))
        _check(found[-1], columns)
    return found


def _length(table: Table, columns: Columns, source: str) -> int:
    """The number of rows, which all columns that are used must have."""
    missing = sorted(columns.wanted - set(table))
    if missing:
        raise TrajectoryError(_missing_message(table, missing, source))
    lengths = {name: len(table[name]) for name in sorted(columns.wanted) if table[name].ndim}
    observed = {entry.column for entry in (*(columns.obs or ()), *(columns.time or ()))}
    commands = {entry.column for entry in columns.actions or ()} - observed
    n = max(lengths.values(), default=0)
    # The last observation may have no action.
    fits = {n, n - 1} if set(lengths) - commands else {n}
    if not lengths or any(x not in (fits if c in commands else {n}) for c, x in lengths.items()):
        shown = ", ".join(f"{name} {n}" for name, n in lengths.items()) or "single values only"
        raise TrajectoryError(f"The columns of '{source}' must have the same length, got {shown}.")
    if n == 0:
        raise TrajectoryError(f"'{source}' has columns but no rows: nothing was logged.")
    return n


def _missing_message(table: Table, missing: Sequence[str], source: str) -> str:
    """The missing columns, and the existing ones."""
    parts = [name for name in table if base_name(name) == missing[0] != name]
    if parts:
        return (
            f"'{source}' contains several numbers of '{missing[0]}' in each row. Name them one by "
            f"one: {listed(parts)}."
        )
    hint = did_you_mean(missing[0], table, cutoff=0.75)
    names = ", ".join(f"'{name}'" for name in missing)
    return f"'{source}' has no column {names}. It has: {listed(table)}.{hint}"


def _matrix(table: Table, entries: Sequence[Entry], n: int, source: str) -> np.ndarray:
    """Channels side by side; shape ``(n, entries)``."""
    matrix = np.empty((n, len(entries)))
    for j, entry in enumerate(entries):
        _fill_channel(matrix[:, j], table, entry, source)
    return matrix


def _fill_channel(channel: np.ndarray, table: Table, entry: Entry, source: str) -> None:
    """One channel, in its unit."""
    if entry.column is None:
        channel[:] = entry.offset
        return
    column = table[entry.column]
    if column.ndim > 1:
        raise TrajectoryError(
            f"Column '{entry.column}' of '{source}' must hold one number in each row, got "
            f"{column.shape[1]}: write each into a column of its own."
        )
    # The last action may be missing, because it is not used.
    rows = len(column) if column.ndim else len(channel)
    channel[rows:] = np.nan
    with np.errstate(over="ignore", invalid="ignore"):
        channel[:rows] = _numbers(column, entry, source)
        channel *= entry.factor
        channel += entry.offset


def _numbers(column: np.ndarray, entry: Entry, source: str) -> np.ndarray:
    if column.dtype.kind in "mM":
        # Dates and durations of any resolution are relative to the first row.
        return (column - column.ravel()[0]) / np.timedelta64(1, "s")
    try:
        return column.astype(np.float64, copy=False)
    except (TypeError, ValueError, OverflowError) as error:
        raise TrajectoryError(
            f"Column '{entry.column}' of '{source}' must hold numbers, got "
            f"{_first_invalid(column)}. {_remedy(column)}"
        ) from error


def _stamps(table: Table, columns: Columns, n: int, source: str) -> np.ndarray:
    """Stamps [s]; large integers, such as nanoseconds since 1970, relative to the first row."""
    if columns.time is None:
        return (columns.dt or np.nan) * np.arange(n)
    times, part = np.zeros(n), np.empty(n)
    for entry in columns.time:
        column = table[entry.column or ""]
        whole = column.ndim == 1 and column.dtype.kind in "iu"
        if whole and (len(columns.time) > 1 or abs(int(column[0])) >= _LARGEST_EXACT):
            column = column.astype(np.int64) - column[:1].astype(np.int64)
        _fill_channel(part, {entry.column or "": column}, entry, source)
        times += part
    return times


def _first_invalid(column: np.ndarray) -> str:
    for row, value in enumerate(column.ravel()):
        try:
            float(value)
        except (TypeError, ValueError, OverflowError):
            return f"{str(value)[:60]!r} in row {row}, counted from 0"
    return f"the type {column.dtype}"


def _remedy(column: np.ndarray) -> str:
    values = [str(value) for value in column.ravel()[:2]]
    if any(re.search(r"\d[-/.:]\d+[-/.:]\d", value) for value in values):
        return "Convert dates and times of day to seconds first."
    return "Correct or delete that row."


def _labels(table: Table, column: str | None, n: int, constant: str) -> np.ndarray:
    if column is None:
        return np.broadcast_to(np.array(constant), n)
    values = table[column]
    if values.dtype.kind == "f":  # 100.0 is the label 100
        values = np.array([f"{value:.12g}" for value in values.ravel()]).reshape(values.shape)
    return np.broadcast_to(values.astype(str), n)


def _check(rows: Rows, columns: Columns) -> None:
    """Numbers must be finite, except for the unused last action; time must not decrease."""
    time = columns.time[0].column if columns.time else "time"
    checked = (
        ([time], rows.times[:, None]),
        ([entry.column for entry in columns.obs or ()], rows.obs),
        ([entry.column for entry in columns.actions or ()], rows.actions[:-1]),
    )
    for names, values in checked:
        bad = np.argwhere(~np.isfinite(values))
        if len(bad):
            row, channel = bad[0]
            raise TrajectoryError(
                f"Column '{names[channel]}' of '{rows.source}' must be finite, "
                f"got {values[row, channel]} in row {rows.numbers[row]}, counted from 0 "
                f"({len(bad)} such values in all). Cut the log before it, or remove those rows: "
                "a gap of up to five intervals is interpolated, a longer one ends the episode "
                "(gap: SECONDS in columns says when)."
            )
    back = np.flatnonzero(np.diff(rows.times) < 0.0)
    if len(back):
        k = int(back[0])
        raise TrajectoryError(
            f"Time decreases in '{rows.source}', from {rows.times[k]:g} to {rows.times[k + 1]:g} s "
            f"at row {rows.numbers[k + 1]}, counted from 0. If a new episode begins there, name "
            "the column that counts episodes: episode: {column: NAME}."
        )
