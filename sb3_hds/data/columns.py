"""The map of columns: what the columns of a log mean, as a dict or a yml file."""

import dataclasses
import math
import os
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from sb3_hds.core.trajectories.episodes import check_dt
from sb3_hds.data.conversion import KNOWN, TIMES, Unit, unit_of
from sb3_hds.errors import TrajectoryError, did_you_mean

FORM = (
    "columns maps what a log holds: {'time': NAME, 'obs': [{'column': NAME, 'unit': 'deg'}, ...], "
    "'actions': [{'column': NAME}, ...]}, or is the path of a yml file with such a map."
)


class Entry(NamedTuple):
    """
    One channel: ``factor * column + offset``, or ``offset`` alone if it was not recorded.

    :param name: of the channel; default: that of its column
    :param column: in the log; None for a constant channel
    :param scale: applied to the column in addition to the factor of its unit
    :param offset: added after scaling, in the unit of the twin
    :param angle: whether the result wraps to [-pi, pi) [rad], so that it is interpolated the
        shorter way
    :param unit: of the scaled column, such as ``"deg"``: it is converted to the SI unit. Empty if
        ``scale`` converts to the unit of the twin; None if undeclared: the file's own unit applies
    """

    name: str
    column: str | None
    scale: float = 1.0
    offset: float = 0.0
    angle: bool = False
    unit: str | None = None

    @property
    def factor(self) -> float:
        """Factor from the column to the unit of the twin."""
        unit = unit_of(self.unit) if self.unit else None
        return self.scale * (unit.factor if unit else 1.0)

    @property
    def si_unit(self) -> str:
        """Unit of the channel; empty if unknown."""
        unit = unit_of(self.unit) if self.unit else None
        return unit.name if unit else ""


class Label(NamedTuple):
    """
    The source of a trajectory's label.

    :param column: in the log; None: the file name without folder and suffix
    """

    column: str | None


@dataclasses.dataclass(frozen=True)
class Columns:
    """
    What the columns of a log mean.

    :param obs: observation channels, in the order of the twin; None: as declared in the file
    :param actions: action channels, in the order of the twin; None: as declared in the file
    :param time: stamps, scaled to seconds; the sum of several columns if seconds and nanoseconds
        are separate; None if rows are exactly ``dt`` apart
    :param condition: source of the label; default: all trajectories have the same label
    :param episode: column whose value changes at the start of an episode
    :param dt: sampling interval of the result [s]; default: that of the log
    :param gap: a longer time between two rows ends the episode [s]; default: five intervals
    :param records: path to the rows in a nested file, such as ``"data"`` or ``"run.rows"``
    :param skip: number of lines of a text file before the names, or before the first row
    """

    obs: tuple[Entry, ...] | None = None
    actions: tuple[Entry, ...] | None = None
    time: tuple[Entry, ...] | None = None
    condition: Label | None = None
    episode: str | None = None
    dt: float | None = None
    gap: float | None = None
    records: str | None = None
    skip: int | None = None

    @property
    def wanted(self) -> frozenset[str]:
        """Names of all columns that are read."""
        entries = [*(self.obs or ()), *(self.actions or ()), *(self.time or ())]
        labels = [self.condition.column] if self.condition else []
        names = [*(entry.column for entry in entries), *labels, self.episode]
        return frozenset(name for name in names if name is not None)

    def completed_by(self, other: "Columns") -> "Columns":
        """:return: these columns, with missing fields taken from the others"""
        names = [field.name for field in dataclasses.fields(self)]
        missing = {name: getattr(other, name) for name in names if getattr(self, name) is None}
        return dataclasses.replace(self, **missing)

    def over(self, own: "Columns | None") -> "Columns":
        """
        :param own: columns that the file itself declares
        :return: these columns, completed by those of the file
        :raises TrajectoryError: if neither declares observations or actions
        """
        merged = self.completed_by(own or Columns())
        missing = [name for name in ("obs", "actions") if getattr(merged, name) is None]
        if missing:
            raise TrajectoryError(f"columns does not name the {missing[0]}. {FORM}")
        if merged.time is None and merged.dt is None:
            raise TrajectoryError(
                "columns must name the column of time stamps, as time: NAME, or give the interval "
                "between rows, as dt: SECONDS."
            )
        return merged

    def in_units(self, units: Mapping[str, str]) -> "Columns":
        """
        :param units: of columns, as a file declares them
        :return: the map with these units, if known, for entries without a unit
        """

        def completed(entry: Entry, time: bool = False) -> Entry:
            declared = units.get(entry.column or "", "")
            unit = unit_of(declared) if declared and entry.unit is None else None
            fits = unit is not None and (unit.name == "s" if time else unit.name)
            return entry._replace(unit=declared) if fits else entry

        return dataclasses.replace(
            self,
            obs=self.obs and tuple(completed(entry) for entry in self.obs),
            actions=self.actions and tuple(completed(entry) for entry in self.actions),
            time=self.time and tuple(completed(entry, time=True) for entry in self.time),
        )


def columns_from(source: Any) -> Columns:
    """
    :param source: a dict as in the guide, the path of a yml file with one, or ``Columns``
    :raises TrajectoryError: if it cannot be read, or for an unknown key or an invalid value
    """
    if isinstance(source, Columns):
        return source
    where = "columns"
    if isinstance(source, str | os.PathLike):
        where = f"'{source}'"
        source = _read_yml(Path(source).expanduser())
    if not isinstance(source, Mapping):
        raise TrajectoryError(f"{where} contains a {type(source).__name__}. {FORM}")
    _check_keys(where, source, list(_PARSERS))
    return Columns(
        **{
            key: parse(f"{where}: {key}", source[key])
            for key, parse in _PARSERS.items()
            if source.get(key) is not None
        }
    )


def _read_yml(path: Path) -> Any:
    try:
        return yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise TrajectoryError(
            f"The columns file '{path}' could not be read: {error.strerror} (in {Path.cwd()})."
        ) from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        reason = " ".join(str(error).split())
        raise TrajectoryError(
            f"The columns file '{path}' is not valid yml: {reason}. Names with a bracket, a comma "
            "or a percent sign need quotes: {column: 'x[0]'}."
        ) from error


def _check_keys(where: str, given: Mapping[Any, Any], known: Sequence[str]) -> None:
    for key in given:
        if key not in known:
            raise TrajectoryError(
                f"{where} has the unknown key '{key}'. "
                f"Known keys: {', '.join(known)}.{did_you_mean(str(key), known)}"
            )


def _entries(where: str, given: Any) -> tuple[Entry, ...]:
    if isinstance(given, str | Mapping) or not isinstance(given, Iterable):
        raise TrajectoryError(f"{where} must be a list of columns, got {given!r}. {FORM}")
    key = where.rpartition(": ")[-1]
    entries = tuple(_entry(f"{where}[{i}]", item, f"{key}[{i}]") for i, item in enumerate(given))
    twice = [name for name, n in Counter(entry.name for entry in entries).items() if n > 1]
    if twice:
        raise TrajectoryError(
            f"{where}: two channels are called '{twice[0]}'. Rename one of them: "
            "{column: NAME, name: OTHER}."
        )
    if key == "obs" and not entries:
        raise TrajectoryError(f"{where} must name at least one column. {FORM}")
    return entries


def _entry(where: str, given: Any, name_of_constant: str = "") -> Entry:
    if not isinstance(given, Mapping):
        name = _column_name(where, given)
        return Entry(name, name)
    keys = ("column", "unit", "scale", "offset", "angle", "constant", "name")
    _check_keys(where, given, keys)
    if ("column" in given) == ("constant" in given and bool(name_of_constant)):
        raise TrajectoryError(
            f"{where} needs either 'column' (its name in the log) or 'constant' (a value that was "
            f"not recorded), got {dict(given)}."
        )
    unit = _unit(where, given)
    if "constant" in given:
        value = _number(f"{where}: constant", given["constant"]) * (unit.factor if unit else 1.0)
        name = str(given.get("name", name_of_constant))
        return Entry(name, None, offset=value, unit=unit and unit.name)
    column = _column_name(where, given["column"])
    return Entry(
        str(given.get("name", column)),
        column,
        _number(f"{where}: scale", given.get("scale", 1.0)),
        _number(f"{where}: offset", given.get("offset", 0.0)),
        bool(given.get("angle", False)),
        str(given["unit"]) if unit else "" if "scale" in given else None,
    )


def _unit(where: str, given: Mapping[str, Any]) -> Unit | None:
    if given.get("unit") is None:
        return None
    unit = unit_of(str(given["unit"]))
    if unit is None:
        raise TrajectoryError(
            f"{where}: unknown unit '{given['unit']}'. Known are {KNOWN}, and their products and "
            "quotients, as 'deg/s' or 'N mm'. For another unit, give the factor to the unit of the "
            "twin: scale: NUMBER."
        )
    if not unit.name and "scale" not in given:
        raise TrajectoryError(
            f"{where}: {given['unit']} need a scale. Give the size of one, in the unit of the "
            "twin: scale: NUMBER."
        )
    if given.get("angle") and unit.name not in ("rad", ""):
        raise TrajectoryError(
            f"{where}: an angle must be in rad, deg or turns, got '{given['unit']}'. Remove "
            "angle: true, or correct the unit."
        )
    return unit


def _time(where: str, given: Any) -> tuple[Entry, ...]:
    several = isinstance(given, Sequence) and not isinstance(given, str)
    if several and not given:
        raise TrajectoryError(f"{where} is an empty list. Name a column, or leave it out.")
    entries = tuple(_entry(where, item) for item in (given if several else [given]))
    for entry in entries:
        if entry.unit and entry.si_unit not in ("s", ""):
            raise TrajectoryError(
                f"{where} must be in one of {', '.join(TIMES)}, got unit: '{entry.unit}'."
            )
    return entries


def _skip(where: str, given: Any) -> int:
    if isinstance(given, int) and not isinstance(given, bool) and given >= 0:
        return given
    raise TrajectoryError(
        f"{where} must be the number of lines before the names, or before the first row, "
        f"got {given!r}."
    )


def _condition(where: str, given: Any) -> Label:
    if isinstance(given, Mapping):
        _check_keys(where, given, ("column", "from"))
        if given == {"from": "filename"}:
            return Label(None)
        if set(given) == {"column"}:
            return Label(_column_name(where, given["column"]))
    raise TrajectoryError(f"{where} must be {{column: NAME}} or {{from: filename}}, got {given!r}.")


def _episode(where: str, given: Any) -> str:
    if isinstance(given, Mapping):
        _check_keys(where, given, ("column",))
        given = given.get("column")
    return _column_name(where, given)


def _column_name(where: str, given: Any) -> str:
    if isinstance(given, bool) or not isinstance(given, str | int | float):
        raise TrajectoryError(
            f"{where} must be the name of a column, got {given!r}. "
            "Names with another meaning in yml (on, off, yes, no) need quotes."
        )
    return str(given)


def _number(where: str, given: Any) -> float:
    try:
        value = math.nan if isinstance(given, bool) else float(given)
    except (TypeError, ValueError):
        value = math.nan
    if not math.isfinite(value):
        raise TrajectoryError(f"{where} must be a finite number, got {given!r}.")
    return value


_PARSERS: dict[str, Callable[[str, Any], Any]] = {
    "obs": _entries,
    "actions": _entries,
    "time": _time,
    "condition": _condition,
    "episode": _episode,
    "records": lambda _, given: str(given),
    "skip": _skip,
    "dt": lambda _, given: check_dt(given),
    "gap": lambda _, given: check_dt(given),
}
