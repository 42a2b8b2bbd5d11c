r"""
Bayesian update of the answers that earlier data left open, by new recordings.

Answer :math:`m` predicts it in windows, each from a start state :math:`x_k` of its own, with
parameters :math:`\theta_m + L_m z`; given the earlier data, :math:`z` is standard normal. Its
likelihood is that of the best :math:`z` and :math:`x`, times the volume of nearly as good
:math:`z` (Laplace's approximation):

.. math::
   -2 \log p_m = \min_{z, x} \frac{1}{c} \sum_k \left\| \frac{y_m(z, x_k) - y}{\sigma} \right\|^2
   + \|z\|^2 + \log\det H,

:math:`H` half of its second derivative by :math:`z`, start states eliminated, and :math:`c` the
number of rows for each independent one.
"""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from sb3_hds.core import Trajectories, Twin
from sb3_hds.sysid.belief.answers import Answer, Answers, bounds_of, union
from sb3_hds.sysid.estimation.shooting import (
    Shots,
    eliminate_start,
    n_free,
    shots_of,
    simulate,
    with_slopes,
)
from sb3_hds.sysid.measurements import check_fits

# Gauss-Newton steps, and the threshold of Huber's loss, in units of the noise.
_STEPS, _HUBER = 8, 3.0


def updated(answers: Answers, data: Trajectories) -> Answers:
    """
    :param answers: that earlier data left open
    :param data: recorded since, sampled at the interval of the twins
    :return: the same answers, their weights and parameters as all data have them, likeliest first
    :raises CalibrationError: for other channels or another interval than the twin's
    :raises TrajectoryError: if no recording is long enough
    """
    twin, values, factor = union(answers.answers)
    check_fits(twin, data)
    length = min(answers.window, int(data.lengths.max()))
    shots, _ = shots_of(data, length, twin)
    low, high = bounds_of(twin)
    with jax.enable_x64(True):
        fit = jax.jit(partial(_fitted, twin, shots, answers.noise, answers.correlated))
        fitted = [jax.tree.map(np.asarray, fit(*one)) for one in zip(values, factor, strict=True)]
    found = []
    for answer, value, own, (cost, z, curvature) in zip(
        answers.answers, values, factor, fitted, strict=True
    ):
        theta = np.clip(value + own @ z, low, high)
        narrower = np.linalg.cholesky(np.linalg.inv(curvature))
        cost = float(cost) + float(np.linalg.slogdet(curvature)[1])
        cost = cost if np.isfinite(cost) else np.inf
        found.append(_answer(answer, twin, theta, own @ narrower, answer.log_weight - 0.5 * cost))
    found.sort(key=lambda answer: -answer.log_weight)
    return dataclasses.replace(answers, answers=tuple(found))


def _answer(
    answer: Answer, twin: Twin, theta: np.ndarray, factor: np.ndarray, log_weight: float
) -> Answer:
    names = list(twin.parameters)
    own = {name: float(theta[names.index(name)]) for name in answer.twin.parameters}
    rows = {name: factor[names.index(name)] for name in answer.factor}
    return Answer(answer.causes, answer.twin.with_parameters(**own), rows, log_weight)


def _fitted(
    twin: Twin, shots: Shots, noise: np.ndarray, correlated: float, values: Array, factor: Array
) -> tuple[Array, Array, Array]:
    """
    :return: twice the negative logarithm of the likelihood, without the volume; parameters in units
        of their deviations, shape ``(k,)``; and :math:`H`, shape ``(k, k)``
    """
    names, n_z, n_x = tuple(twin.parameters), factor.shape[1], n_free(twin)

    def errors(shot: Shots, both: Array) -> Array:
        vector = values + factor @ both[:n_z]
        params = {name: vector[i] for i, name in enumerate(names)} | dict(twin.tensors)
        missed = (simulate(twin, params, shot, both[n_z:]) - shot.obs) / noise
        # Huber's loss: small errors of the model must not decide.
        size = jnp.abs(missed)
        far = jnp.sqrt(_HUBER * (2.0 * jnp.maximum(size, _HUBER) - _HUBER))
        return jnp.where(size > _HUBER, jnp.sign(missed) * far, missed).ravel()

    def window(shot: Shots, x: Array, z: Array) -> tuple[Array, ...]:
        now, slopes = with_slopes(partial(errors, shot), jnp.concatenate([z, x]))
        own, along, moves = eliminate_start(now, slopes, n_z)
        return now @ now, along.T @ own, along.T @ along, moves

    def normal(z: Array, x: Array) -> tuple[Array, Array, Array, Array]:
        costs, scores, curvatures, moves = jax.vmap(window, (0, 0, None))(shots, x, z)
        cost = jnp.sum(costs) / correlated + z @ z
        score = jnp.sum(scores, 0) / correlated + z
        return cost, score, jnp.sum(curvatures, 0) / correlated + jnp.eye(n_z), moves

    def improve(_: Array, now: tuple[Array, Array]) -> tuple[Array, Array]:
        z, x = now
        _, score, curvature, moves = normal(z, x)
        step = -jnp.linalg.solve(curvature, score)
        way = -moves[..., 0] - jnp.einsum("kxz,z->kx", moves[..., 1:], step)
        shares = jnp.array([1.0, 0.3, 0.0])
        costs = jax.vmap(lambda s: normal(z + s * step, x + s * way)[0])(shares)
        best = shares[jnp.argmin(jnp.where(jnp.isfinite(costs), costs, jnp.inf))]
        return z + best * step, x + best * way

    start = jnp.zeros(n_z), jnp.zeros((shots.n, n_x))
    z, x = jax.lax.fori_loop(0, _STEPS, improve, start)
    cost, _, curvature, _ = normal(z, x)
    return cost, z, curvature
