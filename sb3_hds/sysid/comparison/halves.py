"""Half of the recordings propose, the others confirm: models and candidates on both halves."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

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

    def errors(self, point: Point) -> Float[np.ndarray, " n"]:
        """:return: mean square error of each window, that of practical equivalence added"""
        noise = self.evidence.noise
        errors = np.mean((point.raw / noise) ** 2, (1, 2))
        errors = np.nan_to_num(errors, nan=NOT_FINITE, posinf=NOT_FINITE)
        return errors + float(np.mean((self.irrelevant / noise) ** 2))

    def total(self, point: Point) -> float:
        return float(self.errors(point).sum())


class Base(NamedTuple):
    """
    The current model: the nominal one with the causes accepted so far.

    :param point: fitted to the windows for selection
    :param kept: the same parameters on the other windows, start states refitted
    :param free: indices of the parameters that are refitted under every hypothesis
    """

    point: Point
    kept: Point
    free: tuple[int, ...]


class Tried(NamedTuple):
    """
    The current model with one more candidate.

    :param candidate: which
    :param point: the best that was found on the windows for selection
    :param kept: the same parameters on the other windows, start states refitted
    :param criterion: by which the information criterion is lower than without it
    """

    candidate: Candidate
    point: Point
    kept: Point
    criterion: float


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
