"""Tables in Markdown."""

import csv
from collections.abc import Iterable, Sequence
from pathlib import Path


def table(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """
    :param columns: their titles
    :param rows: as many cells each
    :return: a table with a blank line after it
    """
    lines = [columns, ["---"] * len(columns), *rows]
    return "".join(f"| {' | '.join(map(_cell, line))} |\n" for line in lines) + "\n"


def read(path: Path) -> tuple[list[str], list[list[str]]]:
    """:return: titles of the columns of a CSV file, and its rows"""
    with path.open(newline="") as file:
        columns, *rows = csv.reader(file)
    return columns, rows


def rounded(cell: float | str, digits: int = 3) -> str:
    """Round a number to three significant digits; other text is unchanged."""
    try:
        number = float(cell)
    except ValueError:
        return str(cell)
    return f"{number:,.0f}" if abs(number) >= 10 ** (digits - 1) else f"{number:.{digits}g}"


def _cell(text: str) -> str:
    return str(text).replace("|", "\\|").replace("\n", " ")
