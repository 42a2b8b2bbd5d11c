"""Linear algebra on matrices of a handful of rows that XLA vectorises over a batch."""

import jax.numpy as jnp
from jaxtyping import Array, Float


def solve_spd(
    matrix: Float[Array, "n n"], right: Float[Array, "n *k"], least_pivot: float | None = None
) -> Float[Array, "n *k"]:
    """
    Solve ``matrix @ x = right`` for a symmetric positive definite matrix by unrolled ``L D L^T``.

    LAPACK's batched solvers dominate the run time of a batch of tiny systems on a CPU; these loops
    unroll at trace time into element-wise operations. Not meant for more than about ten rows.

    :param matrix: symmetric positive definite, shape ``(n, n)``; not checked
    :param right: shape ``(n,)`` or ``(n, k)``
    :param least_pivot: raise smaller pivots to this value, so that an indefinite matrix is replaced
        by a positive definite one near it; None leaves them
    :return: the solution, in the shape of ``right``
    """
    n = matrix.shape[0]
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
