"""Joints, actuators and observation channels, with the names and units that every table prints."""

from typing import NamedTuple


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
