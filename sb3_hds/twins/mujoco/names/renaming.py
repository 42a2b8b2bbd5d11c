"""Joints with other prefixes in a log than in the model: ``fer_joint1`` and ``panda_joint1``."""

import itertools
from collections.abc import Iterable, Mapping, Sequence
from difflib import SequenceMatcher
from typing import NamedTuple

from sb3_hds.twins.mujoco.names.words import Parsed, Signal

Words = tuple[str, ...]

_FEWEST_JOINTS = 2
# Words that distinguish parts of one machine, which may have joints of the same names.
_SIDES = {"left", "right", "l", "r", "front", "rear", "back", "hind", "fore", "upper", "lower"}
_SIDES |= {"inner", "outer", "top", "bottom", "fl", "fr", "rl", "rr", "lf", "rf", "lh", "rh"}
# Words of this similarity or more are spellings of each other.
_ALIKE = 0.75


class Affixes(NamedTuple):
    """Words before and after those that distinguish the joints."""

    before: Words
    after: Words

    def around(self, core: Words) -> Words:
        return (*self.before, *core, *self.after)

    def __str__(self) -> str:
        between = "..." if all(self) else ""
        return "_".join((*self.before, "")) + between + "_".join(("", *self.after))

    @property
    def places(self) -> tuple[frozenset[str], frozenset[str]]:
        """:return: numbers, and words that name a side"""
        words = {*self.before, *self.after}
        return frozenset(filter(str.isdigit, words)), frozenset(words & _SIDES)


class Renaming(NamedTuple):
    """
    :param columns: of each signal; None without any
    :param sentence: what was taken away from the names
    """

    columns: tuple[str | None, ...]
    sentence: str


def renamed(signals: Sequence[Signal], parsed: Mapping[str, Parsed]) -> Renaming | None:
    """
    Match columns by what distinguishes the joints of a model, without the words that all of these
    have in common, if that leads to a single answer.

    All columns must have the same other words. These must not contradict the words taken away from
    the joints by another number or side: ``arm2_joint1`` is not ``arm1_joint1``. Nor may there be
    a further column of the same form: seven joints are none of ``joint1`` to ``joint8``.

    :param signals: of the twin
    :param parsed: names of columns
    """
    names = dict.fromkeys(Parsed.of(signal.joint).joint for signal in signals)
    own = common_affixes(names)
    if len(names) < _FEWEST_JOINTS or not any(own):
        return None
    cores = {name: name[len(own.before) : len(name) - len(own.after)] for name in names}
    found = []
    for affixes in _possible(cores.values(), parsed.values()):
        if _contradict(own, affixes) or _another(affixes, cores.values(), parsed.values()):
            continue
        columns = tuple(
            _column_of(affixes.around(cores[Parsed.of(signal.joint).joint]), signal, parsed)
            for signal in signals
        )
        hits = [s.joint for s, column in zip(signals, columns, strict=True) if column is not None]
        if len(set(hits)) >= _FEWEST_JOINTS:
            found.append((len(hits), columns, affixes))
    most = max((n for n, *_ in found), default=0)
    best = [(columns, affixes) for n, columns, affixes in found if n == most]
    if len(best) != 1:
        return None
    [(columns, affixes)] = best
    pairs = zip(signals, columns, strict=True)
    signal, column = next((s, column) for s, column in pairs if column is not None)
    without = " and ".join(f"'{shown}'" for shown in map(str, (affixes, own)) if shown)
    return Renaming(
        columns,
        f"Columns are matched by the joints' names without {without}: '{column}' is {signal.name}.",
    )


def common_affixes(names: Iterable[Words]) -> Affixes:
    """:return: the words that all names begin and end with; each name keeps at least one word"""
    every = list(names)
    before = _common(every)
    rest = [name[len(before) :][::-1] for name in every]
    return Affixes(before, _common(rest)[::-1])


def likeness(joint: Words, column: Words) -> float:
    """:return: the share of a joint's words that a column's name has, alike or similarly spelt"""
    if not joint:
        return 0.0
    return sum(max((_alike(a, b) for b in column), default=0.0) for a in joint) / len(joint)


def form(core: Words) -> Words:
    """:return: the words with any number for a number"""
    return tuple("0" if word.isdigit() else word for word in core)


def _common(names: Sequence[Words]) -> Words:
    shortest = min(map(len, names), default=0)
    same = itertools.takewhile(lambda words: len(set(words)) == 1, zip(*names, strict=False))
    return tuple(words[0] for words in same)[: max(shortest - 1, 0)]


def _possible(cores: Iterable[Words], columns: Iterable[Parsed]) -> list[Affixes]:
    """All affixes with which a column has the words of a joint."""
    found: dict[Affixes, None] = {}
    words = {column.joint for column in columns}
    for core, name in itertools.product(dict.fromkeys(cores), sorted(words)):
        n = len(core)
        for i in range(len(name) - n + 1):
            if name[i : i + n] == core:
                found[Affixes(name[:i], name[i + n :])] = None
    return list(found)


def _contradict(one: Affixes, other: Affixes) -> bool:
    """Whether both name a number or a side, and not the same."""
    pairs = zip(one.places, other.places, strict=True)
    return any(a and b and a != b for a, b in pairs)


def _another(affixes: Affixes, cores: Iterable[Words], columns: Iterable[Parsed]) -> bool:
    """Whether a column with these affixes differs from those of all joints by a number only."""
    own = set(cores)
    forms = {form(core) for core in own}
    n_before, n_after = len(affixes.before), len(affixes.after)
    for name in {column.joint for column in columns}:
        core = name[n_before : len(name) - n_after]
        if core and affixes.around(core) == name and core not in own and form(core) in forms:
            return True
    return False


def _column_of(words: Words, signal: Signal, parsed: Mapping[str, Parsed]) -> str | None:
    for kinds in signal.kinds:
        alike = [name for name, p in parsed.items() if p.kinds == kinds and p.joint == words]
        if alike:
            told = [name for name in alike if parsed[name].told or len(alike) == 1]
            return told[0] if len(told) == 1 else None
    return None


def _alike(one: str, other: str) -> float:
    if one == other or one.isdigit() or other.isdigit():
        return float(one == other)
    ratio = SequenceMatcher(None, one, other).ratio()
    return ratio if ratio >= _ALIKE else 0.0
