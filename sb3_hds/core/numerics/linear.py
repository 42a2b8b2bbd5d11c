"""Solvers for small symmetric systems that XLA vectorises over a batch."""

from functools import partial
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

# Matrices up to this size are solved by unrolled loops, which compile slowly beyond it; up to the
# second size by loops. LAPACK's batched solvers cost several times as much for a batch of 64, and
# use threads: two programs that run at the same time can deadlock.
_UNROLLED, _LOOPED = 4, 16


class Factor(NamedTuple):
    """
    Factors of a symmetric positive definite matrix :math:`L D L^T`.

    :param lower: :math:`L`, shape ``(n, n)``; only the entries below the diagonal are read
    :param pivot: the diagonal of :math:`D`, shape ``(n,)``
    """

    lower: Array
    pivot: Array


def uses_lapack(n: int) -> bool:
    """:return: whether LAPACK solves ``n`` rows; two such programs must not run at the same time"""
    return n > _LOOPED


def solve_spd(
    matrix: Float[Array, "n n"], right: Float[Array, "n *k"], min_pivot: float | None = None
) -> Float[Array, "n *k"]:
    """
    Solve ``matrix @ x = right`` for a symmetric positive definite matrix.

    :param matrix: symmetric positive definite, shape ``(n, n)``; not checked
    :param right: shape ``(n,)`` or ``(n, k)``
    :param min_pivot: raise smaller pivots to this value, so that an indefinite matrix is replaced
        by a positive definite one near it; None: not
    :return: the solution, in the shape of ``right``
    """
    n = matrix.shape[0]
    if n > _UNROLLED and min_pivot is None:
        return solve_factored(factorised(matrix), right)
    lower: dict[tuple[int, int], Array] = {}
    pivot: list[Array] = []
    for j in range(n):
        rest = matrix[j, j] - sum(lower[j, k] ** 2 * pivot[k] for k in range(j))
        pivot.append(rest if min_pivot is None else jnp.maximum(rest, min_pivot))
        for i in range(j + 1, n):
            shared = sum(lower[i, k] * lower[j, k] * pivot[k] for k in range(j))
            lower[i, j] = (matrix[i, j] - shared) / pivot[j]
    x = [right[i] for i in range(n)]
    for i in range(n):
        x[i] = x[i] - sum(lower[i, k] * x[k] for k in range(i))
    x = [x[i] / pivot[i] for i in range(n)]
    for i in reversed(range(n)):
        x[i] = x[i] - sum(lower[k, i] * x[k] for k in range(i + 1, n))
    return jnp.stack(x)


def factorised(matrix: Float[Array, "n n"]) -> Factor:
    """:param matrix: symmetric positive definite; not checked"""
    n = matrix.shape[0]
    if uses_lapack(n):
        root = lax.linalg.cholesky(matrix, symmetrize_input=False)
        return Factor(root / jnp.diagonal(root), jnp.diagonal(root) ** 2)
    below = jnp.arange(n)

    def column(j: Any, now: tuple[Array, Factor]) -> tuple[Array, Factor]:
        rest, found = now
        current = lax.dynamic_index_in_dim(rest, j, 1, keepdims=False)
        pivot = lax.dynamic_index_in_dim(current, j, 0, keepdims=False)
        scaled = jnp.where(below > j, current / pivot, 0.0)
        lower = lax.dynamic_update_index_in_dim(found.lower, scaled, j, 1)
        pivots = lax.dynamic_update_index_in_dim(found.pivot, pivot, j, 0)
        return rest - scaled[:, None] * current[None, :], Factor(lower, pivots)

    empty = Factor(jnp.zeros_like(matrix), jnp.zeros_like(matrix[0]))
    return lax.fori_loop(0, n, column, (matrix, empty))[1]


def solve_factored(factor: Factor, right: Float[Array, "n *k"]) -> Float[Array, "n *k"]:
    """
    :param factor: of ``matrix``
    :param right: shape ``(n,)`` or ``(n, k)``
    :return: the solution of ``matrix @ x = right``, in the shape of ``right``
    """
    n = len(factor.pivot)
    columns, pivot = right.reshape(n, -1), factor.pivot[:, None]
    if uses_lapack(n):
        kind = {"left_side": True, "lower": True, "unit_diagonal": True}
        solve = partial(lax.linalg.triangular_solve, factor.lower, **kind)
        return solve(solve(columns) / pivot, transpose_a=True).reshape(right.shape)

    def forwards(j: Any, x: Array) -> Array:
        own = lax.dynamic_index_in_dim(x, j, 0)
        return x - lax.dynamic_index_in_dim(factor.lower, j, 1) * own

    def backwards(k: Any, x: Array) -> Array:
        j = n - 1 - k
        share = lax.dynamic_index_in_dim(factor.lower, j, 1)
        own = lax.dynamic_index_in_dim(x, j, 0) - jnp.sum(share * x, 0, keepdims=True)
        return lax.dynamic_update_index_in_dim(x, own, j, 0)

    half = lax.fori_loop(0, n, forwards, columns)
    return lax.fori_loop(0, n, backwards, half / pivot).reshape(right.shape)
