"""Tables and pictures of ``benchmarks/results``, complete or condensed."""

from collections.abc import Callable
from pathlib import Path
from statistics import fmean, median

from tables import read, rounded, table

RESULTS = Path(__file__).parent.parent.parent / "benchmarks" / "results"

_NONE = "Not measured yet in this checkout.\n\n"


def over_seeds(
    name: str,
    variant: str | tuple[str, ...],
    *measured: str,
    ends: tuple[str, str, str] | None = None,
    shows: str = "",
) -> Callable[[], str]:
    """
    :param name: of the table, without its ending
    :param variant: column that identifies a variant, or several that do so together
    :param measured: columns to show
    :param ends: name of a table, and two variants in it: the share of the gap between them that the
        return of each variant closes is shown too, once both have been measured
    :param shows: description of the picture of the same name, if there is one
    :return: function that makes the Markdown
    """

    def condensed(columns: list[str], rows: list[list[str]]) -> tuple[list[str], list[list[str]]]:
        parts = (variant,) if isinstance(variant, str) else variant
        places, shown = ([columns.index(c) for c in some] for some in (parts, measured))
        name_of = lambda row: ", ".join(row[i] for i in places)  # noqa: E731
        gap = _gap(*ends, parts[0]) if ends else {}
        lines = []
        for one in dict.fromkeys(map(name_of, rows)):
            own = [row for row in rows if name_of(row) == one]
            values = [_mean_and_range([float(row[i]) for row in own]) for i in shown]
            closed = [_closed(_by_seed(columns, own), gap)] if gap else []
            lines.append([one, *values, *closed, str(len(own))])
        return [", ".join(parts), *measured, *(["closed"] if gap else []), "seeds"], lines

    return lambda: _shown(name, condensed, shows)


def first_and_rest(name: str, n_first: int, shows: str = "") -> Callable[[], str]:
    """
    :param name: of a table with a row for each episode: minutes, steps, return, late steps so far
    :param n_first: number of episodes that have rows of their own
    :param shows: description of the picture of the same name, if there is one
    :return: function that makes the Markdown
    """

    def condensed(columns: list[str], rows: list[list[str]]) -> tuple[list[str], list[list[str]]]:
        at = {column: i for i, column in enumerate(columns)}
        late = [0.0, *(float(row[at["late"]]) for row in rows)]
        groups = [(i, i + 1) for i in range(min(n_first, len(rows)))]
        groups += [(n_first, len(rows))] if len(rows) > n_first else []
        lines = []
        for begin, end in groups:
            own = rows[begin:end]
            lines.append(
                [
                    f"{begin + 1}" if end == begin + 1 else f"{begin + 1} to {end}",
                    rounded(own[-1][at["minutes"]]),
                    _mean_and_range([float(row[at["return"]]) for row in own]),
                    rounded(late[end] - late[begin]),
                ]
            )
        return ["episodes", "minutes at their end", "return", "late steps"], lines

    return lambda: _shown(name, condensed, shows)


def complete(name: str, shows: str = "", digits: int = 3) -> Callable[[], str]:
    """
    :param name: of a table that is shown completely, with rounded numbers
    :param shows: description of the picture of the same name, if there is one
    :param digits: significant digits of a number
    :return: function that makes the Markdown
    """

    def with_rounded_numbers(
        columns: list[str], rows: list[list[str]]
    ) -> tuple[list[str], list[list[str]]]:
        return columns, [[rounded(cell, digits) for cell in row] for row in rows]

    return lambda: _shown(name, with_rounded_numbers, shows)


def crossed(
    name: str, row: tuple[str, ...], columns: tuple[str, ...], value: str
) -> Callable[[], str]:
    """
    :param name: of the table, without its ending
    :param row: columns whose values become the rows
    :param columns: columns whose values become the columns
    :param value: column to show, as the mean over all other columns
    :return: function that makes the Markdown
    """

    def turned(titles: list[str], rows: list[list[str]]) -> tuple[list[str], list[list[str]]]:
        shown = titles.index(value)
        down, across = ([titles.index(column) for column in own] for own in (row, columns))
        cells: dict[tuple[str, str], list[float]] = {}
        for one in rows:
            at = ", ".join(one[i] for i in down), ", ".join(one[i] for i in across)
            cells.setdefault(at, []).append(float(one[shown]))
        left, top = (dict.fromkeys(at[i] for at in cells) for i in (0, 1))
        lines = [[one, *(_mean(cells.get((one, other), [])) for other in top)] for one in left]
        return [", ".join(row), *top], lines

    return lambda: _shown(name, turned)


def gaits() -> str:
    """:return: Markdown with the results of open-loop searches, by environment and budget"""

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


def learned(*methods: str) -> Callable[[], str]:
    """
    :param methods: methods of `model_free.py` to show, in this order, for the environments in which
        the first one or a variant of it was run; default: all
    :return: function that makes the Markdown with their returns by environment
    """

    def condensed(titles: list[str], rows: list[list[str]]) -> tuple[list[str], list[list[str]]]:
        runs = [dict(zip(titles, row, strict=True)) for row in rows]
        shown = methods or tuple(dict.fromkeys(run["method"] for run in runs))
        lines = []
        for env in dict.fromkeys(run["env"] for run in runs):
            own = {run["method"]: run for run in runs if run["env"] == env}
            if methods and not any(method.startswith(methods[0]) for method in own):
                continue
            for run in (own[method] for method in shown if method in own):
                mean, low, high, worst = map(
                    rounded, (run[name] for name in ("return", "low", "high", "worst"))
                )
                end, reached = (rounded(run[name] or "nan") for name in ("mark", "steps_to_target"))
                at_target = "" if reached == "nan" else reached
                spread = f"{mean} ({low} to {high})" if low != high else mean
                numbers = [spread, worst, run["seeds"], rounded(run["seconds"]), at_target]
                lines.append([f"{env}, {end} steps", run["method"], *numbers])
        numbers = ["mean return", "worst seed", "seeds", "seconds", "steps to target"]
        return ["environment", "method", *numbers], lines

    return lambda: _shown("model_free_summary", condensed)


def _mean(values: list[float]) -> str:
    return rounded(fmean(values)) if values else ""


def picture(name: str, shows: str) -> Callable[[], str]:
    """
    :param name: of the picture, without its ending
    :param shows: its description
    :return: function that makes the Markdown for a page in a folder of `docs`
    """
    there = f"![{shows}](../../benchmarks/results/{name}.png)"
    return lambda: there if (RESULTS / f"{name}.png").exists() else _NONE


def _shown(name: str, change: Callable, shows: str = "") -> str:
    path = RESULTS / f"{name}.csv"
    if not path.exists():
        return _NONE
    columns, rows = change(*read(path))
    titles = [column.replace("_", " ") for column in columns]
    shown = table(titles, rows)
    if path.with_suffix(".png").exists():
        shown += f"![{shows or name.replace('_', ' ')}](../../benchmarks/results/{name}.png)\n\n"
    return shown + f"From `benchmarks/results/{name}.csv`."


def _mean_and_range(values: list[float]) -> str:
    mean, low, high = (rounded(x) for x in (fmean(values), min(values), max(values)))
    return mean if low == high else f"{mean} ({low} to {high})"


def _by_seed(columns: list[str], rows: list[list[str]]) -> dict[str, float]:
    return {row[columns.index("seed")]: float(row[columns.index("return")]) for row in rows}


def _gap(name: str, worst: str, best: str, variant: str) -> dict[str, tuple[float, float]]:
    """:return: both ends of the gap by seed, for the seeds that were run with both"""
    path = RESULTS / f"{name}.csv"
    if not path.exists():
        return {}
    columns, rows = read(path)
    low, high = (
        _by_seed(columns, [row for row in rows if row[columns.index(variant)] == end])
        for end in (worst, best)
    )
    return {seed: (low[seed], high[seed]) for seed in low if seed in high}


def _closed(returns: dict[str, float], gap: dict[str, tuple[float, float]]) -> str:
    """The closed share of the gap over common seeds, computed as in `benchmarks/sim_to_real.py`."""
    seeds = [seed for seed in returns if seed in gap]
    if not seeds:
        return ""
    gained = fmean(returns[seed] - gap[seed][0] for seed in seeds)
    return rounded(gained / fmean(gap[seed][1] - gap[seed][0] for seed in seeds))
