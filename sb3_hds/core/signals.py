"""What moves, what drives it, what is measured. Names and units are data: every table has them."""

from typing import NamedTuple


class Joint(NamedTuple):
    """
    One degree of freedom.

    :param name: unique within the twin
    :param unit: unit of its position: ``"rad"`` for a hinge, ``"m"`` for a slider
    :param low: where a stop of the machine begins that the twin does not simulate
    :param high: likewise
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
