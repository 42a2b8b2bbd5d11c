"""Angles that wrap."""

import numpy as np

# Usual steps around a whole turn.
_AROUND = 5.0


def whole_turns(jumps: np.ndarray, usual: np.ndarray) -> np.ndarray:
    """
    :param jumps: from sample to sample [rad]
    :param usual: typical size of a jump, one for all or one for each channel
    :return: which of the jumps are whole turns of a wrapped angle
    """
    turns = np.round(np.abs(jumps) / (2.0 * np.pi))
    return (turns > 0) & (np.abs(np.abs(jumps) - 2.0 * np.pi * turns) < _AROUND * usual)


def unwrapped(x: np.ndarray) -> np.ndarray:
    """Unwrap values that look like a wrapped angle [rad] or [deg]."""
    for turn in (2.0 * np.pi, 360.0):
        wraps = np.abs(np.abs(np.diff(x)) - turn) < turn / (2.0 * np.pi)
        if wraps.any() and np.ptp(x) < 1.05 * turn:
            return np.unwrap(x, period=turn)
    return x
