"""Linear algebra on matrices of a handful of rows that XLA vectorises over a batch."""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

# Rows up to which loops are unrolled where LAPACK could do it: beyond, they take a multiple of the
# time to compile and run no faster.
_UNROLLED = 4


def solve_spd(
    matrix: Float[Array, "n n"], right: Float[Array, "n *k"], least_pivot: float | None = None
) -> Float[Array, "n *k"]:
    """
    Solve ``matrix @ x = right`` for a symmetric positive definite matrix.

    LAPACK's batched solvers dominate the run time of a batch of tiny systems on a CPU: up to four
    rows, and where pivots are raised, ``L D L^T`` is unrolled into element-wise operations.

    :param matrix: symmetric positive definite, shape ``(n, n)``; not checked
    :param right: shape ``(n,)`` or ``(n, k)``
    :param least_pivot: raise smaller pivots to this value, so that an indefinite matrix is replaced
        by a positive definite one near it; None leaves them
    :return: the solution, in the shape of ``right``
    """
    n = matrix.shape[0]
    if n > _UNROLLED and least_pivot is None:
        factor = lax.linalg.cholesky(matrix, symmetrize_input=False)
        return solve_factored(factor, right)
    lower: dict[tuple[int, int], Array] = {}
    pivot: list[Array] = []
    for j in range(n):
        rest = matrix[j, j] - sum(lower[j, k] ** 2 * pivot[k] for k in range(j))
        pivot.append(rest if least_pivot is None else jnp.maximum(rest, least_pivot))
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


def solve_factored(
    factor: Float[Array, "n n"], right: Float[Array, "n *k"]
) -> Float[Array, "n *k"]:
    """
    :param factor: lower triangular ``L``
    :param right: shape ``(n,)`` or ``(n, k)``
    :return: ``x`` of ``L @ L.T @ x = right``
    """
    columns = right.reshape(len(factor), -1)
    half = lax.linalg.triangular_solve(factor, columns, left_side=True, lower=True)
    whole = lax.linalg.triangular_solve(factor, half, left_side=True, lower=True, transpose_a=True)
    return whole.reshape(right.shape)
