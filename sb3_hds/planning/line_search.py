"""Line searches, with "no change" among the candidates, and gradient ascent by them (PODS)."""

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from sb3_hds.core import Scalar, State
from sb3_hds.planning.expansion import Expansion, expand
from sb3_hds.planning.problem import Controls, Plan, Problem, as_plan, simulate


def step_sizes(n: int, smallest: float = 0.015) -> tuple[float, ...]:
    """
    :param n: number of step sizes, "no change" included; at least 2
    :param smallest: smallest step size other than zero
    :return: zero and ``n - 1`` steps from 1 down to ``smallest``, geometrically spaced
    """
    if n < 2:
        raise ValueError(
            f"A line search needs at least 2 candidates, 'no change' among them, got {n}."
        )
    if n == 2:
        return (0.0, 1.0)
    return (0.0, *(math.exp(math.log(smallest) * i / (n - 2)) for i in range(n - 1)))


def choose(
    values: Float[Array, " candidates"], temperature: Scalar | float, key: PRNGKeyArray | None
) -> Int[Array, ""]:
    r"""
    Choose a candidate: without temperature, the best, the first among equals, so that no useless
    step is taken; with temperature, candidate i with probability :math:`\propto \exp(J_i / T)`
    (Boltzmann acceptance of simulated annealing, sampled by the Gumbel trick).

    :param values: objectives; candidates with minus infinity are never chosen
    :param temperature: :math:`T`, in units of the objective; 0: the maximum
    :param key: needed if the temperature may be positive
    :return: index of the candidate
    """
    if key is None:
        return jnp.argmax(values)
    noise = jax.random.gumbel(key, values.shape, values.dtype)
    return jnp.argmax(values + temperature * jnp.where(jnp.isfinite(values), noise, 0.0))


def climb(
    problem: Problem,
    start: State,
    first: Controls | Plan,
    direction: Callable[[Problem, Plan], Controls],
    n_iterations: int,
    n_step_sizes: int,
    temperature: Scalar | float,
    key: PRNGKeyArray | None,
) -> Plan:
    """
    Iterate line searches along a direction of the full control sequence, clipped to the limits.

    :param direction: change of the controls for a unit step, zero where it is not finite
    :param n_step_sizes: candidates of each line search, "no change" and steps from 1 down to 5e-4
    :return: the last plan; without temperature never worse than the start
    """
    first = as_plan(problem, start, first)
    steps = jnp.array(step_sizes(n_step_sizes, 5e-4), first.controls.dtype)
    draws = jnp.arange(n_iterations) if key is None else jax.random.split(key, n_iterations)

    def iterate(plan: Plan, draw):
        change = steps[:, None, None] * direction(problem, plan)
        moved = jnp.clip(plan.controls + change, -1.0, 1.0)
        candidates = jax.vmap(lambda u: simulate(problem, start, u))(moved)
        best = choose(candidates.value, temperature, None if key is None else draw)
        return jax.tree.map(lambda leaf: leaf[best], candidates), None

    return jax.lax.scan(iterate, first, draws)[0]


def control_gradient(expansion: Expansion) -> Controls:
    r"""
    Gradient of the objective with respect to every control, by the adjoint recursion

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
    Move all controls along the gradient, scaled so that a unit step changes them by at most one:

    .. math:: u \leftarrow \mathrm{clip}(u + \alpha\, g / \max|g|, -1, 1)

    The step size :math:`\alpha` is searched in the simulator, "no change" included: without
    temperature the objective never falls. A gradient that is not finite counts as zero.

    :param start: initial state of the plan
    :param first: what to improve: controls of shape ``(horizon, n_act)``, or a plan from ``start``
    :param n_iterations: gradients taken
    :param n_step_sizes: candidates of each line search, from 1 down to 5e-4
    :param temperature: annealed acceptance, see :func:`~sb3_hds.planning.line_search.choose`
    :param key: needed with a temperature
    """
    return climb(
        problem, start, first, steepest_direction, n_iterations, n_step_sizes, temperature, key
    )


def steepest_direction(problem: Problem, plan: Plan) -> Controls:
    """:return: the gradient, scaled to a largest entry of one; zero where it is not finite"""
    gradient = control_gradient(expand(problem, plan, second_order=False))
    direction = gradient / jnp.maximum(jnp.max(jnp.abs(gradient)), 1e-30)
    return jnp.where(jnp.all(jnp.isfinite(direction)), direction, 0.0)
