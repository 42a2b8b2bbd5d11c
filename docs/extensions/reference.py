"""Every public name with its signature, by package, and in full where no other page has it."""

import importlib
import inspect
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from tables import table

from sb3_hds import effects, twins

DOCS = Path(__file__).parent.parent

# Upper packages first: a name that several export is listed where it is shortest.
PACKAGES = (
    "sb3_hds",
    *(
        f"sb3_hds.{package}"
        for package in (
            *("data", "twins", "effects", "sysid", "planning", "envs", "wrappers", "algos"),
            *("deploy", "experiments", "core"),
        )
    ),
)

_DIRECTIVE = re.compile(r"^\.\. (currentmodule|auto\w+):: (\S+)$", re.MULTILINE)


def as_markdown() -> str:
    """:return: a table of the names of each package, then what is not on another page"""
    described, seen = set(_described()), set()
    return "".join(_section(package, described, seen) for package in PACKAGES)


def public_names(package: str) -> list[str]:
    """:return: what a package exports, without its own packages"""
    module = importlib.import_module(package)
    return [n for n in module.__all__ if not inspect.ismodule(getattr(module, n))]


def _section(package: str, described: set[str], seen: set[int]) -> str:
    module = importlib.import_module(package)
    own = {name: getattr(module, name) for name in public_names(package)}
    new = {name: value for name, value in own.items() if id(value) not in seen}
    seen.update(map(id, new.values()))
    documented = {name: value for name, value in new.items() if _has_docstring(value)}
    plain = {name: value for name, value in new.items() if name not in documented}
    full = {name: v for name, v in documented.items() if f"{package}.{name}" not in described}
    summary = (inspect.getdoc(module) or "").partition("\n\n")[0]
    return (
        f"## {package}\n\n{summary}\n\n"
        + _rst(".. autosummary::\n\n", *(f"   ~{package}.{name}\n" for name in documented))
        + _values(plain)
        + _rst(*(_in_full(f"{package}.{name}", value) for name, value in full.items()))
    )


def _has_docstring(value: Any) -> bool:
    return (inspect.isclass(value) or inspect.isroutine(value)) and value.__module__.startswith(
        "sb3_hds"
    )


def _in_full(name: str, value: Any) -> str:
    kind = "class" if inspect.isclass(value) else "function"
    return f".. auto{kind}:: {name}\n\n"


def _values(values: dict[str, Any]) -> str:
    rows = [[f"`{name}`", f"`{_shown(value)}`"] for name, value in values.items()]
    return table(["constant or type", "value"], rows) if rows else ""


def _shown(value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(map(str, value))
    if isinstance(value, tuple):
        return ", ".join(getattr(entry, "__name__", str(entry)) for entry in value)
    if type(value).__module__.startswith("sb3_hds"):
        return f"{type(value).__name__}()"
    return str(value).replace("jaxlib._jax.", "")


def _rst(*lines: str) -> str:
    return f"```{{eval-rst}}\n{''.join(lines)}```\n\n" if lines else ""


def _described() -> Iterable[str]:
    """Full names of all that other pages describe."""
    yield from (f"sb3_hds.twins.{twins.get(name).__name__}" for name in twins.names())
    yield from (f"sb3_hds.effects.{e.__name__}" for e in (*effects.ALL, *effects.NAMELESS))
    for page in DOCS.glob("*/*.md"):
        module = ""
        for directive, name in _DIRECTIVE.findall(page.read_text()):
            if directive == "currentmodule":
                module = f"{name}."
            else:
                yield name if name.startswith("sb3_hds") else module + name
