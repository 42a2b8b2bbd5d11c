"""``sb3-hds effects`` and ``sb3-hds twins``: the catalogues, and checks of twins."""

import argparse
import hashlib
import inspect
import json
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sb3_hds.cli import measured, models
from sb3_hds.cli.arguments import settings
from sb3_hds.errors import ParameterError, did_you_mean

if TYPE_CHECKING:
    from sb3_hds.core import Parameter

_ADDENDA = {"sign_flip": " So may all of a joint: the direction of position and velocity at once."}
_OF_A_TWIN = (
    "A parameter of the twin differs from its nominal value: each one of 'sb3-hds twins' that "
    "--calibrate does not name. Always a candidate; --effects does not take it."
)
#: the stored rows of :func:`rows_of_effects`: reading the classes would import JAX
STORED = Path(__file__).with_name("effects.json")


def add_effects(command: argparse.ArgumentParser) -> None:
    """:param command: ``sb3-hds effects``"""
    command.add_argument(
        "words", nargs="*", metavar="WORD", help="list only entries that mention all of these"
    )
    command.set_defaults(run=run_effects)


def run_effects(given: argparse.Namespace) -> None:
    """List all candidates, or those that mention the words, with units and explanations."""
    columns = ("effect", "acts on", "parameters", "what it is")
    rows = [tuple(row) for row in stored_rows() or rows_of_effects()]
    _show(columns, _mentioning(rows, given.words, "effect"))
    print(
        "Units at joints are those of a rotary joint; for a slider, read N and m for N m and rad."
    )


def stored_rows() -> list[list[str]]:
    """:return: the stored rows; none if an effect has changed since"""
    stored = json.loads(STORED.read_text())
    return stored["rows"] if stored["sources"] == _sources() else []


def _sources() -> str:
    found = hashlib.sha256()
    for path in sorted((Path(__file__).parents[1] / "effects").glob("*.py")):
        found.update(path.read_bytes())
    return found.hexdigest()[:16]


def rows_of_effects() -> list[list[str]]:
    """:return: for each candidate: name, what it acts on, parameters, explanation"""
    from sb3_hds.effects import ALL

    rows = [
        [
            effect.name,
            effect.slot,
            ", ".join(map(_sized, effect.parameters.items())),
            effect.explanation + _ADDENDA.get(effect.name, ""),
        ]
        for effect in ALL
    ]
    return [*rows, ["parameter.NAME", "twin", "its own [unit]", _OF_A_TWIN]]


def store_effects() -> None:
    """Store the rows again after an effect was added or changed."""
    temporary = STORED.with_suffix(".tmp")
    stored = {"sources": _sources(), "rows": rows_of_effects()}
    temporary.write_text(json.dumps(stored, indent=1) + "\n")
    temporary.replace(STORED)


def _sized(parameter: "tuple[str, Parameter]") -> str:
    name, known = parameter
    switch = (known.unit, known.null, known.upper) == ("1", 0.0, 1.0) and known.scale == 1.0
    return "on or off" if switch else f"{name} [{known.unit}]"


def add_twins(command: argparse.ArgumentParser) -> None:
    """:param command: ``sb3-hds twins``"""
    command.add_argument(
        "words",
        nargs="*",
        metavar="WORD",
        help="list only twins that mention all of these; or 'check NAME', 'check module:Name' for "
        "one of your own, 'check robot.urdf': is it finite, consistent and a mechanical system?",
    )
    command.add_argument(
        "--set",
        nargs="*",
        default=[],
        metavar="NAME:VALUE",
        help="parameters and options of the twin that is checked: mass:0.3 observe:q",
    )
    models.add_options(command)
    command.set_defaults(run=run_twins)


def run_twins(given: argparse.Namespace) -> int:
    """:return: 1 where a check failed, else 0"""
    if given.words[:1] != ["check"]:
        for option in ("set", *models.OPTIONS):
            if getattr(given, option):
                raise ParameterError(
                    f"--{option} changes the twin that is checked: twins check NAME --{option} ..."
                )
        _list_twins(given.words)
        return 0
    if len(given.words) != 2:
        raise ParameterError(
            "Name one twin, as in 'sb3-hds twins check Pendulum' or 'sb3-hds twins check "
            f"my_module:MyTwin', got '{' '.join(given.words)}'."
        )
    from sb3_hds.twins import check

    found = check(measured.twin_called(given.words[1], settings("--set", given.set), given))
    print(found)
    return 0 if found.ok else 1


def _list_twins(words: Sequence[str]) -> None:
    """List all twins, or those that mention the words, with parameters and options."""
    from sb3_hds.twins import get, names

    rows = []
    for name in names():
        twin = get(name)()
        explained = (inspect.getdoc(type(twin)) or "").partition("\n\n")[0].replace("\n", " ")
        described = ", ".join(
            f"{key} {value:g} {twin.parameters[key].unit}" for key, value in twin.values.items()
        )
        options = " ".join(f"{key}:{value}" for key, value in twin.to_spec()["options"].items())
        rows.append(
            (
                f"{name}\n{twin.env_id or ''}".strip(),
                re.sub(r":\w+:`([^`]*)`", r"\1", explained),
                f"{described}\noptions: {options}",
            )
        )
    columns = ("twin, environment", "what it is", "parameters and options, for --set")
    _show(columns, _mentioning(rows, words, "twin"))


def _mentioning(
    rows: Sequence[tuple[str, ...]], words: Sequence[str], kind: str
) -> Sequence[tuple[str, ...]]:
    """
    The rows that mention all words, ignoring case and hyphens.

    :raises ParameterError: if there are none
    """
    texts = [_normalized(" ".join(row)) for row in rows]
    wanted = [_normalized(word) for word in words]
    found = [
        row for row, text in zip(rows, texts, strict=True) if all(word in text for word in wanted)
    ]
    if not found:
        unknown = next((word for word in wanted if not any(word in text for text in texts)), "")
        vocabulary = {"check", *(word for text in texts for word in text.split())}
        meant = did_you_mean(unknown, vocabulary)
        raise ParameterError(f"No {kind} mentions '{' '.join(words)}'.{meant}")
    return found


def _normalized(text: str) -> str:
    return re.sub(r"[\W_]+", " ", text.lower()).strip()


def _show(columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Column, Table

    table = Table(*(Column(name, overflow="fold") for name in columns), show_lines=True)
    for row in rows:
        # Units in brackets are not markup.
        table.add_row(*(escape(str(cell)) for cell in row))
    Console(width=None if sys.stdout.isatty() else 120).print(table)


if __name__ == "__main__":
    store_effects()
