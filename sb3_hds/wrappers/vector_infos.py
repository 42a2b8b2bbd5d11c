"""What Gymnasium's vectorised environments return, taken apart: one row for each copy."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np


def infos_of(infos: Mapping[str, Any] | Sequence[Mapping[str, Any]], n: int) -> list[dict]:
    """
    :param infos: by name one entry for each copy and, under ``_name``, which copies have it; or
        already one dictionary for each copy (``DictInfoToList``)
    :param n: number of copies
    :return: one dictionary for each copy, with the names that it has
    """
    if not isinstance(infos, Mapping):
        return [dict(info) for info in infos]
    rows: list[dict] = [{} for _ in range(n)]
    for name, value in infos.items():
        if name.startswith("_") and name[1:] in infos:
            continue
        parts: Any = infos_of(value, n) if isinstance(value, Mapping) else _one_each(value, n)
        has_it = infos.get(f"_{name}", np.ones(n, bool))
        for i in np.flatnonzero(has_it).tolist():
            rows[i][name] = parts[i]
    return rows


def obs_of(obs: Any, i: int) -> Any:
    """:return: a copy of what the copy ``i`` observes"""
    if isinstance(obs, Mapping):
        return {name: obs_of(part, i) for name, part in obs.items()}
    return np.array(obs[i])


def copied(obs: Any) -> Any:
    """:return: the same in memory of its own: environments may write into theirs later"""
    if isinstance(obs, Mapping):
        return {name: copied(part) for name, part in obs.items()}
    return np.array(obs)


def same_rows(first: Any, second: Any, rows: np.ndarray) -> bool:
    """:return: whether these copies observe the same in both"""
    if isinstance(first, Mapping):
        return all(same_rows(part, second[name], rows) for name, part in first.items())
    return np.array_equal(np.asarray(first)[rows], np.asarray(second)[rows], equal_nan=True)


def _one_each(value: Any, n: int) -> Any:
    """Entries that do not come one for each copy belong to all of them."""
    each = isinstance(value, np.ndarray | Sequence) and not isinstance(value, str)
    return value if each and len(value) == n else [value] * n
