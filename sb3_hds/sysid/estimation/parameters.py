"""Parameters that are estimated: which are free or tied, their priors and their bounds."""

import math
from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float

from sb3_hds.core import Parameter, Twin
from sb3_hds.effects import force_of
from sb3_hds.errors import CalibrationError

#: parameters, by the name of the value that they take: mostly one, by its own name
Free = Mapping[str, tuple[str, ...]]
# A value that is wrong by more than this factor belongs to another machine or a wrong model.
_FACTOR = 20.0
# Least standard deviation of a prior, as a share of the value.
_SHARE = 0.2

#: None for the default prior, a factor that widens it, or a pair of hard bounds
Belief: TypeAlias = float | tuple[float, float] | None


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


def untied(names: Iterable[str]) -> Free:
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


def nominal_values(twin: Twin, free: Free) -> Float[np.ndarray, " p"]:
    """:return: what the twin has for them"""
    return np.array([twin.values[members[0]] for members in free.values()], float)


def one_each(groups: Iterable[tuple[str, ...]], values: Any) -> dict[str, Any]:
    """:return: the value of each parameter, given one for each group"""
    return {name: x for group, x in zip(groups, values, strict=True) for name in group}


class Prior(NamedTuple):
    """
    :param deviation: standard deviation of a normal prior around the twin's value
    :param lower: smallest admissible value
    :param upper: largest admissible value
    """

    deviation: float
    lower: float
    upper: float


def prior_of(name: str, parameter: Parameter, value: float, belief: Belief = None) -> Prior:
    """
    The prior of a parameter that is refitted.

    Its standard deviation is the parameter's ``scale``, in proportion to the value where that is
    larger than the parameter's null, and at least a fifth of the value. By default, a value other
    than zero stays within a factor of 20.

    :param name: of the parameter, for messages
    :param parameter: unit, scale and bounds
    :param value: of the twin
    :param belief: a factor by which the standard deviation is widened, or hard bounds ``(low,
        high)``, in the unit of the parameter, that contain the value
    :raises CalibrationError: for a belief that is neither
    """
    larger = abs(value / parameter.null) if parameter.null else 1.0
    deviation = max(parameter.scale * max(1.0, larger), _SHARE * abs(value))
    lower, upper = limits_of(parameter, value)
    if isinstance(belief, tuple | list):
        if len(belief) != 2 or not belief[0] <= value <= belief[1]:
            raise CalibrationError(
                f"Bounds of {name} must be a pair (low, high) around its value, {value:g} "
                f"{parameter.unit}, got {belief!r}."
            )
        lower, upper = max(belief[0], parameter.lower), min(belief[1], parameter.upper)
    elif belief is not None:
        if isinstance(belief, bool) or not (isinstance(belief, int | float) and 0 < belief < 1e9):
            raise CalibrationError(
                f"The prior of {name} is widened by a positive factor, or bounded by a pair (low, "
                f"high) in {parameter.unit}, got {belief!r}."
            )
        deviation *= belief
    return Prior(deviation, lower, upper)


def limits_of(parameter: Parameter, value: float) -> tuple[float, float]:
    """
    :return: bounds within a factor of 20 of the value, or those of the parameter if they are
        tighter; a parameter whose null is zero, such as friction, may vanish
    """
    if value == 0.0:
        return parameter.lower, parameter.upper
    small, large = abs(value) / _FACTOR, abs(value) * _FACTOR
    if parameter.null == 0.0:
        small = 0.0
    if parameter.lower >= 0.0:
        return max(parameter.lower, small), min(parameter.upper, large)
    return max(parameter.lower, -large), min(parameter.upper, large)


def at_limit(value: float, lower: float, upper: float, believed: float) -> bool:
    """
    :return: whether a refitted value is at a bound that is neither zero (a machine without friction
        or load) nor its nominal value
    """
    reach = 1e-6 * max(abs(lower if math.isfinite(lower) else 0.0), abs(value), 1e-300)
    near = [bound for bound in (lower, upper) if abs(value - bound) <= reach]
    return any(bound not in (0.0, believed) for bound in near)
