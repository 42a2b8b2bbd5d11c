"""Nested files as tables: objects of JSON, groups of HDF5, structs and cells of MATLAB."""

import itertools
import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from sb3_hds.data.columns import Columns
from sb3_hds.data.reading.log import Table, aliases, base_of, columns_of
from sb3_hds.data.wording import listed
from sb3_hds.errors import TrajectoryError

_EPISODES = re.compile(
    r"(episodes?|demos?|runs?|traj|trajector(y|ies)|trials?|tests?|experiments?|recordings?|"
    r"rollouts?|sequences?)?[_\- ]?\d+",
    re.IGNORECASE,
)
"""Names of groups that are one episode each."""


class Cells(list[Any]):
    """One array for each episode."""


class Stored(NamedTuple):
    """
    An array that is still in its file.

    :param shape: of the array
    :param read: returns it
    """

    shape: tuple[int, ...]
    read: Callable[[], np.ndarray]


class _Search(NamedTuple):
    """
    :param source: for messages
    :param wanted: names of columns; empty for all
    :param time: those of stamps
    :param separator: between the names of a group and of what is in it
    """

    source: str
    wanted: frozenset[str]
    time: frozenset[str | None]
    separator: str

    def uses(self, name: str) -> bool:
        """Whether anything in there is wanted."""
        begins = (name + self.separator, name + "[")
        every = not self.wanted or not name
        return every or any(w == name or w.startswith(begins) for w in self.wanted)


def tables_of(root: Any, columns: Columns, source: str, separator: str = ".") -> list[Table]:
    """
    The tables of a tree, one for each episode.

    A list of objects of numbers is a table of records, a list of objects of lists holds an episode
    in each; so do groups that are called ``demo_0``, ``demo_1``, or that ``records`` leads to.
    Values beside them hold for all rows. Column ``q`` of group ``arm`` is called ``arm.q``.

    :param root: dicts, lists of dicts, ``Cells``, arrays and ``Stored`` ones
    :param columns: for ``records`` and for what is wanted
    :param source: for messages
    :param separator: between the names of a group and of what is in it
    :raises TrajectoryError: if there is nothing at ``records``, or if episodes do not fit
    """
    time = frozenset(entry.column for entry in columns.time or ())
    search = _Search(source, columns.wanted, time, separator)
    node = root
    if columns.records is not None:
        node = _at(root, columns.records, search)
        if isinstance(node, dict) and node and _alike(list(node.values())):
            node = _in_order(node)
    tables = _tables(node, search)
    names = {name for table in tables for name in table}
    if search.wanted - names - set(aliases(names, search.wanted)):
        tables = _tables(node, search._replace(wanted=frozenset()))
    return tables


def _at(root: Any, records: str, search: _Search) -> Any:
    node = root
    for name in records.strip(search.separator).split(search.separator):
        if not isinstance(node, Mapping) or name not in node:
            inside = listed(node) if isinstance(node, Mapping) else "no names"
            raise TrajectoryError(
                f"'{search.source}' has no '{name}' on the way to records: {records}. There it "
                f"has: {inside}."
            )
        node = node[name]
    return node


def _tables(node: Any, search: _Search) -> list[Table]:
    if isinstance(node, Mapping):
        episodes = _episodes(node, search, "")
        if episodes is None:
            return _tables_of_object(node, search)
        node = episodes
    if isinstance(node, list) and not isinstance(node, Cells):
        if _are_records(node, search):
            return [_records(node)]
        return [table for item in node for table in _tables(item, search)]
    return _tables_of_object({"": node}, search)


def _tables_of_object(node: Mapping[str, Any], search: _Search) -> list[Table]:
    """Arrays are columns, cells and lists of objects are episodes, single values hold for all."""
    arrays, cells, lists = {}, {}, {}
    for name, value in _walk(node, search):
        if isinstance(value, Cells):
            cells[name] = value
        elif isinstance(value, list):
            lists[name] = value
        elif search.uses(name) and len(value.shape) < 4:
            arrays[name] = value.read() if isinstance(value, Stored) else value
    cells |= _split_by_first_axis(arrays)
    plain = _columns(arrays)
    parts = [_tables(value, search) for value in lists.values() if value]
    wanted = [p for p in parts if any(search.wanted & set(table) for table in p)]
    parts = [_tables_of_cells(cells, search), *(wanted or parts)]
    numbers = {len(part) for part in parts if len(part) > 1}
    if len(numbers) > 1:
        raise TrajectoryError(
            f"'{search.source}' holds several lists of episodes of {sorted(numbers)} episodes: "
            f"{listed([*cells, *lists])}. Say where the rows are: records: NAME."
        )
    n = numbers.pop() if numbers else 1
    tables = []
    for i in range(n):
        table = dict(plain)
        for part in filter(None, parts):
            table |= part[i % len(part)]
        tables.append(table)
    return tables


def _walk(node: Mapping[str, Any], search: _Search, prefix: str = "") -> Iterable[tuple[str, Any]]:
    """Everything in an object that is no object itself, with its full name."""
    for key, value in node.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping):
            episodes = _episodes(value, search, name + search.separator)
            if episodes is None:
                yield from _walk(value, search, name + search.separator)
            else:
                yield name, episodes
        else:
            yield name, value


def _episodes(node: Mapping[str, Any], search: _Search, prefix: str) -> list[Any] | None:
    """The groups of a group of episodes, each with what stands beside them; None otherwise."""
    groups = {
        key: value
        for key, value in node.items()
        if isinstance(value, Mapping) and _EPISODES.fullmatch(str(key))
    }
    begins = tuple(f"{prefix}{key}{search.separator}" for key in groups)
    direct = any(name.startswith(begins) for name in search.wanted)
    if not groups or direct or not _alike(list(groups.values())):
        return None
    beside = {key: value for key, value in node.items() if key not in groups}
    return [beside | group for group in _in_order(groups)]


def _alike(parts: Sequence[Any]) -> bool:
    """Whether all are objects with the same names."""
    return all(isinstance(part, Mapping) and part.keys() == parts[0].keys() for part in parts)


def _in_order(node: Mapping[str, Any]) -> list[Any]:
    """Episode 10 comes after episode 9."""

    def number(name: str) -> tuple[str, int]:
        text = re.sub(r"\d+$", "", name)
        return text, int(name[len(text) :][:18] or -1)

    return [node[name] for name in sorted(node, key=number)]


def _columns(arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    lengths = Counter(len(array) for array in arrays.values() if array.ndim == 1)
    rows = next(iter(lengths)) if len(lengths) == 1 else None
    return {k: v for n, array in arrays.items() for k, v in columns_of(n, array, rows).items()}


def _split_by_first_axis(arrays: dict[str, np.ndarray]) -> dict[str, Cells]:
    """Arrays ``(episodes, rows, channels)``, and those beside them, are taken out as cells."""
    shapes = {array.shape[:2] for array in arrays.values() if array.ndim == 3}
    sizes = {n for n, _ in shapes}
    if len(sizes) != 1:
        return {}
    n = sizes.pop()
    vectors = [x for x in arrays.values() if x.ndim == 1 and len(x) == n and x.dtype.kind in "fiu"]
    if vectors and n >= min(rows for _, rows in shapes):
        return {}  # a matrix in each row
    chosen = [name for name, array in arrays.items() if array.ndim and len(array) == n]
    return {name: Cells(arrays.pop(name)) for name in chosen}


def _tables_of_cells(cells: Mapping[str, Cells], search: _Search) -> list[Table]:
    used = {name: cell for name, cell in cells.items() if search.uses(name)}
    numbers = {len(cell) for cell in used.values()}
    if len(numbers) > 1 and search.wanted:
        shown = ", ".join(f"{name} {len(cell)}" for name, cell in sorted(used.items()))
        raise TrajectoryError(
            f"'{search.source}': cell arrays must have the same number of cells, one for each "
            f"episode, got {shown}."
        )
    return [
        _columns({name: _array_in(cell[i]) for name, cell in used.items()})
        for i in range(min(numbers, default=0))
    ]


def _array_in(cell: Any) -> np.ndarray:
    if isinstance(cell, Stored):
        return cell.read()
    if isinstance(cell, list):
        return array_of(cell)
    return np.array(np.nan) if isinstance(cell, Mapping) else np.asarray(cell)


def _are_records(items: Sequence[Any], search: _Search) -> bool:
    """Whether each object is one row, rather than an episode."""
    first = dict(_depths(items[0], search.separator)) if items else {}
    indices = {base_of(name): name.count("[") for name in search.wanted}
    votes = {name: depth - indices[name] for name, (depth, _) in first.items() if name in indices}
    if votes:
        # There is one stamp in each row; an episode may have single values, a row may have lists.
        return max([votes[name] for name in votes if name in search.time] or votes.values()) <= 0
    depths = {depth for depth, _ in first.values()}
    if not depths or max(depths) == 0:
        return True
    lengths = [
        [n for _, (depth, n) in _depths(item, search.separator) if depth] for item in items[:9]
    ]
    return 0 in depths and all(one == lengths[0] for one in lengths) and len(items) > 1


def _depths(item: Any, separator: str, prefix: str = "") -> Iterable[tuple[str, tuple[int, int]]]:
    """Of each number or array in an object: number of axes, and length."""
    for key, value in item.items() if isinstance(item, Mapping) else ():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping):
            yield from _depths(value, separator, name + separator)
        elif isinstance(value, np.ndarray | Stored):
            yield name, (sum(n != 1 for n in value.shape), max(value.shape, default=1))
        elif isinstance(value, list):
            deeper = bool(value) and isinstance(value[0], list | Mapping | np.ndarray | Stored)
            yield name, (1 + deeper, len(value))
        elif isinstance(value, int | float):
            yield name, (0, 1)


def _records(items: Sequence[Mapping[str, Any]], prefix: str = "") -> Table:
    """Rows as columns; a key that a row lacks is not a number there."""
    columns: dict[str, np.ndarray] = {}
    for key in dict.fromkeys(key for item in items for key in item):
        values = [item.get(key) for item in items]
        if any(isinstance(value, Mapping) for value in values):
            inside = [value if isinstance(value, Mapping) else {} for value in values]
            columns |= _records(inside, f"{prefix}{key}.")
        else:
            column = array_of(values)
            columns |= (
                columns_of(f"{prefix}{key}", column, len(items))
                if column.ndim == 2
                else {f"{prefix}{key}": column}
            )
    return columns


def array_of(values: Sequence[Any]) -> np.ndarray:
    """
    :param values: numbers, texts, or lists of numbers of one length; None is not a number
    :return: of one or two axes; of objects where the values do not fit together
    """
    filled = [np.nan if value is None else value for value in values]
    try:
        array = np.array(filled)
    except (ValueError, OverflowError):
        array = np.empty(0, object)
    if array.ndim > 2 or array.dtype == object:
        array = np.empty(len(filled), object)
        array[:] = filled
    return array


def plain_of(value: Any) -> Any:
    """
    :param value: as JSON has it
    :return: dicts, lists of dicts, cells and arrays
    """
    if isinstance(value, dict):
        if value and all(str(k).isdigit() for k in value) and not _nests(value.values()):
            return array_of(list(value.values()))  # a column, as pandas writes it
        return {name: plain_of(part) for name, part in value.items() if part is not None}
    if not isinstance(value, list):
        return np.array(value)
    if value and all(isinstance(item, dict) for item in value):
        flat = not any(_nests(item.values()) for item in value)
        return value if flat else [plain_of(item) for item in value]
    try:
        array = np.array([np.nan if item is None else item for item in value])
    except (ValueError, OverflowError):
        return Cells(map(plain_of, value))
    return array if array.dtype != object else array_of(value)


def _nests(values: Iterable[Any]) -> bool:
    return any(isinstance(value, list | dict) for value in itertools.islice(values, 1000))
