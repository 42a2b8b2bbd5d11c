"""Improving a control sequence along its gradient (PODS, first order)."""

import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray

from sb3_hds.core import Scalar, State
from sb3_hds.planning.expansion import Expansion, expand
from sb3_hds.planning.line_search import climb
from sb3_hds.planning.problem import Controls, Plan, Problem


def control_gradient(expansion: Expansion) -> Controls:
    r"""
    Gradient of the objective by every control, by the adjoint recursion

    .. math:: \lambda_t = \ell_x + A_t^\top \lambda_{t+1}, \qquad
              \partial J / \partial u_t = -(\ell_u + B_t^\top \lambda_{t+1})

    Source: PODS, eq. 5, there with the dense sensitivity matrix.
    """
    n = expansion.A.shape[1]

    def back(adjoint, stage):
        A, B, slope = stage
        return slope[:n] + A.T @ adjoint, -(slope[n:] + B.T @ adjoint)

    stages = (expansion.A, expansion.B, expansion.slope)
    return jax.lax.scan(back, expansion.end_slope, stages, reverse=True)[1]


def gradient_ascent(
    problem: Problem,
    start: State,
    first: Controls | Plan,
    n_iterations: int = 1,
    n_step_sizes: int = 14,
    temperature: Scalar | float = 0.0,
    key: PRNGKeyArray | None = None,
) -> Plan:
    r"""
    Move all controls along the gradient, scaled so that the largest change of a unit step is one:

    .. math:: u \leftarrow \mathrm{clip}(u + \alpha\, g / \max|g|, -1, 1)

    The step size :math:`\alpha` is searched in the simulator, "no change" included: without
    temperature the objective never falls. A gradient that is not finite counts as zero.

    :param start: where the plan starts
    :param first: what to improve: controls of shape ``(horizon, n_act)``, or a plan from ``start``
    :param n_iterations: gradients taken
    :param n_step_sizes: candidates of each line search, from 1 down to 5e-4
    :param temperature: annealed acceptance, see :func:`~sb3_hds.planning.line_search.choose`
    :param key: needed with a temperature
    """
    return climb(problem, start, first, steepest, n_iterations, n_step_sizes, temperature, key)


def steepest(problem: Problem, plan: Plan) -> Controls:
    """:return: the gradient, scaled to a largest entry of one; zero where it is not finite"""
    gradient = control_gradient(expand(problem, plan, second_order=False))
    direction = gradient / jnp.maximum(jnp.max(jnp.abs(gradient)), 1e-30)
    return jnp.where(jnp.all(jnp.isfinite(direction)), direction, 0.0)
