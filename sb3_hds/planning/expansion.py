"""Local models of a plan: expansions of step and reward to first and second order."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sb3_hds.core import Scalar, State
from sb3_hds.planning.problem import Control, Plan, Problem

# Value, in units of the scaled objective, at which curvature from rotating roots has weight 1/2.
_NEAR_GOAL = 0.05
_LEAST_LENGTH = 1e-6


class Expansion(NamedTuple):
    r"""
    Local model of a plan in tangent coordinates :math:`\delta x` of the states (dimension n) and
    changes :math:`\delta u` of the controls (dimension m). Costs are negative discounted rewards,
    zero after termination.

    :param A: :math:`\partial x_{t+1} / \partial x_t`, shape ``(horizon, n, n)``
    :param B: :math:`\partial x_{t+1} / \partial u_t`, shape ``(horizon, n, m)``
    :param slope: gradient of the stage cost by (x, u), shape ``(horizon, n + m)``
    :param curvature: Hessian of the stage cost by (x, u), shape ``(horizon, n + m, n + m)``; where
        the reward depends on the next state, without the second derivative of the step
        (Gauss-Newton)
    :param end_slope: gradient of the terminal cost, shape ``(n,)``
    :param end_curvature: Hessian of the terminal cost, shape ``(n, n)``
    """

    A: Float[Array, "horizon n n"]
    B: Float[Array, "horizon n m"]
    slope: Float[Array, "horizon nm"]
    curvature: Float[Array, "horizon nm nm"]
    end_slope: Float[Array, " n"]
    end_curvature: Float[Array, "n n"]


def expand(problem: Problem, plan: Plan, second_order: bool = True) -> Expansion:
    """
    Differentiate one step at every point of a plan, in forward mode, the only one of some engines.

    :param plan: to expand around
    :param second_order: whether to compute curvatures; zero otherwise
    :return: the local model; its cost derivatives are zero where the episode has terminated
    """
    starts = jax.tree.map(lambda leaf: leaf[:-1], plan.states)
    ends = jax.tree.map(lambda leaf: leaf[1:], plan.states)
    end = jax.tree.map(lambda leaf: leaf[-1], plan.states)
    twin = problem.twin
    first = jax.tree.map(lambda leaf: leaf[0], starts)
    origin = jnp.zeros_like(twin.difference(first, first))
    n, horizon = origin.shape[0], plan.controls.shape[0]
    nm = n + problem.n_controls
    weight = -jnp.where(plan.alive[:-1], problem.discount ** jnp.arange(horizon), 0.0)

    def at(state: State, control: Control, after: State):
        def move(z: Float[Array, " nm"]) -> Float[Array, " n"]:
            moved = problem.advance(twin.retract(state, z[:n]), control + z[n:])
            return twin.difference(moved, after)

        def reward(w: Float[Array, " nmn"]) -> Scalar:
            before = twin.retract(state, w[:n])
            return problem.reward(before, control + w[n:nm], twin.retract(after, w[nm:]))

        jacobian = jax.jacfwd(move)(jnp.zeros(nm, origin.dtype))
        still = jnp.zeros(nm + n, origin.dtype)
        chain = jnp.concatenate([jnp.eye(nm, dtype=origin.dtype), jacobian])
        slope = jax.jacfwd(reward)(still) @ chain
        if not second_order:
            return jacobian, slope, jnp.zeros((nm, nm), origin.dtype)
        return jacobian, slope, chain.T @ jax.jacfwd(jax.jacfwd(reward))(still) @ chain

    jacobians, slopes, curvatures = jax.vmap(at)(starts, plan.controls, ends)
    end_weight = -jnp.where(plan.alive[-1], problem.discount**horizon, 0.0)
    end_slope, end_curvature = _expand_end(problem, end, origin, second_order)
    return Expansion(
        jacobians[:, :, :n],
        jacobians[:, :, n:],
        weight[:, None] * slopes,
        weight[:, None, None] * curvatures,
        end_weight * end_slope,
        end_weight * end_curvature,
    )


def _expand_end(problem: Problem, end: State, origin: Float[Array, " n"], second_order: bool):
    def value(dx: Float[Array, " n"]):
        return problem.value_at_end(problem.twin.retract(end, dx))

    flat = jnp.zeros((origin.shape[0], origin.shape[0]), origin.dtype)
    if problem.terminal_value is None:
        return origin, flat
    slope = jax.jacfwd(value)(origin)
    if second_order and problem.terminal_curvature:
        return slope, jax.jacfwd(jax.jacfwd(value))(origin)
    if second_order and problem.terminal_roots is not None:
        return slope, _curvature_of_squares(problem, problem.terminal_roots, end, origin)
    return slope, flat


def _curvature_of_squares(problem: Problem, roots, end: State, origin: Float[Array, " n"]):
    r"""
    Gauss-Newton Hessian of :math:`-|\rho|^2`. The part of :math:`(\partial\rho/\partial x)^\top
    (\partial\rho/\partial x)` that rotates :math:`\rho` without lengthening it is curvature only
    near the goal, where :math:`\rho` is zero. Elsewhere it is an arbitrary choice of the network,
    so its weight fades.
    """
    at = lambda dx: roots(problem.observe(problem.twin.retract(end, dx)))  # noqa: E731
    rho, jacobian = at(origin), jax.jacfwd(at)(origin)
    length = jnp.sqrt(jnp.sum(rho**2) + _LEAST_LENGTH**2)
    radial = rho @ jacobian / length
    longer = jnp.outer(radial, radial)
    share = _NEAR_GOAL / (_NEAR_GOAL + length**2)
    return -2.0 * (longer + share * (jacobian.T @ jacobian - longer))
