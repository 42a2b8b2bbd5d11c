"""Errors raised on purpose: each message says what was expected, what came, and the way out."""

import difflib
from collections.abc import Iterable, Sequence
from typing import Any


class SB3HDSError(Exception):
    """Base of every error below."""


class NoTwinError(SB3HDSError, LookupError):
    """No twin is registered for an environment or a name."""


class TwinError(SB3HDSError, ValueError):
    """A twin does not keep the contract: a declaration, or what a method returns, is wrong."""


class ParameterError(SB3HDSError, ValueError):
    """A physical parameter is unknown, out of its bounds, or not finite."""


class ModelFileError(SB3HDSError, ValueError):
    """The model file of a robot cannot be read, or asks for what its twin cannot simulate."""


class EffectError(SB3HDSError, ValueError):
    """An effect cannot be attached to a twin."""


class TrajectoryError(SB3HDSError, ValueError):
    """Measured or simulated data have the wrong shape, sampling or content."""


class CalibrationError(SB3HDSError, ValueError):
    """A calibration cannot be carried out."""


class RewardError(SB3HDSError, ValueError):
    """A reward gives planning nothing to climb."""


class EnvironmentMismatchError(SB3HDSError, ValueError, AssertionError):
    """
    An environment, as wrapped, is not what its twin simulates, or what an algorithm takes.

    It is an ``AssertionError``, too, because that is what SB3 raises for spaces that do not fit.
    """


class SafetyError(SB3HDSError, RuntimeError):
    """A safety layer cannot keep what it promises: what it assumes does not hold."""


class ExportError(SB3HDSError, ValueError):
    """A policy cannot be exported, or a file that was exported cannot be run."""


class StudyError(SB3HDSError, ValueError):
    """A study asks for what does not exist, or for a folder that is taken."""


class DivergedError(SB3HDSError, FloatingPointError, ValueError):
    """
    Learning diverged.

    It is a ``ValueError``, too, because RL Zoo gives up one trial of a search for that, and the
    whole search for other errors.
    """


class SeedsDivergedError(DivergedError):
    """
    Some of several seeds that learned side by side diverged.

    :param models: by their seeds, of those that did not
    :param episodes: of the same, what :func:`~sb3_hds.algos.learn_compiled` returns
    """

    def __init__(self, message: str, models: dict[int, Any], episodes: dict[int, Any]) -> None:
        super().__init__(message)
        self.models, self.episodes = models, episodes


def did_you_mean(name: str, known: Iterable[str], *, cutoff: float = 0.6) -> str:
    """
    :param cutoff: how like each other two names must be, of ``difflib``, in [0, 1]
    :return: to end a message with: a question, after a space, or nothing, if no name is close
    """
    close = difflib.get_close_matches(name, list(known), 1, cutoff)
    return f" Did you mean '{close[0]}'?" if close else ""


def first_names(names: Sequence[str], n: int = 3) -> str:
    """:return: the first ``n`` names, and how many more there are"""
    more = f" and {len(names) - n} more" if len(names) > n else ""
    return ", ".join(names[:n]) + more
