"""MuJoCo's engine, and validation of the physical parameters of the tasks that it simulates."""

import math
from typing import Any

import mujoco

# The type stubs of MuJoCo lack its functions.
engine: Any = mujoco


def check_quantity(
    name: str, value: float, positive: bool = False, maximum: float = math.inf
) -> float:
    """
    :param positive: whether zero is refused too
    :param maximum: largest value accepted
    :return: the value as a float
    :raises ValueError: for a value that is not finite, negative or too large
    """
    value = float(value)
    if not math.isfinite(value) or value < 0.0 or (positive and value == 0.0) or value > maximum:
        least = "above 0" if positive else "at least 0"
        limit = "" if maximum == math.inf else f" and at most {maximum}"
        raise ValueError(f"{name} must be finite, {least}{limit}, got {value}.")
    return value
