"""Half of the recordings propose, the others confirm: models and candidates on both halves."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from sb3_hds.sysid.comparison.held_out import Comparison
from sb3_hds.sysid.estimation.candidates import Candidate
from sb3_hds.sysid.estimation.evidence import Evidence, Point

# Mean square error of a window that cannot be simulated, in units of the noise.
NOT_FINITE = 1e8


class Half(NamedTuple):
    """
    :param evidence: windows of one half of the recordings
    :param cluster: cluster of correlated errors that each window belongs to, shape ``(n,)``
    :param irrelevant: region of practical equivalence: error of each channel that is too small to
        matter, shape ``(n_obs,)``
    """

    evidence: Evidence
    cluster: Int[np.ndarray, " n"]
    irrelevant: Float[np.ndarray, " obs"]

    def errors(
        self, point: Point, channels: Sequence[int] | None = None
    ) -> Float[np.ndarray, " n"]:
        """
        :param channels: indices of those that count; default: all
        :return: mean square error of each window, that of practical equivalence added
        """
        own = slice(None) if channels is None else list(channels)
        noise = self.evidence.noise[own]
        errors = np.mean((point.residual[..., own] / noise) ** 2, (1, 2))
        errors = np.nan_to_num(errors, nan=NOT_FINITE, posinf=NOT_FINITE)
        return errors + float(np.mean((self.irrelevant[own] / noise) ** 2))

    def total(self, point: Point) -> float:
        return float(self.errors(point).sum())


class Base(NamedTuple):
    """
    The current model: the nominal one with the causes accepted so far.

    :param point: fitted to the windows for selection
    :param held_out: the same parameters on the other windows, start states refitted
    :param free: indices of the parameters that are refitted under every hypothesis
    """

    point: Point
    held_out: Point
    free: tuple[int, ...]


class Tried(NamedTuple):
    """
    The current model with one more candidate.

    :param candidate: which
    :param point: the best that was found on the windows for selection
    :param held_out: the same parameters on the other windows, start states refitted
    :param criterion: by which the information criterion is lower than without it
    """

    candidate: Candidate
    point: Point
    held_out: Point
    criterion: float


class Accepted(NamedTuple):
    """
    A cause that was confirmed.

    :param alternatives: keys of candidates that the data cannot distinguish from it
    :param family_p_value: family-wise p-value: that the best of all candidates gains as much if
        nothing is wrong
    :param share: of the force at its joint that it carries; None where that is not known
    :param sizes: estimate and interval of the equation of motion by parameter, where there are any
    :param of_equation: whether these are told, rather than those of a simulation
    :param doubts: by parameter, half the width of an interval that comes from not knowing whether
        there is one cause more
    :param rivals: the alternatives as they were fitted, those that were simulated
    """

    tried: Tried
    comparison: Comparison
    alternatives: tuple[str, ...]
    family_p_value: float
    share: float | None = None
    sizes: Mapping[str, tuple[float, float, float]] = {}
    of_equation: bool = False
    doubts: Mapping[str, float] = {}
    rivals: tuple[Tried, ...] = ()


class Effort(NamedTuple):
    """
    :param guessed: candidates that one Newton step must favour to be fitted at all
    :param finalists: candidates that are fitted to the end
    :param windows: most windows on which the others are compared
    :param steps: of the fits that choose the finalists
    :param profiles: whether intervals follow the likelihood, or are symmetric
    """

    guessed: int
    finalists: int
    windows: int
    steps: int
    profiles: bool


def has_more_freedom(one: Tried, other: Tried) -> bool:
    return len(one.candidate.parameters) > len(other.candidate.parameters)
