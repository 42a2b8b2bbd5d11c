"""Validation of the physical parameters of environments that stand in for hardware."""

import math


def checked(name: str, value: float, positive: bool = False, most: float = math.inf) -> float:
    """
    :param positive: whether zero is refused too
    :param most: largest value accepted
    :raises ValueError: for a value that is not finite, negative or too large
    """
    value = float(value)
    if not math.isfinite(value) or value < 0.0 or (positive and value == 0.0) or value > most:
        least = "above 0" if positive else "at least 0"
        limit = "" if most == math.inf else f" and at most {most}"
        raise ValueError(f"{name} must be finite, {least}{limit}, got {value}.")
    return value
