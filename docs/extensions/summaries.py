"""Tables of ``benchmarks/results`` with a row for each variant: mean and range over seeds."""

import csv
from collections.abc import Callable
from pathlib import Path
from statistics import fmean

from tables import table

RESULTS = Path(__file__).parent.parent.parent / "benchmarks" / "results"

_NONE = "Not measured yet in this checkout.\n\n"


def over_seeds(name: str, variant: str, *measured: str) -> Callable[[], str]:
    """
    :param name: of the table, without its ending
    :param variant: column that tells variants apart
    :param measured: columns that are shown
    :return: what makes the Markdown
    """

    def as_markdown() -> str:
        path = RESULTS / f"{name}.csv"
        if not path.exists():
            return _NONE
        with path.open(newline="") as file:
            rows = list(csv.DictReader(file))
        lines = []
        for one in dict.fromkeys(row[variant] for row in rows):
            own = [row for row in rows if row[variant] == one]
            values = [_spread([float(row[column]) for row in own]) for column in measured]
            lines.append([one, *values, str(len(own))])
        titles = [column.replace("_", " ") for column in measured]
        return table([variant, *titles, "seeds"], lines) + f"From `benchmarks/results/{name}.csv`."

    return as_markdown


def whole(name: str) -> Callable[[], str]:
    """:return: what makes the Markdown of a table that is shown as it is, numbers rounded"""

    def as_markdown() -> str:
        path = RESULTS / f"{name}.csv"
        if not path.exists():
            return _NONE
        with path.open(newline="") as file:
            columns, *rows = csv.reader(file)
        titles = [column.replace("_", " ") for column in columns]
        shown = table(titles, [[_rounded(cell) for cell in row] for row in rows])
        return shown + f"From `benchmarks/results/{name}.csv`."

    return as_markdown


def _spread(values: list[float]) -> str:
    mean, low, high = (_rounded(x) for x in (fmean(values), min(values), max(values)))
    return mean if low == high else f"{mean} ({low} to {high})"


def _rounded(cell: float | str) -> str:
    """Three digits of a number tell enough; words stay."""
    try:
        number = float(cell)
    except ValueError:
        return str(cell)
    return f"{number:,.0f}" if abs(number) >= 100 else f"{number:.3g}"
