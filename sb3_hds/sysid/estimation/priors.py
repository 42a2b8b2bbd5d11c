"""What is believed of a parameter that data refit: a prior, and bounds that physics sets."""

import math
from typing import NamedTuple, TypeAlias

from sb3_hds.core import Parameter
from sb3_hds.errors import CalibrationError

# A value that is off by more than this factor belongs to another machine, or to a wrong model.
_FACTOR = 20.0
# Least standard deviation of a prior, as a share of the value.
_SHARE = 0.2

#: None for the default prior, a factor that widens it, or a pair of hard bounds
Belief: TypeAlias = float | tuple[float, float] | None


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
    larger than the parameter's null, and a fifth of the value at least. Where nothing else is said,
    a value that is not zero stays within a factor of 20.

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
    :return: within a factor of 20 of the value, unless the parameter is bounded more closely; what
        may as well not be there, such as friction, may vanish
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
    :return: whether a refitted value stands at a bound that is neither zero (a machine without
        friction, a load that is not there) nor where it was believed to be
    """
    reach = 1e-6 * max(abs(lower if math.isfinite(lower) else 0.0), abs(value), 1e-300)
    near = [bound for bound in (lower, upper) if abs(value - bound) <= reach]
    return any(bound not in (0.0, believed) for bound in near)
