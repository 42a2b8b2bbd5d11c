"""The measurements that lie in ``benchmarks/results``, with the commands that made them."""

import ast
import math
from pathlib import Path

from tables import read, rounded, table

BENCHMARKS = Path(__file__).parent.parent.parent / "benchmarks"

# Columns that tell the runs of a table apart; what else there is belongs to one row of a run.
_RUN = {
    *("algorithm", "budget", "case", "cell", "env", "hidden", "kind", "learner", "method", "noise"),
    *("prior", "programs", "recordings", "seed", "system", "twin"),
}

# Longer tables are for programs to read.
_MOST_ROWS = 60

_NONE = (
    "There are no results in this checkout yet. Run one of the commands above, then `make docs`.\n"
)


def as_markdown(folder: Path = BENCHMARKS) -> str:
    """
    :param folder: with the scripts, and with their tables in ``results``
    :return: the commands with their tables and the time of their runs, then every table
    """
    tables = sorted(folder.glob("results/*.csv"))
    results = "".join(map(_as_section, tables)) if tables else _NONE
    return f"{_commands(folder)}## Results\n\n{results}"


def _commands(folder: Path) -> str:
    scripts = [path for path in sorted(folder.glob("*.py")) if _is_command(path)]
    examples = sorted(folder.parent.glob("examples/*.py"))
    tables = _tables_by_script([*scripts, *examples], sorted(folder.glob("results/*.csv")))
    rows = [
        [
            f"`python {path.parent.name}/{path.name}`",
            _first_line(path),
            ", ".join(own.stem for own in tables[path]),
            _in_words(max(map(_seconds_of_runs, tables[path]), default=0.0)),
        ]
        for path in (*scripts, *(path for path in examples if tables[path]))
    ]
    return table(["command", "what it measures", "tables", "time of all runs"], rows)


def _tables_by_script(scripts: list[Path], tables: list[Path]) -> dict[Path, list[Path]]:
    """Each table under the script that names it, or else under the one with the most like name."""
    found: dict[Path, list[Path]] = {path: [] for path in scripts}
    named = {path: _strings_in(path) for path in scripts}
    for own in tables:

        def likeness(path: Path, stem: str = own.stem) -> tuple[int, bool]:
            whole = len(path.stem) if stem.startswith(path.stem) else 0
            return whole, stem.partition("_")[0] == path.stem.partition("_")[0]

        says = [path for path in scripts if own.stem in named[path]]
        found[max(says or scripts, key=likeness)].append(own)
    return found


def _strings_in(path: Path) -> set[str]:
    nodes = ast.walk(ast.parse(path.read_text()))
    return {node.value for node in nodes if isinstance(node, ast.Constant) and str(node.value)}


def _seconds_of_runs(path: Path) -> float:
    """
    :return: the sum over all runs of a table [s]; 0 where it does not record them. Of a run with
        several rows, the last one counts: seconds add up along it.
    """
    columns, rows = read(path)
    if "seconds" not in columns:
        return 0.0
    runs: dict[tuple[str, ...], float] = {}
    run_by = _RUN if "mark" in columns else _RUN | {"steps"}
    keys = [i for i, column in enumerate(columns) if column in run_by]
    for row in rows:
        run = tuple(row[i] for i in keys)
        runs[run] = max(runs.get(run, 0.0), float(row[columns.index("seconds")] or "nan"))
    return sum(seconds for seconds in runs.values() if not math.isnan(seconds))


def _in_words(seconds: float) -> str:
    if not seconds:
        return ""
    return f"{seconds / 3600.0:.1f} h" if seconds > 3600.0 else f"{seconds / 60.0:.0f} min"


def _is_command(path: Path) -> bool:
    return "__main__" in path.read_text()


def _first_line(path: Path) -> str:
    words = ast.get_docstring(ast.parse(path.read_text())) or ""
    return words.partition("\n\n")[0]


def _as_section(path: Path) -> str:
    columns, rows = read(path)
    title, name = path.stem.replace("_", " "), f"`{path.parent.name}/{path.name}`"
    rows = [[rounded(cell) for cell in row] for row in rows]
    shown = table(columns, rows) if len(rows) <= _MOST_ROWS else f"{len(rows)} rows.\n\n"
    picture = path.with_suffix(".png")
    if picture.exists():
        shown += f"![{title}](../../benchmarks/results/{picture.name})\n\n"
    return f"### {title}\n\n{shown}From {name}.\n\n"
