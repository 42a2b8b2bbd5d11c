"""The Riccati backward pass of Gauss-Newton and iLQR."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sb3_hds.core import Scalar, solve_spd
from sb3_hds.planning.expansion import Expansion
from sb3_hds.planning.problem import Controls

# Smallest curvature along a control direction, in units of the scaled objective.
_LEAST_CURVATURE = 1e-4


class Gains(NamedTuple):
    """
    The minimiser of a local model.

    :param feedforward: change of the controls, shape ``(horizon, m)``
    :param feedback: reaction to a change of the state, shape ``(horizon, m, n)``
    :param sensitivity: cost of an error in this control, ``|Q_u| + tr(Q_uu) / 2``, shape
        ``(horizon,)``
    """

    feedforward: Controls
    feedback: Float[Array, "horizon m n"]
    sensitivity: Float[Array, " horizon"]


def solve_backward(
    expansion: Expansion, controls: Controls, regularisation: Scalar | float, bounded: bool = True
) -> Gains:
    r"""
    Minimise the local model from the last step to the first:

    .. math:: Q_z = \ell_z + [A\,B]^\top V_x', \quad
              Q_{zz} = \ell_{zz} + [A\,B]^\top V_{xx}' [A\,B], \quad
              k = -Q_{uu}^{-1} Q_u, \quad K = -Q_{uu}^{-1} Q_{ux}

    :math:`Q_{uu}` is made positive definite by raising pivots of its factorisation. With
    ``bounded``, controls that stand at a limit and want beyond it are held there and do not react
    to the state.

    :param controls: where the model was expanded
    :param regularisation: added to the diagonal of :math:`Q_{uu}`
    :param bounded: whether the box [-1, 1] is respected

    Source: Tassa, Mansard, Todorov, *Control-limited differential dynamic programming*, ICRA 2014,
    with one clamping step instead of the full projected Newton iteration.
    """
    n = expansion.A.shape[1]

    def back(carry, stage):
        v_x, v_xx = carry
        A, B, slope, curvature, u = stage
        AB = jnp.concatenate([A, B], axis=1)
        q = slope + AB.T @ v_x
        Q = curvature + AB.T @ v_xx @ AB
        q_u, q_ux, q_uu = q[n:], Q[n:, :n], Q[n:, n:]
        free = jnp.ones_like(u, bool)
        if bounded:
            free = ~(((u >= 1.0) & (q_u < 0.0)) | ((u <= -1.0) & (q_u > 0.0)))
        wanted = _solve(q_uu, jnp.concatenate([q_u[:, None], q_ux], 1), free, regularisation)
        k, K = -wanted[:, 0], -wanted[:, 1:]
        if bounded:
            inside = jnp.abs(u + k) < 1.0
            k, K = jnp.clip(u + k, -1.0, 1.0) - u, jnp.where(inside[:, None], K, 0.0)
        v_x = q[:n] + K.T @ (q_uu @ k + q_u) + q_ux.T @ k
        v_xx = Q[:n, :n] + K.T @ q_uu @ K + K.T @ q_ux + q_ux.T @ K
        sensitivity = jnp.sum(jnp.abs(q_u)) + 0.5 * jnp.trace(q_uu)
        return (v_x, 0.5 * (v_xx + v_xx.T)), (k, K, sensitivity)

    stages = (expansion.A, expansion.B, expansion.slope, expansion.curvature, controls)
    last = (expansion.end_slope, expansion.end_curvature)
    return Gains(*jax.lax.scan(back, last, stages, reverse=True)[1])


def _solve(
    q_uu: Float[Array, "m m"],
    right: Float[Array, "m k"],
    free: Bool[Array, " m"],
    regularisation: Scalar | float,
) -> Float[Array, "m k"]:
    """Solve for the free controls; the held ones get zero."""
    both = free[:, None] & free[None, :]
    matrix = jnp.where(both, q_uu, 0.0) + jnp.diag(jnp.where(free, regularisation, 1.0))
    return solve_spd(matrix, jnp.where(free[:, None], right, 0.0), _LEAST_CURVATURE)
