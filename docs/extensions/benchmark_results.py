"""The measurements that lie in ``benchmarks/results``, with the commands that made them."""

import ast
from pathlib import Path

from tables import read, rounded, table

BENCHMARKS = Path(__file__).parent.parent.parent / "benchmarks"

# Longer tables are for programs to read.
_MOST_ROWS = 60

_NONE = (
    "There are no results in this checkout yet. Run one of the commands above, then `make docs`.\n"
)


def as_markdown(folder: Path = BENCHMARKS) -> str:
    """
    :param folder: with the scripts, and with their tables in ``results``
    :return: the commands, then every table
    """
    tables = sorted(folder.glob("results/*.csv"))
    results = "".join(map(_as_section, tables)) if tables else _NONE
    return f"{_commands(folder)}## Results\n\n{results}"


def _commands(folder: Path) -> str:
    scripts = [path for path in sorted(folder.glob("*.py")) if _is_command(path)]
    rows = [[f"`python {folder.name}/{path.name}`", _first_line(path)] for path in scripts]
    return table(["command", "what it measures"], rows) if rows else ""


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
