"""Text: CSV and its relatives, with or without names, units, and decimal points."""

import csv
import itertools
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from sb3_hds.data.columns import Columns
from sb3_hds.data.conversion import unit_of
from sb3_hds.data.reading.log import Log, aliases, library_errors
from sb3_hds.errors import TrajectoryError

_SAMPLE_CHARACTERS = 1 << 18  # from which the layout is inferred
_SAMPLE_LINES = 50  # from which the separator is inferred
_CHUNK_ROWS = 200_000  # read at once
# Files larger than this [bytes] are read three times as fast, to 15 digits instead of 17.
_ROUND_TRIP_BYTES = 50_000_000
_WHITESPACE = r"\s+"
_MISSING = ("", "nan", "na", "n/a", "null", "none", "-nan")
_UNIT_IN_NAME = re.compile(r".*?\s*[\[(]([^\[\]()]*[^\[\]()\d][^\[\]()]*)[\])]")


class _Dialect(NamedTuple):
    """
    :param separator: of the fields of a line
    :param decimal: point or comma
    """

    separator: str
    decimal: str

    def fields(self, line: str) -> list[str]:
        """:return: of one line, without empty ones at its end"""
        if self.separator == _WHITESPACE:
            return line.split()
        read = csv.reader([line], delimiter=self.separator, skipinitialspace=True)
        fields = [field.strip() for field in next(read, [])]
        while fields and not fields[-1]:
            fields.pop()
        return fields

    def is_number(self, field: str) -> bool:
        """:return: whether a field is a number"""
        if self.decimal == ",":
            field = field.replace(".", "?").replace(",", ".")
        try:
            float(field)
        except ValueError:
            return False
        return True

    def is_text(self, field: str) -> bool:
        """:return: whether a field is neither a number nor a missing value"""
        return not self.is_number(field) and field.lower() not in _MISSING


# If several fit a file equally well, the first one is chosen.
_DIALECTS = [
    *(_Dialect(separator, ".") for separator in (",", ";", "\t", _WHITESPACE)),
    *(_Dialect(separator, ",") for separator in (";", "\t", _WHITESPACE)),
]


class _Layout(NamedTuple):
    """
    :param names: of the columns; their numbers if the file has no names
    :param units: of the columns; empty if unknown
    :param n_before: number of lines before the first row
    :param dialect: of the rows
    :param nameless: whether the file has no names
    """

    names: list[str]
    units: list[str]
    n_before: int
    dialect: _Dialect
    nameless: bool


def read_text(path: Path, columns: Columns) -> Log:
    """
    A line of names, then rows; separated by commas, semicolons, tabs or blanks.

    Without names, columns are numbered from 0. Below the names there may be a row of units, which
    may also follow a name in brackets. Lines that begin with # or % before the names are ignored.
    Numbers may have decimal commas, unless commas separate them.

    :param path: of the file
    :param columns: for ``skip`` and the wanted names
    :raises TrajectoryError: if names and rows have different numbers of fields
    """
    encoding = _encoding(path)
    with library_errors(path):
        with path.open(encoding=encoding, errors="replace") as file:
            sample_text = file.read(_SAMPLE_CHARACTERS)
        lines = sample_text.split("\n")
        full_lines = (
            lines[:-1] if len(sample_text) == _SAMPLE_CHARACTERS and len(lines) > 1 else lines
        )
        if "\x00" in sample_text:
            raise ValueError("it contains zero bytes, so it is not text")
    layout = _layout(path, full_lines, columns)
    names = layout.names
    alias_of = aliases(names, columns.wanted)
    wanted = [name for name in names if name in columns.wanted or name in alias_of.values()]
    # If a column is missing, the error message needs the names of all, and few rows suffice.
    any_missing = bool(columns.wanted - set(wanted) - set(alias_of))
    chosen = names if any_missing or not wanted else wanted
    with library_errors(path):
        frame = _frame(path, encoding, layout, chosen, 2 if any_missing else None)
        if layout.dialect in _DIALECTS[1:4] and _has_decimal_commas(frame):
            with_commas = layout._replace(dialect=layout.dialect._replace(decimal=","))
            frame = _frame(path, encoding, with_commas, chosen, 2 if any_missing else None)
    if layout.nameless and any_missing:
        raise TrajectoryError(
            f"'{path}' begins with numbers, so its {len(names)} columns have no names: use their "
            f"numbers, from 0 to {len(names) - 1}, as time: 0, obs: [{{column: 1}}]."
        )
    units = dict(zip(names, layout.units, strict=False))
    return Log([{name: frame[name].to_numpy() for name in frame.columns}], units=units)


def _frame(
    path: Path, encoding: str, layout: _Layout, chosen: Sequence[str], rows: int | None
) -> Any:
    """The rows of some columns, read by pandas."""
    import pandas

    arguments: dict[str, Any] = {
        "sep": layout.dialect.separator,
        "decimal": layout.dialect.decimal,
        "header": None,
        "names": layout.names,
        "nrows": rows,
        "chunksize": _CHUNK_ROWS,
        "index_col": False,
        "skipinitialspace": True,
        "float_precision": "round_trip" if path.stat().st_size < _ROUND_TRIP_BYTES else "high",
    }
    with path.open(encoding=encoding, errors="replace") as file:
        for _ in range(layout.n_before):
            file.readline()
        try:
            # Reading all columns detects lines of another length; only the chosen ones are kept.
            parts = [part[list(chosen)] for part in pandas.read_csv(file, **arguments)]
        except pandas.errors.EmptyDataError:
            return pandas.DataFrame({name: [] for name in chosen})
        except pandas.errors.ParserError as error:
            raise _unequal_fields(path, layout, str(error)) from error
    return pandas.concat(parts) if len(parts) > 1 else parts[0]


def _has_decimal_commas(frame: Any) -> bool:
    """Whether decimal commas occur beyond the lines that the layout was inferred from."""
    texts = (frame[name].dropna() for name in frame.columns if frame[name].dtype == object)
    return any(text.astype(str).str.fullmatch(r"-?\d+,\d+").any() for text in texts)


def _encoding(path: Path) -> str:
    """UTF-16 if the file begins with its mark, otherwise UTF-8, or else Windows-1252."""
    with library_errors(path), path.open("rb") as file:
        begin = file.read(_SAMPLE_CHARACTERS)
    if begin[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return "utf-16"
    try:
        # A character of four bytes may be cut off at the end.
        begin[: max(len(begin) - 3, 0) if len(begin) == _SAMPLE_CHARACTERS else None].decode(
            "utf-8-sig"
        )
    except UnicodeDecodeError:
        return "cp1252"
    return "utf-8-sig"


def _layout(path: Path, lines: Sequence[str], columns: Columns) -> _Layout:
    """The names, units and first row, and the separator of fields."""
    skip = columns.skip or 0
    filled = [(i, line.strip()) for i, line in enumerate(lines) if i >= skip and line.strip()]
    comments = list(itertools.takewhile(lambda numbered: _is_comment(numbered[1]), filled))
    body = filled[len(comments) :]
    if not filled:
        raise TrajectoryError(f"'{path}' is empty: nothing was logged.")
    sample = [line for _, line in body[:_SAMPLE_LINES]] or [comments[-1][1].lstrip("#% ")]
    dialect = max(_DIALECTS, key=lambda tried: _fit(tried, sample))
    rows = [dialect.fields(line) for line in sample]
    head, units = rows[0], list[str]()
    if not body or _is_data(dialect, rows):
        # The last comment may contain the names.
        above = comments[-1][1] if comments else ""
        given = dialect.fields(above.lstrip("#% \t"))
        named = bool(given) and (len(given) == len(head) or not body)
        names = given if named else [str(i) for i in range(len(head))]
        if named and f"{above[0]}{names[0]}" in columns.wanted:
            names[0] = f"{above[0]}{names[0]}"
        n_before = body[0][0] if body else len(lines)
        # The format of `rostopic echo -p`.
        units = ["ns"] if named and above.startswith("%time") else []
    else:
        named, names = True, head
        has_units = len(rows) > 2 and _are_units(dialect, head, rows[1], rows[2])
        if has_units:
            units = rows[1]
        else:
            _check_names(path, dialect, rows, body)
        at = 2 if has_units else 1
        n_before = body[at][0] if len(body) > at else len(lines)
    units = [*units, *[""] * (len(names) - len(units))]
    for i, name in enumerate(names if named else []):
        match = _UNIT_IN_NAME.fullmatch(name)
        units[i] = units[i] or (match[1] if match else "")
    return _Layout(_unique_names(names), units, n_before, dialect, not named)


def _is_comment(line: str) -> bool:
    """Whether a line is a comment, or Excel's line that names the separator."""
    return line[0] in "#%" or re.fullmatch(r"sep=.", line) is not None


def _fit(dialect: _Dialect, sample: Sequence[str]) -> tuple[int, float, int]:
    """By number of numbers in lines of the usual length, then their share, then the length."""
    rows = [dialect.fields(line) for line in sample]
    [(length, _)] = Counter(map(len, rows)).most_common(1)
    fields = [field for row in rows if len(row) == length for field in row]
    numbers = sum(map(dialect.is_number, fields))
    return numbers, numbers / max(len(fields), 1), len(rows[0])


def _is_data(dialect: _Dialect, rows: Sequence[Sequence[str]]) -> bool:
    """Whether the first line holds values rather than names."""
    head, below = rows[0], rows[1] if len(rows) > 1 else []
    if head == [str(i) for i in range(len(head))] and len(head) > 1:
        # pandas' names of columns without names, unless integers follow.
        return all(field.lstrip("-").isdigit() for field in below)
    numbers = [dialect.is_number(field) for field in head]
    if not any(numbers) or (below and len(below) != len(head)):
        return all(numbers)
    # Values are above values of the same kind; names, of which some may be numbers, are not.
    number, text = dialect.is_number, dialect.is_text
    return not any(
        (number(x) and text(y)) or (text(x) and number(y))
        for x, y in zip(head, below, strict=False)
    )


def _are_units(
    dialect: _Dialect, names: Sequence[str], line: Sequence[str], below: Sequence[str]
) -> bool:
    """Whether a line is a row of units: texts or 1 above numbers."""
    texts = [(x, y) for x, y in zip(line, below, strict=False) if dialect.is_text(x)]
    if not texts or len(line) > len(names) or any(map(dialect.is_text, [y for _, y in texts])):
        return False
    if any(dialect.is_number(field) and field != "1" for field in line):
        return False
    known = [x for x, _ in texts if unit_of(x) or x[0] + x[-1] in ("[]", "()")]
    return 2 * len(known) >= len(texts)


def _check_names(
    path: Path, dialect: _Dialect, rows: Sequence[Sequence[str]], body: Sequence[tuple[int, str]]
) -> None:
    """:raises TrajectoryError: if the lines after the first cannot be the rows that it names"""
    names, first = rows[0], rows[1] if len(rows) > 1 else []
    shown = f"'{body[0][1][:60]}' and then '{body[1][1][:60]}'" if first else ""
    numbers = any(map(dialect.is_number, first))
    later = rows[2] if len(rows) > 2 else []
    at = _header_row(dialect, rows)
    odd = len(first) > len(names) or any(map(dialect.is_number, later)) or at
    if first and not numbers and odd:
        remedy = f"skip: {body[at][0]}" if at else "skip: NUMBER OF LINES"
        raise TrajectoryError(
            f"'{path}' must begin with the names of its columns, followed by numbers, got {shown}. "
            f"Give the number of lines to skip before the names: {remedy}."
        )
    if len(first) > len(names):
        raise TrajectoryError(
            f"'{path}' has {len(names)} names in its first line and {len(first)} fields in the "
            f"next one, '{body[1][1][:60]}'. Decimal commas cannot be distinguished from commas "
            "between fields: export the log with decimal points, or with semicolons between "
            "fields. If the names are further below, give the number of lines before them: skip: "
            "NUMBER."
        )


def _header_row(dialect: _Dialect, rows: Sequence[Sequence[str]]) -> int:
    """:return: index of the first line of texts above as many numbers; 0 if there is none"""
    for i, (line, below) in enumerate(itertools.pairwise(rows)):
        alike = len(line) == len(below)
        if alike and all(map(dialect.is_text, line)) and all(map(dialect.is_number, below)):
            return i
    return 0


def _unique_names(names: Sequence[str]) -> list[str]:
    """The second ``q`` is called ``q.1``, as in pandas."""
    seen: dict[str, int] = {}
    result = []
    for name in names:
        n_earlier = seen.get(name, 0)
        seen[name] = n_earlier + 1
        result.append(f"{name}.{n_earlier}" if n_earlier else name)
    return result if len(set(result)) == len(result) else [f"{n}#{i}" for i, n in enumerate(names)]


def _unequal_fields(path: Path, layout: _Layout, reason: str) -> TrajectoryError:
    match = re.search(r"Expected (\d+) fields in line (\d+), saw (\d+)", reason)
    if not match:
        reason = " ".join(reason.split())[:200]
        return TrajectoryError(f"'{path}' is not a table of text ({reason}).")
    line = int(match[2]) + layout.n_before
    return TrajectoryError(
        f"'{path}' has {match[3]} fields in line {line} and {len(layout.names)} before. Correct "
        "or delete that line. If rows begin further below, give the number of lines before them: "
        "skip: NUMBER."
    )
