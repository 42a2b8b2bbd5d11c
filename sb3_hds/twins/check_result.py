"""The result of checking a twin."""

import dataclasses
import textwrap
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

_WIDTH = 80


class CheckItem(NamedTuple):
    """
    One check.

    :param name: of the checked property
    :param ok: whether it passed
    :param found: how it was checked, and the measured number
    :param way_out: what to do if it failed
    """

    name: str
    ok: bool
    found: str
    way_out: str = ""


def outcomes(name: str) -> tuple[Callable[..., CheckItem], Callable[..., CheckItem]]:
    """:return: constructors of a check's item if it passed, and if it failed"""
    return partial(CheckItem, name, True), partial(CheckItem, name, False)


@dataclasses.dataclass(frozen=True, repr=False)
class TwinCheck:
    """
    Result of :func:`~sb3_hds.twins.check`. Prints itself.

    :param twin: its name
    :param items: one for each check, in order
    :param skipped: what was not checked, and why
    """

    twin: str
    items: tuple[CheckItem, ...]
    skipped: str = ""

    @property
    def ok(self) -> bool:
        """Whether every check passed."""
        return not self.failed

    @property
    def failed(self) -> tuple[str, ...]:
        """The names of the checks that did not pass."""
        return tuple(item.name for item in self.items if not item.ok)

    def __str__(self) -> str:
        n, failed = len(self.items), len(self.failed)
        verdict = f"{failed} of {n} checks failed" if failed else f"all {n} checks passed"
        lines = [f"{self.twin}: {verdict}", "=" * _WIDTH]
        for name, ok, found, way_out in self.items:
            lines += _wrapped(f"{'ok  ' if ok else 'FAIL'} {name}: {found}")
            lines += _wrapped(f"     -> {way_out}") if way_out else []
        lines += _wrapped(f"not checked: {self.skipped}") if self.skipped else []
        return "\n".join(lines)

    __repr__ = __str__


def _wrapped(text: str) -> list[str]:
    return textwrap.wrap(text, _WIDTH, subsequent_indent="     ")
