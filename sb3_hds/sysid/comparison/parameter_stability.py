"""Parameter-stability test: is a parameter the same at every position, speed and time?"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Float

from sb3_hds.sysid.comparison.held_out import STRICTER
from sb3_hds.sysid.comparison.inference import RANK
from sb3_hds.sysid.comparison.unexplained import ResidualForce, ShortWindows

# Waves over the ranks of a quantity with which a size may change, and the level at which it does.
_WAVES, _LEVEL = 4, 0.01
# Least share of the information that remains when one window is left out.
_LEAST_OF_OTHERS = 1e-9


class Change(NamedTuple):
    """
    :param goes_with: quantity on which the parameter depends
    :param p_value: p-value of the hypothesis that it is constant
    :param gain: decrease of the cost (minus log likelihood) if it may change
    """

    goes_with: str
    p_value: float
    gain: float


def change(
    short: ShortWindows, residual: ResidualForce, own: Sequence[int], free: Sequence[int]
) -> Change | None:
    r"""
    A score test. Let a parameter :math:`\theta_i` become :math:`\theta_i + \sum_k c_k b_k(z)` with
    waves :math:`b_k` over the ranks of a quantity :math:`z`. If it is constant, the slope of the
    cost by each :math:`c_k`, with all that was fitted eliminated, has the mean zero; its variance
    is that of the windows' slopes where the :math:`c_k` are fitted, so that the change itself does
    not count as noise, each window left out of its own fit; the F distribution knows how many
    windows tell of the change. A cause that is merely the nearest name, as dry friction is for
    one that depends on position, fails this test long before its residual is detectable.

    Source: Hansen, *Testing for parameter instability in linear models*, J. Policy Modeling 14(4),
    1992; Zeileis and Hornik, *Generalized M-fluctuation tests for parameter instability*,
    Statistica Neerlandica 61(4), 2007 (scores ordered by any quantity).

    :param residual: of the same windows
    :param own: indices of the parameters of the cause
    :param free: indices of all that was fitted, these among them
    :return: the quantity on which it depends most; None if the parameters are constant
    """
    slopes = short.evidence.slopes(short.point, free)
    quantities = list(_quantities(residual))
    n_tests, found = len(own) * len(quantities), []
    for parameter in (list(free).index(i) for i in own):
        for name, values in quantities:
            tested = _tested(slopes.curvature, slopes.scores, parameter, _waves(values))
            found.append(Change(name, min(STRICTER * n_tests * tested.p_value, 1.0), tested.gain))
    sure = [one for one in found if one.p_value < _LEVEL]
    return max(sure, key=lambda one: one.gain, default=None)


class _Tested(NamedTuple):
    p_value: float
    gain: float


def _tested(
    curvature: Float[np.ndarray, "n f f"],
    scores: Float[np.ndarray, "n f"],
    parameter: int,
    waves: Float[np.ndarray, "n k"],
) -> _Tested:
    at = parameter
    whole = np.linalg.pinv(curvature.sum(0), rcond=RANK, hermitian=True)
    cross = np.einsum("nf,nk->fk", curvature[:, :, at], waves)
    inner = np.einsum("n,nk,nl->kl", curvature[:, at, at], waves, waves)
    follows = whole @ cross
    free = np.linalg.pinv(inner - cross.T @ follows, rcond=RANK, hermitian=True)

    # How each window's scores change with the waves, the fitted parameters compensating.
    moves = np.zeros((*waves.shape, curvature.shape[1]))
    moves[:, :, at] = waves
    moves -= follows.T

    def by_window(scores: np.ndarray) -> np.ndarray:
        return np.einsum("nkf,nf->nk", moves, scores)

    slope = by_window(scores).sum(0)
    of_fitted, of_waves = -whole @ scores.sum(0), -free @ slope
    then = scores + curvature @ of_fitted + np.einsum("nfg,nkg,k->nf", curvature, moves, of_waves)
    left_out = np.einsum("nkf,nfg,nlg->nkl", moves, curvature, moves) @ free
    others = (1.0 + _LEAST_OF_OTHERS) * np.eye(waves.shape[1]) - left_out
    noise = np.linalg.solve(others, by_window(then)[..., None])[..., 0]
    statistic = float(slope @ np.linalg.pinv(noise.T @ noise, rcond=RANK, hermitian=True) @ slope)
    # Part of the gain is due to noise: as much as the waves gain of the statistic.
    n_waves, gained = waves.shape[1], float(slope @ free @ slope)
    real = max(1.0 - n_waves / statistic, 0.0) if statistic else 0.0
    # Number of windows of equal weight that would determine the waves as well.
    weight = np.einsum("nkk->n", left_out)
    equal = np.sum(weight) ** 2 / max(np.sum(weight**2), 1e-300)
    p_value = float(scipy.stats.f.sf(statistic / n_waves, n_waves, max(equal - n_waves, 1.0)))
    # Windows may scatter less than the noise, which contains a region of practical equivalence.
    p_value = max(p_value, float(scipy.stats.chi2.sf(gained, n_waves)))
    return _Tested(p_value, 0.5 * real * gained)


def _quantities(residual: ResidualForce) -> Iterator[tuple[str, np.ndarray]]:
    for joint in range(residual.position.shape[1]):
        yield "position", residual.position[:, joint]
        yield "velocity", residual.velocity[:, joint]
        yield "speed", np.abs(residual.velocity[:, joint])
    for actuator in range(residual.command.shape[1]):
        yield "command", residual.command[:, actuator]
    yield "time", residual.time


def _waves(values: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n k"]:
    """Cosines over the ranks: as many windows everywhere, whatever the quantity's distribution."""
    rank = (scipy.stats.rankdata(values) - 0.5) / len(values)
    return np.cos(np.pi * np.outer(rank, np.arange(1, _WAVES + 1)))
