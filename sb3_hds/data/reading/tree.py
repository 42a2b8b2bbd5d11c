"""Nested files as tables: objects of JSON, groups of HDF5, structs and cells of MATLAB."""

import itertools
import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from sb3_hds.data.columns import Columns
from sb3_hds.data.reading.log import Table, aliases, base_name, split_columns
from sb3_hds.data.wording import listed
from sb3_hds.errors import TrajectoryError

_EPISODES = re.compile(
    r"(episodes?|demos?|runs?|traj|trajector(y|ies)|trials?|tests?|experiments?|recordings?|"
    r"rollouts?|sequences?)?[_\- ]?\d+",
    re.IGNORECASE,
)
"""Names of groups that are episodes."""


class Cells(list[Any]):
    """A list with one array for each episode."""


class Stored(NamedTuple):
    """
    An array that has not been read from its file yet.

    :param shape: of the array
    :param read: reads and returns it
    """

    shape: tuple[int, ...]
    read: Callable[[], np.ndarray]


class _Query(NamedTuple):
    """
    The columns that are searched for in a tree.

    :param source: name of the file, for messages
    :param wanted: names of columns; empty for all
    :param time: names of the columns of stamps
    :param separator: between the names of a group and its members
    """

    source: str
    wanted: frozenset[str]
    time: frozenset[str | None]
    separator: str

    def uses(self, name: str) -> bool:
        """Whether an array or group contains any wanted column."""
        begins = (name + self.separator, name + "[")
        every = not self.wanted or not name
        return every or any(w == name or w.startswith(begins) for w in self.wanted)


def tables_of(root: Any, columns: Columns, source: str, separator: str = ".") -> list[Table]:
    """
    The tables of a tree, one for each episode.

    A list of objects of numbers is a table of records. In a list of objects of lists, each object
    is an episode; so are groups called ``demo_0``, ``demo_1``, or those at ``records``. Values next
    to episodes apply to all rows. Column ``q`` of group ``arm`` is called ``arm.q``.

    :param root: dicts, lists of dicts, ``Cells``, arrays and ``Stored`` arrays
    :param columns: for ``records`` and the wanted names
    :param source: name of the file, for messages
    :param separator: between the names of a group and its members
    :raises TrajectoryError: if ``records`` does not exist, or if numbers of episodes differ
    """
    time = frozenset(entry.column for entry in columns.time or ())
    query = _Query(source, columns.wanted, time, separator)
    node = root
    if columns.records is not None:
        node = _node_at(root, columns.records, query)
        if isinstance(node, dict) and node and _have_same_keys(list(node.values())):
            node = _sorted_by_number(node)
    tables = _tables(node, query)
    names = {name for table in tables for name in table}
    if query.wanted - names - set(aliases(names, query.wanted)):
        tables = _tables(node, query._replace(wanted=frozenset()))
    return tables


def _node_at(root: Any, records: str, query: _Query) -> Any:
    node = root
    for name in records.strip(query.separator).split(query.separator):
        if not isinstance(node, Mapping) or name not in node:
            inside = listed(node) if isinstance(node, Mapping) else "no names"
            raise TrajectoryError(
                f"'{query.source}' has no '{name}' on the path records: {records}. There it has: "
                f"{inside}."
            )
        node = node[name]
    return node


def _tables(node: Any, query: _Query) -> list[Table]:
    if isinstance(node, Mapping):
        episodes = _episodes(node, query, "")
        if episodes is None:
            return _tables_of_object(node, query)
        node = episodes
    if isinstance(node, list) and not isinstance(node, Cells):
        if _are_records(node, query):
            return [_records(node)]
        return [table for item in node for table in _tables(item, query)]
    return _tables_of_object({"": node}, query)


def _tables_of_object(node: Mapping[str, Any], query: _Query) -> list[Table]:
    """Arrays are columns, cells and lists of objects are episodes, scalars apply to all rows."""
    arrays, cells, lists = {}, {}, {}
    for name, value in _leaves(node, query):
        if isinstance(value, Cells):
            cells[name] = value
        elif isinstance(value, list):
            lists[name] = value
        elif query.uses(name) and len(value.shape) < 4:
            arrays[name] = value.read() if isinstance(value, Stored) else value
    cells |= _split_by_first_axis(arrays)
    plain = _columns(arrays)
    parts = [_tables(value, query) for value in lists.values() if value]
    wanted = [p for p in parts if any(query.wanted & set(table) for table in p)]
    parts = [_tables_of_cells(cells, query), *(wanted or parts)]
    numbers = {len(part) for part in parts if len(part) > 1}
    if len(numbers) > 1:
        raise TrajectoryError(
            f"'{query.source}' contains lists of {sorted(numbers)} episodes: "
            f"{listed([*cells, *lists])}. Name the one with the rows: records: NAME."
        )
    n = numbers.pop() if numbers else 1
    tables = []
    for i in range(n):
        table = dict(plain)
        for part in filter(None, parts):
            table |= part[i % len(part)]
        tables.append(table)
    return tables


def _leaves(node: Mapping[str, Any], query: _Query, prefix: str = "") -> Iterable[tuple[str, Any]]:
    """Full names and values of all members of an object that are not objects themselves."""
    for key, value in node.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping):
            episodes = _episodes(value, query, name + query.separator)
            if episodes is None:
                yield from _leaves(value, query, name + query.separator)
            else:
                yield name, episodes
        else:
            yield name, value


def _episodes(node: Mapping[str, Any], query: _Query, prefix: str) -> list[Any] | None:
    """The episodes in a group, each with the values next to them; None if it has no episodes."""
    groups = {
        key: value
        for key, value in node.items()
        if isinstance(value, Mapping) and _EPISODES.fullmatch(str(key))
    }
    begins = tuple(f"{prefix}{key}{query.separator}" for key in groups)
    named_directly = any(name.startswith(begins) for name in query.wanted)
    if not groups or named_directly or not _have_same_keys(list(groups.values())):
        return None
    shared = {key: value for key, value in node.items() if key not in groups}
    return [shared | group for group in _sorted_by_number(groups)]


def _have_same_keys(parts: Sequence[Any]) -> bool:
    """Whether all are objects with the same keys."""
    return all(isinstance(part, Mapping) and part.keys() == parts[0].keys() for part in parts)


def _sorted_by_number(node: Mapping[str, Any]) -> list[Any]:
    """Values sorted by key, with episode 10 after episode 9."""

    def number(name: str) -> tuple[str, int]:
        text = re.sub(r"\d+$", "", name)
        return text, int(name[len(text) :][:18] or -1)

    return [node[name] for name in sorted(node, key=number)]


def _columns(arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    lengths = Counter(len(array) for array in arrays.values() if array.ndim == 1)
    rows = next(iter(lengths)) if len(lengths) == 1 else None
    return {k: v for n, array in arrays.items() for k, v in split_columns(n, array, rows).items()}


def _split_by_first_axis(arrays: dict[str, np.ndarray]) -> dict[str, Cells]:
    """Take arrays ``(episodes, rows, channels)`` and those of equal length out, as cells."""
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


def _tables_of_cells(cells: Mapping[str, Cells], query: _Query) -> list[Table]:
    used = {name: cell for name, cell in cells.items() if query.uses(name)}
    numbers = {len(cell) for cell in used.values()}
    if len(numbers) > 1 and query.wanted:
        shown = ", ".join(f"{name} {len(cell)}" for name, cell in sorted(used.items()))
        raise TrajectoryError(
            f"'{query.source}': cell arrays must have the same number of cells, one for each "
            f"episode, got {shown}."
        )
    return [
        _columns({name: _array_of_cell(cell[i]) for name, cell in used.items()})
        for i in range(min(numbers, default=0))
    ]


def _array_of_cell(cell: Any) -> np.ndarray:
    if isinstance(cell, Stored):
        return cell.read()
    if isinstance(cell, list):
        return to_array(cell)
    return np.array(np.nan) if isinstance(cell, Mapping) else np.asarray(cell)


def _are_records(items: Sequence[Any], query: _Query) -> bool:
    """Whether each object is one row, rather than an episode."""
    first = dict(_shapes(items[0], query.separator)) if items else {}
    indices = {base_name(name): name.count("[") for name in query.wanted}
    votes = {name: depth - indices[name] for name, (depth, _) in first.items() if name in indices}
    if votes:
        # A row has one stamp. Other columns are ambiguous: episodes may have scalars, rows lists.
        return max([votes[name] for name in votes if name in query.time] or votes.values()) <= 0
    depths = {depth for depth, _ in first.values()}
    if not depths or max(depths) == 0:
        return True
    lengths = [
        [n for _, (depth, n) in _shapes(item, query.separator) if depth] for item in items[:9]
    ]
    return 0 in depths and all(one == lengths[0] for one in lengths) and len(items) > 1


def _shapes(item: Any, separator: str, prefix: str = "") -> Iterable[tuple[str, tuple[int, int]]]:
    """Name, number of axes and length of each number or array in an object."""
    for key, value in item.items() if isinstance(item, Mapping) else ():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping):
            yield from _shapes(value, separator, name + separator)
        elif isinstance(value, np.ndarray | Stored):
            yield name, (sum(n != 1 for n in value.shape), max(value.shape, default=1))
        elif isinstance(value, list):
            deeper = bool(value) and isinstance(value[0], list | Mapping | np.ndarray | Stored)
            yield name, (1 + deeper, len(value))
        elif isinstance(value, int | float):
            yield name, (0, 1)


def _records(items: Sequence[Mapping[str, Any]], prefix: str = "") -> Table:
    """Rows as columns; nan where a row lacks a key."""
    columns: dict[str, np.ndarray] = {}
    for key in dict.fromkeys(key for item in items for key in item):
        values = [item.get(key) for item in items]
        if any(isinstance(value, Mapping) for value in values):
            inside = [value if isinstance(value, Mapping) else {} for value in values]
            columns |= _records(inside, f"{prefix}{key}.")
        else:
            column = to_array(values)
            columns |= (
                split_columns(f"{prefix}{key}", column, len(items))
                if column.ndim == 2
                else {f"{prefix}{key}": column}
            )
    return columns


def to_array(values: Sequence[Any]) -> np.ndarray:
    """
    :param values: numbers, texts, or lists of numbers of equal length; None becomes nan
    :return: array of one or two axes; of objects if lengths or types of the values differ
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


def from_json(value: Any) -> Any:
    """
    :param value: parsed JSON
    :return: dicts, lists of dicts, cells and arrays
    """
    if isinstance(value, dict):
        if value and all(str(k).isdigit() for k in value) and not _nests(value.values()):
            return to_array(list(value.values()))  # a column, as pandas writes it
        return {name: from_json(part) for name, part in value.items() if part is not None}
    if not isinstance(value, list):
        return np.array(value)
    if value and all(isinstance(item, dict) for item in value):
        flat = not any(_nests(item.values()) for item in value)
        return value if flat else [from_json(item) for item in value]
    try:
        array = np.array([np.nan if item is None else item for item in value])
    except (ValueError, OverflowError):
        return Cells(map(from_json, value))
    return array if array.dtype != object else to_array(value)


def _nests(values: Iterable[Any]) -> bool:
    return any(isinstance(value, list | dict) for value in itertools.islice(values, 1000))
