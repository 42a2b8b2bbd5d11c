"""Bags of ROS 1 and ROS 2, as rosbags reads them."""

import contextlib
import itertools
import re
from array import array
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sb3_hds.data.columns import Columns, Entry
from sb3_hds.data.reading.log import Log, library_errors
from sb3_hds.data.wording import listed
from sb3_hds.errors import TrajectoryError

_GAP = 5.0  # intervals
_MAX_OVERTAKING = 1_000_000_000  # [ns]: by which messages may arrive out of order
_STORAGE = (".db3", ".mcap")
_REMEDY = "Repair an interrupted recording with 'ros2 bag reindex' or 'rosbag reindex'."
_TIME = Entry("time", "time")
_RECEIVED, _STAMP = "received", "header.stamp"
_NAMES = ("name", "names", "joint_names")  # fields that name the entries of other fields
_MAX_LISTED = 64  # entries of an array that are listed: longer arrays are images or scans
_SAMPLE_MESSAGES = 50  # from which the names of columns are taken
_TOKEN = re.compile(r"\[([^\]]*)\]|([^.\[\]]+)")


def is_bag(path: Path) -> bool:
    """:return: whether a folder is one of rosbag2, with its metadata or without"""
    return path.is_dir() and bool(_storage_files(path))


def read_bag(path: Path, columns: Columns) -> Log:
    """
    Columns are fields of topics, such as ``/joint_states:position[0]`` or
    ``/joint_states:position[elbow]``.

    Rows are the messages of one topic: that of ``time``, as ``/joint_states:header.stamp`` or
    ``/joint_states:received``, or else that of the first observation. Observations of other topics
    are interpolated linearly, actions and labels are held. All topics use one clock: their header
    stamps if every topic that is used has them, otherwise the time of recording.

    :param path: of a ``.bag``, ``.db3`` or ``.mcap`` file, or of a folder with the latter two
    :param columns: for the wanted names and their kind
    :raises TrajectoryError: if rosbags is not installed, a message is of an unknown type, or topics
        have no clock in common
    """
    wanted = sorted(columns.wanted - {_TIME.name})
    with _open_bag(path) as bag:
        if not wanted:
            topics = _read(bag, _all_columns(bag), path)
            return Log([{k: v for t in topics.values() for k, v in t.columns().items()}])
        in_bag = {connection.topic for connection in bag.connections}
        known = {name.partition(":")[0] for name in wanted} <= in_bag
        topics = _read(bag, wanted, path) if known else {}
        if not known or any(topic.lacks_field for topic in topics.values()):
            names = [*_all_columns(bag), "time"]
            return Log([dict.fromkeys(names, np.zeros(0))], Columns(time=(_TIME,)))
    return _log_at_stamps(topics, columns, path)


class _Topic:
    """
    Some fields of all messages of a topic.

    :param name: of the topic
    :param fields: such as ``position[elbow]``
    """

    def __init__(self, name: str, fields: Iterable[str]) -> None:
        self.name = name
        self.received, self.header = array("q"), array("q")
        self._paths = {field: _TOKEN.findall(field) for field in fields}
        self._values: dict[str, Any] = {}
        self._at: dict[str, array[int]] = {field: array("q") for field in self._paths}
        # Arrays whose entries are selected by number -> the names of the entries.
        self._numbered: dict[str, list[str] | None] = {
            field[: token.start()]: None
            for field in self._paths
            for token in _TOKEN.finditer(field)
            if (token[1] or "").isdigit()
        }

    def add(self, message: Any, received: int) -> None:
        """
        :param message: whose fields are stored, unless it lacks them
        :param received: time of recording [ns]
        """
        number = len(self.received)
        self.received.append(received)
        stamp = _field_value(message, [("", "header"), ("", "stamp")])
        self.header.append(stamp if isinstance(stamp, int) else 0)
        for field, path in self._paths.items():
            value = received if field == _RECEIVED else _field_value(message, path)
            if value is None:
                continue
            if field not in self._values:
                self._values[field] = [] if isinstance(value, str) else array("d")
            self._values[field].append(value)
            self._at[field].append(number)
        for field, first in self._numbered.items():
            names = _entry_names(message, [*_TOKEN.findall(field), ("0", "")])
            if first is None:
                self._numbered[field] = names
            elif names != first:
                raise TrajectoryError(
                    f"The names in '{self.name}' change from message to message, so entries have "
                    f"no fixed number. Select them by name, as {self.name}:{field}[{names[0]}]. "
                    f"Names: {listed(dict.fromkeys([*first, *names]))}."
                )

    @property
    def lacks_field(self) -> bool:
        """Whether no message has one of the fields."""
        return not all(at or field == _STAMP for field, at in self._at.items())

    def stamps(self, clock: str) -> np.ndarray:
        """:return: of all messages [ns]"""
        return np.array(self.header if clock == _STAMP else self.received, np.int64)

    def series(self, field: str, clock: str) -> tuple[np.ndarray, np.ndarray]:
        """:return: stamps [ns] and values of a field, in the messages that have it"""
        at = np.array(self._at[field], np.int64)
        return self.stamps(clock)[at], np.array(self._values.get(field, ()))

    def columns(self) -> dict[str, np.ndarray]:
        """:return: all fields by their full names; times in seconds from the first message"""
        found = {f"{self.name}:{field}": np.array(v) for field, v in self._values.items()}
        for field in {_STAMP, _RECEIVED} & self._values.keys():
            stamps = self.stamps(field)
            found[f"{self.name}:{field}"] = 1e-9 * (stamps - stamps[0])
        return found


def _log_at_stamps(topics: Mapping[str, _Topic], columns: Columns, path: Path) -> Log:
    """All columns at the stamps of one topic."""
    time_field = [
        entry.column for entry in columns.time or () if entry.column not in (None, "time")
    ]
    observed = [entry.column or "" for entry in columns.obs or () if entry.column]
    every = [*time_field, *observed, *sorted(columns.wanted - {_TIME.name})]
    leading, _, first = str(every[0]).partition(":")
    clock = _clock(topics, first if time_field else "", leading, path)
    series = {
        f"{topic.name}:{field}": topic.series(field, clock)
        for topic in topics.values()
        for field in topic._paths
        if field not in (_STAMP, _RECEIVED)
    }
    main = f"{leading}:{first}"
    stamps = series[main][0] if main in series else topics[leading].stamps(clock)
    # Sort messages that arrived out of order, but keep the jump of a clock that was set back.
    if np.diff(stamps).min(initial=0) > -_MAX_OVERTAKING:
        stamps = np.sort(stamps)
    entries = {entry.column: entry for entry in columns.obs or ()}
    table, done = _align(series, stamps, entries, columns.gap)
    left = table.pop("")
    if not len(left):
        others = listed(sorted(set(topics) - {leading}))
        raise TrajectoryError(
            f"'{path}': no message of '{leading}' is between messages of {others} without a gap. "
            "Record them at the same time, or set the longest gap: gap: SECONDS."
        )
    for name in (f"{leading}:{_STAMP}", f"{leading}:{_RECEIVED}", "time"):
        table[name] = 1e-9 * (left - stamps[0])
    which = "header stamps" if clock == _STAMP else "times of recording"
    note = f"At the {which} of '{leading}', {' and '.join(done)}."
    return Log([table], Columns(time=(_TIME,)), notes=(note,) if done else ())


def _align(
    series: Mapping[str, tuple[np.ndarray, np.ndarray]],
    stamps: np.ndarray,
    observed: Mapping[str | None, Entry],
    gap: float | None,
) -> tuple[dict[str, np.ndarray], tuple[str, ...]]:
    """
    All series at given stamps: observations interpolated linearly, actions and labels held.

    Rows before the first value of a series are dropped, and so are those where an observation
    would have to be interpolated across a gap, or beyond its last value.

    :param series: stamps of the values [ns], and the values, by name
    :param stamps: of the rows [ns]
    :param observed: the observation channels among them; angles are interpolated the shorter way
    :param gap: a longer time between two values is a gap [s]; default: five intervals
    :return: columns by name, the stamps of their rows as ``""``; and phrases for the report
    """
    kept = np.ones(len(stamps), bool)
    columns: dict[str, np.ndarray] = {}
    done: dict[str, list[str]] = {"interpolated": [], "held": []}
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
            done["held"].append(name)
            continue
        columns[name] = _interpolated(times, values, stamps, observed[name])
        after = np.minimum(np.searchsorted(times, stamps, side="left"), len(times) - 1)
        interval = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
        longest = 1e9 * gap if gap else _GAP * interval
        kept &= (stamps <= times[-1]) & (times[after] - times[np.maximum(before, 0)] <= longest)
        done["interpolated"].append(name)
    columns[""] = stamps
    words = tuple(f"{listed(names)} {word}" for word, names in done.items() if names)
    return {name: column[kept] for name, column in columns.items()}, words


def _interpolated(
    times: np.ndarray, values: np.ndarray, stamps: np.ndarray, entry: Entry
) -> np.ndarray:
    values = values.astype(float)
    turn = 2.0 * np.pi / entry.factor if entry.angle and entry.factor else None
    if turn:
        values = np.unwrap(values, period=abs(turn))
    # A double cannot represent nanoseconds since 1970 exactly.
    begin = times[0]
    at = np.interp((stamps - begin).astype(float), (times - begin).astype(float), values)
    return (at + 0.5 * turn) % turn - 0.5 * turn if turn else at


def _clock(topics: Mapping[str, _Topic], time_field: str, leading: str, path: Path) -> str:
    """The clock that all topics use: header stamps or times of recording."""
    without = [t.name for t in topics.values() if not any(t.header)]
    if time_field == _STAMP and without:
        raise TrajectoryError(
            f"'{path}': {listed(without)} has no header stamps. Use the time of recording: "
            f"time: '{leading}:{_RECEIVED}'."
        )
    if time_field not in ("", _STAMP, _RECEIVED) and len(topics) > 1:
        raise TrajectoryError(
            f"'{path}': several topics need a common clock, which '{leading}:{time_field}' is not. "
            f"Use time: '{leading}:{_STAMP}' or time: '{leading}:{_RECEIVED}'."
        )
    return time_field if time_field in (_STAMP, _RECEIVED) else _RECEIVED if without else _STAMP


@contextlib.contextmanager
def _open_bag(path: Path) -> Iterator[Any]:
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise TrajectoryError(
            f"'{path}': bags are read by rosbags, which is not installed. Install it: "
            "pip install sb3-hds[ros]."
        ) from error
    # Bags before ROS 2 Iron do not contain the definitions of their messages.
    known = get_typestore(Stores.ROS2_HUMBLE)
    with (
        library_errors(path, _REMEDY),
        AnyReader(_storage_files(path), default_typestore=known) as bag,
    ):
        yield bag


def _storage_files(path: Path) -> list[Path]:
    if not path.is_dir() or (path / "metadata.yaml").is_file():
        return [path]
    return sorted(file for file in path.iterdir() if file.suffix in _STORAGE)


def _messages(bag: Any, topic: str) -> Iterator[tuple[Any, int]]:
    connections = [connection for connection in bag.connections if connection.topic == topic]
    for connection, received, raw in bag.messages(connections=connections):
        try:
            yield bag.deserialize(raw, connection.msgtype), received
        except KeyError as error:
            raise TrajectoryError(
                f"Messages of '{topic}' are of the type {connection.msgtype}, which this bag does "
                "not define. Record it with ROS 2 Iron or later, whose bags contain them."
            ) from error


def _read(bag: Any, names: Iterable[str], path: Path) -> dict[str, _Topic]:
    """The topics of these columns, with the fields that the columns name."""
    fields: dict[str, list[str]] = {}
    for name in names:
        topic, _, field = name.partition(":")
        fields.setdefault(topic, []).append(field)
    topics = {name: _Topic(name, of_topic) for name, of_topic in fields.items()}
    for name, topic in topics.items():
        for message, received in _messages(bag, name):
            topic.add(message, received)
        if not topic.received:
            raise TrajectoryError(f"'{path}' has no message of '{name}'.")
    return topics


def _field_value(message: Any, path: Sequence[tuple[str, str]]) -> Any:
    """A number, a text, or a time [ns]; None if the message has no such field."""
    value = message
    for place, (index, name) in enumerate(path):
        if name:
            value = getattr(value, name, None)
        elif hasattr(value, "__len__"):
            names = [] if index.isdigit() else _entry_names(message, path[: place + 1])
            at = int(index) if index.isdigit() else names.index(index) if index in names else -1
            value = value[at] if 0 <= at < len(value) else None
        elif index != "0":  # a scalar is its own first entry
            return None
        if value is None:
            return None
    if hasattr(value, "sec") and hasattr(value, "nanosec"):
        return int(value.sec) * 1_000_000_000 + int(value.nanosec)
    if isinstance(value, np.ndarray) and value.size == 1:
        return value.ravel()[0]
    return value if isinstance(value, str | bool | int | float | np.generic) else None


def _entry_names(message: Any, path: Sequence[tuple[str, str]]) -> list[str]:
    """Names of the entries of an array, from the innermost part of the message with names."""
    owners = [message]
    for _, name in path[:-1]:
        owner = getattr(owners[-1], name, None) if name else None
        if owner is None:
            break
        owners.append(owner)
    for owner in reversed(owners):
        for field in _NAMES:
            names = getattr(owner, field, None)
            if isinstance(names, list) and names and isinstance(names[0], str):
                return names
    return []


def _all_columns(bag: Any) -> list[str]:
    """Names of all columns, from the first messages of each topic."""
    found: dict[str, None] = {}
    for topic in dict.fromkeys(connection.topic for connection in bag.connections):
        with contextlib.suppress(TrajectoryError):
            for message, _ in itertools.islice(_messages(bag, topic), _SAMPLE_MESSAGES):
                leaves = [_RECEIVED, *_fields_in(message, message, "")]
                found |= dict.fromkeys(f"{topic}:{field}" for field in leaves)
    return list(found)


def _fields_in(message: Any, root: Any, prefix: str) -> Iterator[str]:
    for field in getattr(message, "__dataclass_fields__", ()):
        value, name = getattr(message, field), f"{prefix}{field}"
        if field.startswith("__"):
            continue
        if hasattr(value, "nanosec") or isinstance(value, str | bool | int | float | np.generic):
            yield name
        elif isinstance(value, np.ndarray) and len(value) <= _MAX_LISTED:
            names = _entry_names(root, _TOKEN.findall(f"{name}[0]"))
            each = names if len(names) == len(value) else range(len(value))
            yield from (f"{name}[{index}]" for index in each)
        elif isinstance(value, list) and len(value) <= _MAX_LISTED:
            for i, part in enumerate(value):
                yield from _fields_in(part, root, f"{name}[{i}].")
        else:
            yield from _fields_in(value, root, f"{name}.")
