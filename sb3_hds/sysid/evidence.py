"""How well hypotheses explain windows of data: one compiled program for all of them."""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sb3_hds.core import Params, Twin
from sb3_hds.sysid.hypotheses import Hypotheses
from sb3_hds.sysid.shooting import Shots, n_free, simulate

# Beyond this, in units of the noise, an error counts in proportion, not by its square.
_HUBER = 3.0
# Stands for the error of a simulation that is not finite, in units of the noise.
_NOT_FINITE = 1e4
# Damping of the first step, relative to the curvature, and how it changes.
_DAMPING, _LESS, _MORE = 1e-2, 0.2, 5.0
# A step that lowers the cost by a smaller share than this is the last.
_ENOUGH = 1e-5
# Added to curvatures, relative to their trace, so that what moves nothing stays where it is.
_RIDGE = 1e-9


class Point(NamedTuple):
    """
    Parameters and start states, and what they leave unexplained.

    :param theta: all parameters that may move, shape ``(p,)``
    :param offsets: of the start states, shape ``(n, free)``
    :param errors: mean square over each window, in units of the noise, shape ``(n,)``
    :param raw: simulated minus measured, shape ``(n, steps + 1, n_obs)``
    """

    theta: np.ndarray
    offsets: np.ndarray
    errors: np.ndarray
    raw: np.ndarray


class Slopes(NamedTuple):
    """
    At a point, start states eliminated, parameters in units of their scale.

    :param curvature: of half the squared error of each window, shape ``(n, p, p)``
    :param scores: its slopes, shape ``(n, p)``
    """

    curvature: np.ndarray
    scores: np.ndarray


class Evidence:
    """
    Windows of data under the hypotheses.

    :param hypotheses: what may move
    :param shots: windows; those of weight zero do not count
    :param noise: of each channel, shape ``(n_obs,)``
    :param width: most parameters that move at a time
    """

    def __init__(
        self, hypotheses: Hypotheses, shots: Shots, noise: Float[np.ndarray, " obs"], width: int
    ) -> None:
        self.hypotheses, self.shots, self.noise, self.width = hypotheses, shots, noise, width

    def with_noise(self, noise: Float[np.ndarray, " obs"]) -> "Evidence":
        return Evidence(self.hypotheses, self.shots, noise, self.width)

    def on(self, shots: Shots) -> "Evidence":
        """:return: the same hypotheses on other windows, as many"""
        return Evidence(self.hypotheses, shots, self.noise, self.width)

    def fit(
        self,
        theta: Float[np.ndarray, " p"],
        moving: Sequence[int],
        offsets: Float[np.ndarray, "n free"] | None = None,
        n_steps: int = 15,
    ) -> Point:
        """
        Levenberg-Marquardt over the start states and some parameters, within their bounds.

        :param theta: where to begin
        :param moving: indices of the parameters that move; none: only start states do
        """
        h = self.hypotheses
        index = np.full(self.width, len(theta))
        index[: len(moving)] = list(moving)
        first = np.zeros((self.shots.n, n_free(h.twin))) if offsets is None else offsets
        with jax.enable_x64(True):
            given = map(jnp.asarray, (theta, index, first, self.noise, h.scale, h.lower, h.upper))
            found = _fit(
                h.twin,
                h.names,
                _doubles(h.twin.params),
                Shots(*map(jnp.asarray, self.shots)),
                n_steps,
                *given,
            )
            return Point(*map(np.asarray, found))

    def slopes(self, point: Point) -> Slopes:
        h = self.hypotheses
        with jax.enable_x64(True):
            given = map(jnp.asarray, (point.theta, point.offsets, self.noise, h.scale))
            found = _slopes(
                h.twin,
                h.names,
                _doubles(h.twin.params),
                Shots(*map(jnp.asarray, self.shots)),
                *given,
            )
            return Slopes(*map(np.asarray, found))


def _doubles(params: Params) -> Params:
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), params)


def _error(
    twin: Twin,
    names: tuple[str, ...],
    fixed: Params,
    noise: Array,
    theta: Array,
    offset: Array,
    shot: Shots,
) -> Float[Array, " residuals"]:
    params = fixed | {name: theta[i] for i, name in enumerate(names)}
    error = ((simulate(twin, params, shot, offset) - shot.obs) / noise).ravel()
    return shot.weight * jnp.where(jnp.isfinite(error), error, _NOT_FINITE)


def _weights(error: Array) -> Array:
    return jnp.minimum(1.0, _HUBER / jnp.maximum(jnp.abs(error), 1e-12))


def _cost(error: Array) -> Array:
    size = jnp.abs(error)
    small = jnp.minimum(size, _HUBER)
    return jnp.sum(0.5 * small**2 + _HUBER * (size - small))


class _Normal(NamedTuple):
    """Normal equations of one window, its start state eliminated."""

    curvature: Array
    score: Array
    from_score: Array
    from_step: Array


def _normal(error: Array, by_start: Array, by_theta: Array) -> _Normal:
    weight = _weights(error)[:, None]
    own = by_start.T @ (weight * by_start)
    own = own + (_RIDGE * jnp.trace(own) + 1e-300) * jnp.eye(own.shape[0])
    cross = by_start.T @ (weight * by_theta)
    right = by_start.T @ (weight[:, 0] * error)
    solved = jnp.linalg.solve(own, jnp.concatenate([right[:, None], cross], 1))
    curvature = by_theta.T @ (weight * by_theta) - cross.T @ solved[:, 1:]
    score = by_theta.T @ (weight[:, 0] * error) - cross.T @ solved[:, 0]
    return _Normal(curvature, score, -solved[:, 0], -solved[:, 1:])


@partial(jax.jit, static_argnums=(0, 1, 4))
def _fit(
    twin: Twin,
    names: tuple[str, ...],
    fixed: Params,
    shots: Shots,
    n_steps: int,
    theta: Array,
    index: Array,
    offsets: Array,
    noise: Array,
    scale: Array,
    lower: Array,
    upper: Array,
) -> tuple[Array, Array, Array, Array]:
    n_theta = len(names)
    real = index < n_theta
    at = jnp.where(real, index, 0)
    size = jnp.where(real, scale[at], 0.0)
    low = jnp.where(real, lower[at], -jnp.inf)
    high = jnp.where(real, upper[at], jnp.inf)
    error = partial(_error, twin, names, fixed, noise)

    def moved(theta: Array, values: Array) -> Array:
        # The last place takes what belongs to no parameter.
        extended = jnp.concatenate([theta, jnp.zeros(1, theta.dtype)])
        return extended.at[index].set(values)[:n_theta]

    def total(values: Array, offsets: Array) -> Array:
        errors = jax.vmap(lambda o, s: _cost(error(moved(theta, values), o, s)))(offsets, shots)
        return jnp.sum(errors)

    def equations(values: Array, offset: Array, shot: Shots) -> _Normal:
        n = offset.shape[0]

        def of(both: Array) -> Array:
            return error(moved(theta, values + size * both[n:]), offset + both[:n], shot)

        here, push = jax.linearize(of, jnp.zeros(n + index.shape[0], theta.dtype))
        slopes = jax.vmap(push)(jnp.eye(n + index.shape[0], dtype=theta.dtype)).T
        return _normal(here, slopes[:, :n], slopes[:, n:])

    def step(carry):
        values, offsets, cost, damping, k, _ = carry
        normal = jax.vmap(equations, (None, 0, 0))(values, offsets, shots)
        curvature, score = normal.curvature.sum(0), normal.score.sum(0)
        stuck = ((values <= low) & (score > 0.0)) | ((values >= high) & (score < 0.0))
        free = real & ~stuck
        curvature = jnp.where(free[:, None] & free[None], curvature, 0.0)
        diagonal = jnp.diag(curvature)
        ridge = damping * diagonal + _RIDGE * jnp.trace(curvature) + 1e-300
        solved = jnp.linalg.solve(
            curvature + jnp.diag(jnp.where(free, ridge, 1.0)), jnp.where(free, score, 0.0)
        )
        new = jnp.clip(values - size * solved, low, high)
        z = jnp.where(size > 0.0, (new - values) / jnp.where(size > 0.0, size, 1.0), 0.0)
        ahead = offsets + normal.from_score + jnp.einsum("nfk,k->nf", normal.from_step, z)
        new_cost = total(new, ahead)
        better = new_cost < cost
        finished = better & (cost - new_cost < _ENOUGH * cost)
        values, offsets = jnp.where(better, new, values), jnp.where(better, ahead, offsets)
        damping = jnp.where(better, _LESS, _MORE) * damping
        return values, offsets, jnp.where(better, new_cost, cost), damping, k + 1, finished

    values = jnp.where(real, theta[at], 0.0)
    first = (values, offsets, total(values, offsets), jnp.asarray(_DAMPING, theta.dtype), 0, False)
    going = lambda carry: (carry[4] < n_steps) & ~carry[5]  # noqa: E731
    values, offsets, *_ = jax.lax.while_loop(going, step, first)
    theta = moved(theta, values)
    raw = jax.vmap(lambda o, s: error(theta, o, s))(offsets, shots)
    shape = shots.obs.shape
    return theta, offsets, jnp.mean(raw**2, 1), raw.reshape(shape) * noise


@partial(jax.jit, static_argnums=(0, 1))
def _slopes(
    twin: Twin,
    names: tuple[str, ...],
    fixed: Params,
    shots: Shots,
    theta: Array,
    offsets: Array,
    noise: Array,
    scale: Array,
) -> tuple[Array, Array]:
    error = partial(_error, twin, names, fixed, noise)

    def one(offset: Array, shot: Shots) -> tuple[Array, Array]:
        n = offset.shape[0]
        of = lambda both: error(theta + scale * both[n:], offset + both[:n], shot)  # noqa: E731
        here, push = jax.linearize(of, jnp.zeros(n + len(names), theta.dtype))
        slopes = jax.vmap(push)(jnp.eye(n + len(names), dtype=theta.dtype)).T
        slopes = jnp.nan_to_num(slopes, posinf=0.0, neginf=0.0)
        normal = _normal(here, slopes[:, :n], slopes[:, n:])
        return normal.curvature, normal.score

    return jax.vmap(one)(offsets, shots)
