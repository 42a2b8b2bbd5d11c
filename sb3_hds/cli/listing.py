"""``sb3-hds effects`` and ``sb3-hds twins``: what exists."""

import argparse
import inspect
import re
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sb3_hds.core import Parameter

_FURTHER = {"sign_flip": " So may all of a joint: the direction of position and velocity at once."}
_OF_A_TWIN = (
    "A parameter of the twin has another value than believed: each one of 'sb3-hds twins' that "
    "--calibrate does not name. Always a candidate; --effects does not take it."
)


def effects(given: argparse.Namespace) -> None:
    """All candidates, with units and explanations."""
    from sb3_hds.effects import ALL

    _show(
        ("effect", "acts on", "parameters", "what it is"),
        [
            (
                effect.name,
                effect.slot,
                ", ".join(map(_sized, effect.parameters.items())),
                effect.explanation + _FURTHER.get(effect.name, ""),
            )
            for effect in ALL
        ]
        + [("parameter.NAME", "twin", "its own [unit]", _OF_A_TWIN)],
    )
    print(
        "Units at joints are those of a rotary joint; for a slider, read N and m in place of N m "
        "and rad."
    )


def _sized(parameter: "tuple[str, Parameter]") -> str:
    name, known = parameter
    switch = (known.unit, known.null, known.upper) == ("1", 0.0, 1.0) and known.scale == 1.0
    return "on or off" if switch else f"{name} [{known.unit}]"


def twins(given: argparse.Namespace) -> None:
    """All simulations, with parameters and options."""
    from sb3_hds.twins import make, names

    rows = []
    for name in names():
        twin = make(name)
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
    _show(("twin, environment", "what it is", "parameters and options, for --set"), rows)


def _show(columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Column, Table

    table = Table(*(Column(name, overflow="fold") for name in columns), show_lines=True)
    for row in rows:
        # Units in brackets are no markup.
        table.add_row(*(escape(str(cell)) for cell in row))
    Console(width=None if sys.stdout.isatty() else 120).print(table)
