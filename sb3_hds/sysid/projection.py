"""
Variable projection: parameters are searched while the start state of each window follows.

Source: Kaufman, BIT 15, 1975.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Float

from sb3_hds.core import Params, Twin
from sb3_hds.core.compilation import QUICKEST_COMPILATION
from sb3_hds.sysid.bounds import bounds_of
from sb3_hds.sysid.shooting import (
    Offset,
    Shots,
    fit_start,
    simulate,
    solve_normal,
    weighed,
    with_slopes,
)

_TOLERANCE = 1e-8
# Gauss-Newton steps of a start state: at first, and after each change of the parameters.
_N_FIRST, _N_AGAIN = 8, 3


#: parameters, each with those that take the same value
Groups = tuple[tuple[str, ...], ...]


class Solution(NamedTuple):
    """
    :param values: of the free parameters, shape ``(p,)``
    :param converged: whether the solver says so
    :param n_steps: of the solver
    """

    values: Float[Array, " p"]
    converged: Array
    n_steps: Array


class Errors(NamedTuple):
    """
    At given values, start states eliminated.

    :param offsets: of the start states, shape ``(n, 2 dof)``
    :param raw: simulated minus measured, in the channels' units, shape ``(n, rows, n_obs)``
    :param bent: what the loss makes of it, in units of the noise, shape ``(n, rows * n_obs)``
    :param slopes: of ``bent`` by the parameters, shape ``(n, rows * n_obs, p)``
    """

    offsets: Any
    raw: Any
    bent: Any
    slopes: Any


def one_each(groups: Groups, values: Any) -> dict[str, Any]:
    """:return: the value of each parameter, given one for each group"""
    return {name: x for group, x in zip(groups, values, strict=True) for name in group}


@partial(jax.jit, static_argnums=(0, 1, 2, 3), compiler_options=QUICKEST_COMPILATION)
def solve(
    twin: Twin,
    groups: Groups,
    threshold: float | None,
    max_steps: int,
    fixed: Params,
    begin: Float[Array, " p"],
    shots: Shots,
    noise: Float[Array, " obs"],
    offsets: Float[Array, "n free"],
    believed: Float[Array, " p"],
    prior: float,
) -> Solution:
    """The estimate for given noise: one program for all data of a shape."""
    bounds = bounds_of([twin.parameters[group[0]] for group in groups])

    def both(values: Array) -> tuple[Array, Array]:
        found = errors_at(twin, groups, threshold, fixed, shots, values, offsets, noise, _N_AGAIN)
        from_belief = prior * (values - believed) / bounds.scale
        pull = prior * jnp.diag(1.0 / bounds.scale)
        return (
            jnp.concatenate([found.bent.ravel(), from_belief]),
            jnp.concatenate([found.slopes.reshape(-1, len(groups)), pull]),
        )

    @jax.custom_jvp
    def errors(values: Array) -> Array:
        return both(values)[0]

    @errors.defjvp
    def _(values: tuple[Array], ways: tuple[Array]) -> tuple[Array, Array]:
        found, slopes = both(*values)
        return found, slopes @ ways[0]

    def objective(inside: Array, _: None) -> Array:
        return errors(bounds.outside(inside))

    solver = optx.LevenbergMarquardt(rtol=_TOLERANCE, atol=_TOLERANCE)
    found = optx.least_squares(
        objective, solver, begin, options={"jac": "fwd"}, max_steps=max_steps, throw=False
    )
    converged = found.result == optx.RESULTS.successful
    return Solution(bounds.outside(found.value), converged, found.stats["num_steps"])


def errors_at(
    twin: Twin,
    groups: Groups,
    threshold: float | None,
    fixed: Params,
    shots: Shots,
    values: Float[Array, " p"],
    offsets: Float[Array, "n free"],
    noise: Float[Array, " obs"],
    n_iterations: int = _N_FIRST,
) -> Errors:
    """
    Errors and their slopes at given values; start states are searched from ``offsets``.

    :param n_iterations: Gauss-Newton steps of each start state
    """
    params = fixed | one_each(groups, values)

    def one(shot: Shots, first: Offset) -> Errors:
        at = fit_start(twin, params, shot, noise, first, n_iterations, threshold)
        return _projected(twin, groups, threshold, fixed, noise, values, shot, at)

    return jax.vmap(one)(shots, offsets)


evaluate = jax.jit(errors_at, static_argnums=(0, 1, 2), compiler_options=QUICKEST_COMPILATION)


def _projected(
    twin: Twin,
    groups: Groups,
    threshold: float | None,
    fixed: Params,
    noise: Float[Array, " obs"],
    values: Float[Array, " p"],
    shot: Shots,
    at: Offset,
) -> Errors:
    """
    Errors of one window, and their slopes by the parameters alone: its start state, optimal for
    them, follows. Only first derivatives are needed (Kaufman).
    """
    n = len(groups)

    def of(both: Array) -> tuple[Array, Array]:
        params = fixed | one_each(groups, both[:n])
        simulated = simulate(twin, params, shot, both[n:])
        raw = weighed(simulated, shot, jnp.ones_like(noise)).reshape(simulated.shape)
        return weighed(simulated, shot, noise, threshold), raw

    (bent, raw), (slopes, _) = with_slopes(of, jnp.concatenate([values, at]))
    direct, by_start = slopes[:, :n], slopes[:, n:]
    return Errors(at, raw, bent, direct - by_start @ solve_normal(by_start, direct))
