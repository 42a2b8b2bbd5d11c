"""Which parameters of a twin are estimated, and which of them take one value."""

from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from sb3_hds.core import Twin
from sb3_hds.effects import force_of
from sb3_hds.errors import CalibrationError

#: parameters, by the name of the value that they take: mostly one, by its own name
Free = Mapping[str, tuple[str, ...]]


def every_name(twin: Twin) -> tuple[str, ...]:
    """:return: names of all parameters but known ones and the share of a learned force"""
    force = force_of(twin)
    learned = () if force is None else (f"{force[0]}.share",)
    kept = {*learned, *twin.known_parameters}
    return tuple(name for name in twin.parameters if name not in kept)


def free_names(twin: Twin, free: Iterable[str] | None) -> tuple[str, ...]:
    """
    :param free: names of parameters; None for all but the share of a learned force
    :raises CalibrationError: for a name that the twin does not have, or none at all
    """
    names = every_name(twin) if free is None else (free,) if isinstance(free, str) else tuple(free)
    unknown = [name for name in names if name not in twin.parameters]
    if unknown or not names or len(set(names)) < len(names):
        known = ", ".join(twin.parameters) or "none"
        raise CalibrationError(
            f"free must name parameters of {twin.name}, each once, got {', '.join(names) or 'none'}"
            f". Its parameters are: {known}."
        )
    return names


def each(names: Iterable[str]) -> Free:
    """:return: every parameter by itself"""
    return {name: (name,) for name in names}


def tie(twin: Twin, names: Iterable[str], tied: Mapping[str, Iterable[str]]) -> Free:
    """
    :param names: of free parameters
    :param tied: parameters that take one value, by a name for it; they need not be free already
    :raises CalibrationError: for a parameter that the twin does not have or that is tied twice,
        units, bounds or values that differ, or a name that is a parameter's
    """
    ties = {name: tuple(members) for name, members in tied.items()}
    name_of = {member: name for name, group in ties.items() for member in group}
    times = Counter(member for group in ties.values() for member in group)
    wrong = [member for member in times if member not in twin.parameters or times[member] > 1]
    wrong += [name for name, group in ties.items() if name in twin.parameters or not group]
    if wrong:
        raise CalibrationError(
            "tied must give a name of its own to parameters of the twin, each tied once, got "
            f"{', '.join(wrong)}. {twin.name} has: {', '.join(twin.parameters)}."
        )
    for name, (first, *others) in ties.items():
        for other in others:
            if _alike(twin, first) != _alike(twin, other):
                raise CalibrationError(
                    f"{name} ties {first} to {other}, whose unit, bounds or value differ. Make "
                    "their values the same first, or leave one out."
                )
    labels = dict.fromkeys([*(name_of.get(name, name) for name in names), *ties])
    return {name: ties.get(name, (name,)) for name in labels}


def _alike(twin: Twin, name: str) -> tuple[str, float, float, float]:
    parameter = twin.parameters[name]
    return parameter.unit, parameter.lower, parameter.upper, twin.values[name]


def own_values(twin: Twin, free: Free) -> Float[np.ndarray, " p"]:
    """:return: what the twin has for them"""
    return np.array([twin.values[members[0]] for members in free.values()], float)


def one_each(groups: Iterable[tuple[str, ...]], values: Any) -> dict[str, Any]:
    """:return: the value of each parameter, given one for each group"""
    return {name: x for group, x in zip(groups, values, strict=True) for name in group}
