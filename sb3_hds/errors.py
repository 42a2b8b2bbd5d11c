"""Exceptions: each message says what was expected, what was found, and what to do about it."""

import difflib
from collections.abc import Iterable, Sequence
from typing import Any


class SB3HDSError(Exception):
    """Base class of all exceptions of this package."""


class NoTwinError(SB3HDSError, LookupError):
    """No twin is registered for an environment or a name."""


class TwinError(SB3HDSError, ValueError):
    """A declaration of a twin, or a return value of one of its methods, is wrong."""


class ParameterError(SB3HDSError, ValueError):
    """A physical parameter is unknown, out of its bounds, or not finite."""


class ModelFileError(SB3HDSError, ValueError):
    """A robot's model file cannot be read, or has features that its twin cannot simulate."""


class EffectError(SB3HDSError, ValueError):
    """An effect cannot be attached to a twin."""


class TrajectoryError(SB3HDSError, ValueError):
    """Measured or simulated data have the wrong shape, sampling or content."""


class CalibrationError(SB3HDSError, ValueError):
    """A calibration cannot be carried out."""


class RewardError(SB3HDSError, ValueError):
    """A reward has no gradient for planning."""


class EnvironmentMismatchError(SB3HDSError, ValueError, AssertionError):
    """
    An environment or its wrappers do not match the twin or the algorithm.

    It is an ``AssertionError``, too, because SB3 raises that for unsupported spaces.
    """


class SafetyError(SB3HDSError, RuntimeError):
    """An assumption of a safety layer does not hold, so it cannot guarantee safety."""


class ExportError(SB3HDSError, ValueError):
    """A policy cannot be exported, or an exported file cannot be run."""


class StudyError(SB3HDSError, ValueError):
    """A study names something that does not exist, or a folder that is in use."""


class DivergedError(SB3HDSError, FloatingPointError, ValueError):
    """
    Learning diverged.

    It is a ``ValueError``, too, because RL Zoo ends only the trial of a search for that, and the
    search for other errors.
    """


class SeedsDivergedError(DivergedError):
    """
    Some of several seeds that were trained in parallel diverged.

    :param models: by seed, those that did not diverge
    :param episodes: by seed, their return value of :func:`~sb3_hds.algos.learn_compiled`
    """

    def __init__(self, message: str, models: dict[int, Any], episodes: dict[int, Any]) -> None:
        super().__init__(message)
        self.models, self.episodes = models, episodes


def did_you_mean(name: str, known: Iterable[str], *, cutoff: float = 0.6) -> str:
    """
    :param cutoff: least similarity of two names by ``difflib``, in [0, 1]
    :return: a question for the end of a message, after a space; empty if no name is close
    """
    close = difflib.get_close_matches(name, list(known), 1, cutoff)
    return f" Did you mean '{close[0]}'?" if close else ""


def first_names(names: Sequence[str], n: int = 3) -> str:
    """:return: the first ``n`` names, and how many more there are"""
    more = f" and {len(names) - n} more" if len(names) > n else ""
    return ", ".join(names[:n]) + more
