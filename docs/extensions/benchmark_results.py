"""The commands that wrote ``benchmarks/results``, and the pages that show what they measured."""

import ast
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from tables import read, table

BENCHMARKS = Path(__file__).parent.parent.parent / "benchmarks"

# Columns that identify a run; the others belong to one row of a run.
_RUN = {
    *("algorithm", "budget", "cache", "case", "cell", "env", "goal", "hidden", "joints", "kind"),
    *("learner", "method", "noise", "prior", "recordings", "seed", "system", "tasks", "twin"),
}
# Columns with the time of a run, the first that a table has, in units of so many seconds.
_TIMES = {"verdict [s]": 1.0, "cluster [s]": 1.0, "run_seconds": 1.0, "seconds": 1.0}
_TIMES |= {"minutes": 60.0}


def as_markdown(pages: Mapping[str, Sequence[str]], folder: Path = BENCHMARKS) -> str:
    """
    :param pages: for each result, by the name of its file without the ending, the paths of the
        pages that show it, relative to this one
    :param folder: with the scripts, and with their tables in ``results``
    :return: Markdown with every command, what it measures, where this is shown, and its time
    """
    scripts = [path for path in sorted(folder.glob("*.py")) if "__main__" in path.read_text()]
    examples = sorted(folder.parent.glob("examples/*.py"))
    results = _results_by_script([*scripts, *examples], sorted(folder.glob("results/*.csv")))
    rows = [
        [
            f"`python {path.parent.name}/{path.name}`",
            _first_paragraph(path),
            ", ".join(_files(path.stem, [own.stem for own in results[path]])),
            ", ".join(f"[]({page})" for page in _pages_of(results[path], pages)),
            _in_words(max(map(_seconds_of_runs, results[path]), default=0.0)),
        ]
        for path in (*scripts, *(path for path in examples if results[path]))
    ]
    return table(["command", "what it measures", "tables", "shown in", "time of all runs"], rows)


def _results_by_script(scripts: list[Path], tables: list[Path]) -> dict[Path, list[Path]]:
    """Each table under the script that names it, or else under the one with the most like name."""
    found: dict[Path, list[Path]] = {path: [] for path in scripts}
    named = {path: _strings_in(path) for path in scripts}
    for own in tables:

        def likeness(path: Path, stem: str = own.stem) -> tuple[int, bool]:
            common = len(path.stem) if stem.startswith(path.stem) else 0
            return common, stem.partition("_")[0] == path.stem.partition("_")[0]

        naming = [path for path in scripts if own.stem in named[path]]
        found[max(naming or scripts, key=likeness)].append(own)
    return found


def _strings_in(path: Path) -> set[str]:
    nodes = ast.walk(ast.parse(path.read_text()))
    return {node.value for node in nodes if isinstance(node, ast.Constant) and str(node.value)}


def _files(script: str, stems: list[str]) -> list[str]:
    """More than two tables that are named after the script are written as a pattern."""
    alike = [stem for stem in stems if stem.startswith(script)]
    others = [stem for stem in stems if stem not in alike]
    return [f"`{name}`" for name in ([f"{script}*"] if len(alike) > 2 else alike) + others]


def _pages_of(results: list[Path], pages: Mapping[str, Sequence[str]]) -> list[str]:
    return list(dict.fromkeys(page for own in results for page in pages.get(own.stem, ())))


def _seconds_of_runs(path: Path) -> float:
    """
    :return: the sum over all runs of a table [s]; 0 where it does not record them. Of a run with
        several rows, the last one counts: times add up along it.
    """
    columns, rows = read(path)
    time = next((column for column in _TIMES if column in columns), None)
    if time is None:
        return 0.0
    runs: dict[tuple[str, ...], float] = {}
    # With marks or minutes, the steps are those of a row.
    run_by = _RUN if "mark" in columns or time == "minutes" else _RUN | {"steps"}
    run_by = run_by | ({"rate [Hz]", "seconds"} - {time})
    keys = [i for i, column in enumerate(columns) if column in run_by]
    for row in rows:
        run = tuple(row[i] for i in keys)
        runs[run] = max(runs.get(run, 0.0), float(row[columns.index(time)] or "nan"))
    return _TIMES[time] * sum(value for value in runs.values() if not math.isnan(value))


def _in_words(seconds: float) -> str:
    if not seconds:
        return ""
    return f"{seconds / 3600.0:.1f} h" if seconds > 3600.0 else f"{seconds / 60.0:.0f} min"


def _first_paragraph(path: Path) -> str:
    words = ast.get_docstring(ast.parse(path.read_text())) or ""
    return words.partition("\n\n")[0]
