"""How messages and reports write numbers and lists of names."""

from collections.abc import Iterable

_LISTED = 40


def counted(n: int, noun: str, plural: str = "") -> str:
    """:return: ``"1 row"``, ``"2 rows"``; without ``plural``, that of the noun ends in an s"""
    return f"{n} {noun if n == 1 else plural or f'{noun}s'}"


def percent(share: float) -> str:
    """:return: a share in per cent; 100 % only if it rounds to that"""
    return f"{100.0 * share:.2g} %" if share < 0.995 else "100 %"


def listed(names: Iterable[str]) -> str:
    """:return: the first 40 names, and how many more there are"""
    every = [str(name) for name in names]
    more = f", and {len(every) - _LISTED} more" if len(every) > _LISTED else ""
    return ", ".join(every[:_LISTED]) + more or "none"
