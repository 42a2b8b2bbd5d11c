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


def rounded(cell: float | str) -> str:
    """Three digits of a number tell enough; words stay."""
    try:
        number = float(cell)
    except ValueError:
        return str(cell)
    return f"{number:,.0f}" if abs(number) >= 100 else f"{number:.3g}"


def _cell(text: str) -> str:
    return str(text).replace("|", "\\|").replace("\n", " ")
