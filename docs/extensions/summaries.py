"""Tables of ``benchmarks/results`` with a row for each variant: mean and range over seeds."""

from collections.abc import Callable
from pathlib import Path
from statistics import fmean, median

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


def crossed(name: str, row: str, columns: tuple[str, ...], value: str) -> Callable[[], str]:
    """
    :param name: of the table, without its ending
    :param row: column whose entries are the rows
    :param columns: columns whose entries together are the columns
    :param value: column that is shown, the mean over whatever else there is
    :return: what makes the Markdown
    """

    def turned(titles: list[str], rows: list[list[str]]) -> tuple[list[str], list[list[str]]]:
        place, shown = titles.index(row), titles.index(value)
        across = [titles.index(column) for column in columns]
        cells: dict[tuple[str, str], list[float]] = {}
        for one in rows:
            at = one[place], ", ".join(one[i] for i in across)
            cells.setdefault(at, []).append(float(one[shown]))
        left, top = (dict.fromkeys(at[i] for at in cells) for i in (0, 1))
        lines = [[one, *(_mean(cells.get((one, other), [])) for other in top)] for one in left]
        return [row, *top], lines

    return lambda: _shown(name, turned)


def gaits() -> str:
    """:return: Markdown of what open-loop searches found, by environment and budget"""

    def condensed(titles: list[str], rows: list[list[str]]) -> tuple[list[str], list[list[str]]]:
        runs = [dict(zip(titles, row, strict=True)) for row in rows]
        lines = []
        for key in sorted({(int(run["steps"]), run["env"]) for run in runs}):
            own = [run for run in runs if (int(run["steps"]), run["env"]) == key]
            returns = [float(run["return"]) for run in own]
            low, middle, high = map(rounded, (min(returns), median(returns), max(returns)))
            minutes = median(float(run["seconds"]) for run in own) / 60.0
            lines.append(
                [
                    key[1],
                    f"{key[0]:,}",
                    own[0]["searched"],
                    f"{middle} ({low} to {high})",
                    rounded(own[0]["target"]) if own[0]["target"] else "",
                    str(len(own)),
                    rounded(minutes),
                ]
            )
        numbers = ["numbers searched", "median return", "target", "seeds", "minutes"]
        return ["environment", "steps", *numbers], lines

    return _shown("open_loop", condensed)


def _mean(values: list[float]) -> str:
    return rounded(fmean(values)) if values else ""


def _shown(name: str, change: Callable) -> str:
    path = RESULTS / f"{name}.csv"
    if not path.exists():
        return _NONE
    columns, rows = change(*read(path))
    titles = [column.replace("_", " ") for column in columns]
    shown = table(titles, rows)
    if path.with_suffix(".png").exists():
        shown += f"![{name.replace('_', ' ')}](../../benchmarks/results/{name}.png)\n\n"
    return shown + f"From `benchmarks/results/{name}.csv`."


def _spread(values: list[float]) -> str:
    mean, low, high = (rounded(x) for x in (fmean(values), min(values), max(values)))
    return mean if low == high else f"{mean} ({low} to {high})"
