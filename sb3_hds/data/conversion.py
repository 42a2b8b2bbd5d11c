"""Units of logs, and their conversion to SI units."""

import math
import re
from collections.abc import Mapping
from typing import NamedTuple

_ORDER = ("N", "V", "A", "W", "J", "Pa", "ohm", "kg", "m", "K", "degC", "rad", "s")
"""Symbols in the order in which products are written: N m s, kg m2."""

_DERIVED: dict[str, dict[str, int]] = {
    "N": {"kg": 1, "m": 1, "s": -2},
    "J": {"kg": 1, "m": 2, "s": -2},
    "W": {"kg": 1, "m": 2, "s": -3},
    "V": {"kg": 1, "m": 2, "s": -3, "A": -1},
    "ohm": {"kg": 1, "m": 2, "s": -3, "A": -2},
    "Pa": {"kg": 1, "m": -1, "s": -2},
}

# Symbol in a log -> factor to SI, and powers of SI symbols.
_UNITS: dict[str, tuple[float, dict[str, int]]] = {
    **{symbol: (1.0, {symbol: 1}) for symbol in _ORDER if symbol != "kg"},
    "deg": (math.pi / 180.0, {"rad": 1}),
    "turn": (2.0 * math.pi, {"rad": 1}),
    "rpm": (math.pi / 30.0, {"rad": 1, "s": -1}),
    "min": (60.0, {"s": 1}),
    "h": (3600.0, {"s": 1}),
    "Hz": (1.0, {"s": -1}),
    "g": (1e-3, {"kg": 1}),
    "g0": (9.80665, {"m": 1, "s": -2}),
    "kgf": (9.80665, {"N": 1}),
    "Nm": (1.0, {"N": 1, "m": 1}),
    "Nmm": (1e-3, {"N": 1, "m": 1}),
    "Ncm": (1e-2, {"N": 1, "m": 1}),
    "bar": (1e5, {"Pa": 1}),
    "%": (1e-2, {}),
    "1": (1.0, {}),
}
_PREFIXES = {"n": 1e-9, "u": 1e-6, "m": 1e-3, "c": 1e-2, "k": 1e3, "M": 1e6}
_WITH_PREFIX = "rad deg s m g N Nm A V W J Pa Hz ohm rpm"

_SYNONYMS = {
    "radian": "rad",
    "degree": "deg",
    "°": "deg",
    "rev": "turn",
    "revolution": "turn",
    "sec": "s",
    "second": "s",
    "msec": "ms",
    "millisecond": "ms",
    "usec": "us",
    "microsecond": "us",
    "nsec": "ns",
    "nanosecond": "ns",
    "minute": "min",
    "hour": "h",
    "meter": "m",
    "metre": "m",
    "gram": "g",
    "newton": "N",
    "amp": "A",
    "ampere": "A",
    "volt": "V",
    "watt": "W",
    "°C": "degC",
    "HZ": "Hz",
    "celsius": "degC",
    "kelvin": "K",
    "percent": "%",
    "-": "1",
}
"""Other names; plurals and upper case are accepted too."""

_COUNTS = ("count", "tick", "step", "pulse", "lsb", "raw", "bit")
_SPELLINGS = {
    "\N{MICRO SIGN}": "u",
    "\N{GREEK SMALL LETTER MU}": "u",
    "\N{OHM SIGN}": "ohm",
    "\N{GREEK CAPITAL LETTER OMEGA}": "ohm",
    "\N{MIDDLE DOT}": " ",
    "\N{DOT OPERATOR}": " ",
    "*": " ",
    "\N{SUPERSCRIPT ONE}": "1",
    "\N{SUPERSCRIPT TWO}": "2",
    "\N{SUPERSCRIPT THREE}": "3",
    "\N{SUPERSCRIPT MINUS}": "-",
    "^": "",
}
_SYMBOL_AND_POWER = re.compile(r"(1|%|g0|[^\W\d_]+|°[^\W\d_]*|-)(-?\d)?")

KNOWN = "rad deg turn rpm s ms us ns min m mm kg g N N m A V W J Pa Hz degC K % 1 counts"
TIMES = ("s", "ms", "us", "ns", "min", "h")


class Unit(NamedTuple):
    """
    :param factor: from the unit of a log to the SI unit
    :param name: of the SI unit, written as in twins: ``"rad/s"``, ``"N m"``, ``"kg m2"``, ``"1"``;
        empty for counts, which have no unit without a scale
    """

    factor: float
    name: str


def unit_of(text: str) -> Unit | None:
    """
    :param text: such as ``"deg"``, ``"rpm"``, ``"N mm"``, ``"[m/s^2]"``, ``"N·m"``, ``"counts"``
    :return: None for an unknown unit
    """
    powers = _parse(text)
    if powers is None:
        return None
    factor, total = 1.0, dict[str, int]()
    for symbol, power in powers:
        if symbol in _COUNTS:
            return Unit(1.0, "")
        size, parts = _size_of(symbol)
        factor *= size**power
        for part, own in parts.items():
            total[part] = total.get(part, 0) + own * power
    return Unit(factor, _format_unit(total))


def same_quantity(one: str, other: str) -> bool | None:
    """
    :param one: a unit
    :param other: a unit
    :return: whether they are units of the same quantity: N m and kg m2/s2 are, 1/s and rad/s are
        not; None if one of them is unknown
    """
    dimensions = []
    for text in (one, other):
        unit = unit_of(text) if text else None
        if unit is None or not unit.name:
            return None
        total: dict[str, int] = {}
        for symbol, power in _parse(unit.name) or ():
            _, parts = _size_of(symbol)
            for part, own in parts.items():
                for base, times in _DERIVED.get(part, {part: 1}).items():
                    total[base] = total.get(base, 0) + own * times * power
        dimensions.append({base: power for base, power in total.items() if power})
    return dimensions[0] == dimensions[1]


def _parse(text: str) -> list[tuple[str, int]] | None:
    """:return: known symbols with their powers; None if the text is not a product of them"""
    written = text.strip().strip("[]<>{}").strip()
    if written.startswith("(") and written.endswith(")"):
        written = written[1:-1].strip()
    for old, new in _SPELLINGS.items():
        written = written.replace(old, new)
    written = re.sub(r"/\(([^()]*)\)", lambda m: "/" + "/".join(m[1].split()), written)
    found: list[tuple[str, int]] = []
    for i, product in enumerate(written.split("/")):
        factors = re.split(r"[\s.]+", product.strip())
        if i and len(factors) > 1:
            return None  # W/m2 K is ambiguous
        for factor in factors:
            match = _SYMBOL_AND_POWER.fullmatch(factor)
            symbol = match and _symbol(match[1])
            if match is None or symbol is None:
                return None
            found.append((symbol, (-1 if i else 1) * int(match[2] or 1)))
    return found


def _symbol(name: str) -> str | None:
    """:return: the symbol in the table, with its prefix; None if there is none"""
    # Case matters in short names: NM is not nm.
    words = (name, name.lower(), name.lower().removesuffix("s")) if len(name) > 2 else (name,)
    for word in words:
        if word in _UNITS or word in _COUNTS:
            return word
        if word in _SYNONYMS:
            return _SYNONYMS[word]
    return name if name[:1] in _PREFIXES and name[1:] in _WITH_PREFIX.split() else None


def _size_of(symbol: str) -> tuple[float, Mapping[str, int]]:
    if symbol in _UNITS:
        return _UNITS[symbol]
    size, parts = _UNITS[symbol[1:]]
    return _PREFIXES[symbol[0]] * size, parts


def _format_unit(powers: Mapping[str, int]) -> str:
    """``"N m s/rad"`` of ``{"N": 1, "m": 1, "s": 1, "rad": -1}``."""
    above, below = [], []
    for symbol in _ORDER:
        power = powers.get(symbol, 0)
        name = symbol if abs(power) == 1 else f"{symbol}{abs(power)}"
        if power:
            (above if power > 0 else below).append(name)
    return "/".join([" ".join(above) or "1", *below])
