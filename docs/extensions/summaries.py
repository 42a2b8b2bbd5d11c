"""Tables and pictures of ``benchmarks/results``: as they are, or mean and range over seeds."""

from collections.abc import Callable
from pathlib import Path
from statistics import fmean

from tables import read, rounded, table

RESULTS = Path(__file__).parent.parent.parent / "benchmarks" / "results"

_NONE = "Not measured yet in this checkout.\n\n"


def over_seeds(name: str, variant: str, *measured: str) -> Callable[[], str]:
    """
    :param name: of the table, without its ending
    :param variant: column that tells variants apart
    :param measured: columns that are shown
    :return: what makes the Markdown
    """

    def condensed(columns: list[str], rows: list[list[str]]) -> tuple[list[str], list[list[str]]]:
        place, shown = columns.index(variant), [columns.index(column) for column in measured]
        lines = []
        for one in dict.fromkeys(row[place] for row in rows):
            own = [row for row in rows if row[place] == one]
            values = [_spread([float(row[i]) for row in own]) for i in shown]
            lines.append([one, *values, str(len(own))])
        return [variant, *measured, "seeds"], lines

    return lambda: _shown(name, condensed)


def whole(name: str) -> Callable[[], str]:
    """:return: what makes the Markdown of a table that is shown as it is, numbers rounded"""
    return lambda: _shown(name, lambda columns, rows: (columns, [[*map(rounded, r)] for r in rows]))


def picture(name: str, shows: str) -> Callable[[], str]:
    """
    :param name: of the picture, without its ending
    :param shows: what is to be seen on it
    :return: what makes the Markdown for a page of a folder of `docs`, once there is a picture
    """
    there = f"![{shows}](../../benchmarks/results/{name}.png)"
    return lambda: there if (RESULTS / f"{name}.png").exists() else _NONE


def _shown(name: str, change: Callable) -> str:
    path = RESULTS / f"{name}.csv"
    if not path.exists():
        return _NONE
    columns, rows = change(*read(path))
    titles = [column.replace("_", " ") for column in columns]
    return table(titles, rows) + f"From `benchmarks/results/{name}.csv`."


def _spread(values: list[float]) -> str:
    mean, low, high = (rounded(x) for x in (fmean(values), min(values), max(values)))
    return mean if low == high else f"{mean} ({low} to {high})"
