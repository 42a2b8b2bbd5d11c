"""Signals that were sampled at different times, at the times of one of them."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Int64

from sb3_hds.data.columns import Entry
from sb3_hds.data.reading.log import listed

_GAP = 5.0  # intervals
_LATE = 1_000_000_000  # [ns]: messages overtake each other by less than this


class Series(NamedTuple):
    """
    :param stamps: when each was measured [ns]
    :param values: numbers, or texts
    """

    stamps: Int64[np.ndarray, " n"]
    values: np.ndarray


def in_order(stamps: np.ndarray) -> np.ndarray:
    """
    :param stamps: of messages in the order in which they arrived [ns]
    :return: sorted, if they only overtook each other; a clock that was set back stays as it is
    """
    back = np.diff(stamps, prepend=stamps[:1])
    return np.sort(stamps) if back.min(initial=0) > -_LATE else stamps


def aligned(
    series: Mapping[str, Series],
    stamps: np.ndarray,
    observed: Mapping[str | None, Entry],
    gap: float | None,
) -> tuple[dict[str, np.ndarray], tuple[str, ...]]:
    """
    Everything at given stamps: observations interpolated linearly, actions and labels held.

    Rows before the first value of a signal are left out, and so are those where an observation
    would have to be interpolated across a gap, or beyond its last value.

    :param series: by name
    :param stamps: of the rows [ns]
    :param observed: the observation channels among them; an angle turns the shorter way
    :param gap: a longer time between two values is a gap [s]; default: five intervals
    :return: columns by name, the stamps of their rows as ``""``; and what was done, in words
    """
    kept = np.ones(len(stamps), bool)
    columns: dict[str, np.ndarray] = {}
    interpolated, held = list[str](), list[str]()
    for name, (times, values) in series.items():
        order = np.argsort(times, kind="stable")
        times, values = times[order], values[order]
        if np.array_equal(times, stamps):
            columns[name] = values
            continue
        before = np.searchsorted(times, stamps, side="right") - 1
        kept &= before >= 0
        if name not in observed or values.dtype.kind not in "fiub":
            columns[name] = values[np.maximum(before, 0)]
            held.append(name)
            continue
        columns[name] = _interpolated(times, values, stamps, observed[name])
        after = np.minimum(np.searchsorted(times, stamps, side="left"), len(times) - 1)
        usual = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
        longest = 1e9 * gap if gap else _GAP * usual
        kept &= (stamps <= times[-1]) & (times[after] - times[np.maximum(before, 0)] <= longest)
        interpolated.append(name)
    columns[""] = stamps
    done = ((interpolated, "interpolated"), (held, "held"))
    words = tuple(f"{listed(names)} {word}" for names, word in done if names)
    return {name: column[kept] for name, column in columns.items()}, words


def _interpolated(
    times: np.ndarray, values: np.ndarray, stamps: np.ndarray, entry: Entry
) -> np.ndarray:
    values = values.astype(float)
    if entry.angle and entry.factor:
        values = np.unwrap(values * entry.factor) / entry.factor
    # Nanoseconds since 1970 do not fit into a double.
    begin = times[0]
    at = np.interp((stamps - begin).astype(float), (times - begin).astype(float), values)
    if entry.angle and entry.factor:
        turn = 2.0 * np.pi / entry.factor
        at = (at + 0.5 * turn) % turn - 0.5 * turn
    return at
