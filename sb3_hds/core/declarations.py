"""What a twin declares: joints, actuators, observation channels and physical parameters."""

import dataclasses
import math
from typing import Any, NamedTuple

from sb3_hds.errors import ParameterError

_PRISMATIC_UNIT = {
    "N m": "N",
    "N m s/rad": "N s/m",
    "N m s2/rad2": "N s2/m2",
    "N m/rad": "N/m",
    "N m/rad3": "N/m3",
    "rad": "m",
    "rad/s": "m/s",
}


class Joint(NamedTuple):
    """
    One degree of freedom.

    :param name: unique within the twin
    :param unit: unit of its position: ``"rad"`` for a hinge, ``"m"`` for a slider
    :param low: position of the lower end stop, which the twin does not simulate
    :param high: position of the upper end stop
    """

    name: str
    unit: str = "rad"
    low: float = float("-inf")
    high: float = float("inf")


class Actuator(NamedTuple):
    """
    One command.

    :param name: unique within the twin
    :param unit: unit of the command
    :param low: smallest command that the environment accepts
    :param high: largest command that the environment accepts
    """

    name: str
    unit: str
    low: float
    high: float


class Channel(NamedTuple):
    """
    One entry of the observation.

    :param name: unique within the twin
    :param unit: unit of the measurement
    :param low: smallest value that the observation space declares
    :param high: largest value that the observation space declares
    """

    name: str
    unit: str
    low: float = float("-inf")
    high: float = float("inf")


@dataclasses.dataclass(frozen=True)
class Parameter:
    """
    One unknown constant of a twin or an effect, with its prior and its bounds.

    :param null: nominal value; for an effect, the value at which it vanishes
    :param scale: typical deviation from ``null``, in the same unit; must be positive
    :param unit: SI unit, for example ``"N m s/rad"``; ``"1"`` if dimensionless
    :param lower: smallest admissible value
    :param upper: largest admissible value
    :raises ParameterError: if ``scale`` is not positive or ``null`` lies outside the bounds
    """

    null: float
    scale: float
    unit: str
    lower: float = -math.inf
    upper: float = math.inf

    def __post_init__(self) -> None:
        if not self.scale > 0.0:
            raise ParameterError(
                f"A parameter's scale must be positive, got {self.scale} {self.unit}."
            )
        if not self.lower <= self.null <= self.upper:
            raise ParameterError(
                f"A parameter's null value, {self.null} {self.unit}, must lie within its bounds "
                f"[{self.lower}, {self.upper}]."
            )

    def check(self, name: str, value: Any) -> float:
        """
        :return: ``value`` as a float
        :raises ParameterError: if it is not a finite number within the bounds
        """
        try:
            value = float(value)
        except (TypeError, ValueError):
            raise ParameterError(
                f"Parameter '{name}' must be a number [{self.unit}], got {value!r}."
            ) from None
        if not (math.isfinite(value) and self.lower <= value <= self.upper):
            raise ParameterError(
                f"Parameter '{name}' must be finite and within [{self.lower}, {self.upper}] "
                f"{self.unit}, got {value}."
            )
        return value

    def prismatic(self) -> "Parameter":
        """:return: the same parameter with its unit at a sliding joint"""
        return dataclasses.replace(self, unit=_PRISMATIC_UNIT.get(self.unit, self.unit))
