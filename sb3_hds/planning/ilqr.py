"""Second-order improvement of a control sequence: Gauss-Newton (PODS) and box-constrained iLQR."""

import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray

from sb3_hds.core import Flag, Scalar, State
from sb3_hds.planning.expansion import expand
from sb3_hds.planning.line_search import choose, climb, step_sizes
from sb3_hds.planning.problem import Controls, Plan, Problem, assemble, simulated
from sb3_hds.planning.riccati import Gains, solve_backward

_LEAST_REGULARISATION = 1e-6


def ilqr(
    problem: Problem,
    start: State,
    first: Controls | Plan,
    n_iterations: int = 3,
    n_step_sizes: int = 6,
    temperature: Scalar | float = 0.0,
    key: PRNGKeyArray | None = None,
) -> tuple[Plan, Gains]:
    r"""
    Box-constrained iLQR: expand, solve backward, roll out with feedback.

    .. math:: u_t \leftarrow \mathrm{clip}(u_t + \alpha\,k_t + K_t\,(x_t - \bar x_t), -1, 1)

    The step size is searched in the simulator, "no change" included: without temperature the
    objective never falls. Regularisation grows tenfold after a useless iteration and shrinks
    tenfold after a useful one. Only forward-mode derivatives of one step are needed.

    :param start: where the plan starts
    :param first: what to improve: controls of shape ``(horizon, n_act)``, or a plan from ``start``
    :param n_iterations: expansions computed
    :param n_step_sizes: candidates of each line search
    :param temperature: annealed acceptance, see :func:`~sb3_hds.planning.line_search.choose`
    :param key: needed with a temperature
    :return: the plan, and the gains of the last iteration, around the plan before it
    """
    first = simulated(problem, start, first)
    dtype = first.controls.dtype
    steps = jnp.array(step_sizes(n_step_sizes), dtype)
    keys = jnp.arange(n_iterations) if key is None else jax.random.split(key, n_iterations)

    def iterate(carry, draw):
        plan, regularisation = carry
        gains = solve_backward(expand(problem, plan), plan.controls, regularisation)
        gains = jax.tree.map(lambda leaf: jnp.where(_all_finite(gains), leaf, 0.0), gains)
        candidates = jax.vmap(lambda step: _follow(problem, start, plan, gains, step))(steps)
        best = choose(candidates.value, temperature, None if key is None else draw)
        factor = jnp.where(best == 0, 10.0, 0.1).astype(dtype)
        regularisation = jnp.clip(regularisation * factor, _LEAST_REGULARISATION, 1e6)
        return (jax.tree.map(lambda leaf: leaf[best], candidates), regularisation), gains

    initial = (first, jnp.asarray(_LEAST_REGULARISATION, dtype))
    (plan, _), gains = jax.lax.scan(iterate, initial, keys)
    return plan, jax.tree.map(lambda leaf: leaf[-1], gains)


def gauss_newton(
    problem: Problem,
    start: State,
    first: Controls | Plan,
    n_iterations: int = 1,
    n_step_sizes: int = 14,
    temperature: Scalar | float = 0.0,
    key: PRNGKeyArray | None = None,
) -> Plan:
    r"""
    The paper's second-order step on the whole action sequence: :math:`a \leftarrow a + \alpha
    H^{-1} g` with
    :math:`H = S^\top \ell_{ss} S + \ell_{aa}`, :math:`S = \partial s / \partial a`.

    The step is found by the Riccati recursion, which gives the same :math:`H^{-1} g` at a cost
    linear in the horizon; curvature that is not positive is raised. It ends as controls without
    feedback, as in the paper, clipped to the limits. "No change" is among the step sizes.

    :param start: where the plan starts
    :param first: what to improve: controls of shape ``(horizon, n_act)``, or a plan from ``start``
    :param n_iterations: steps taken
    :param n_step_sizes: candidates of each line search, from 1 down to 5e-4
    :param temperature: annealed acceptance, see :func:`~sb3_hds.planning.line_search.choose`
    :param key: needed with a temperature

    Source: PODS, eqs. 13 and 14.
    """
    return climb(
        problem, start, first, newton_direction, n_iterations, n_step_sizes, temperature, key
    )


def newton_direction(problem: Problem, plan: Plan) -> Controls:
    """:return: the Gauss-Newton step of all controls; zero where it is not finite"""
    expansion = expand(problem, plan)
    gains = solve_backward(expansion, plan.controls, _LEAST_REGULARISATION, bounded=False)

    def forward(dx, stage):
        A, B, k, K = stage
        du = k + K @ dx
        return A @ dx + B @ du, du

    stages = (expansion.A, expansion.B, gains.feedforward, gains.feedback)
    direction = jax.lax.scan(forward, jnp.zeros_like(expansion.end_slope), stages)[1]
    return jnp.where(jnp.all(jnp.isfinite(direction)), direction, 0.0)


def _follow(problem: Problem, start: State, plan: Plan, gains: Gains, step: Scalar) -> Plan:
    """Roll out the plan with a share of its change, and feedback; a step of 0 changes nothing."""
    reference = jax.tree.map(lambda leaf: leaf[:-1], plan.states)
    feedback = jnp.where(step > 0.0, gains.feedback, 0.0)

    def advance(carry: tuple[State, Flag], stage):
        state, alive = carry
        nominal, u, k, K = stage
        dx = problem.twin.difference(state, nominal)
        reaction = K @ jnp.where(jnp.isfinite(dx), dx, 0.0)
        control = jnp.clip(u + step * k + reaction, -1.0, 1.0)
        after = problem.advance(state, control)
        reward = problem.reward(state, control, after)
        still = alive & ~problem.terminated(after)
        return (after, still), (state, alive, jnp.where(alive, reward, 0.0), control)

    stages = (reference, plan.controls, gains.feedforward, feedback)
    (end, alive), taken = jax.lax.scan(advance, (start, plan.alive[0]), stages)
    return assemble(problem, end, alive, *taken)


def _all_finite(gains: Gains) -> Flag:
    return jnp.all(jnp.array([jnp.all(jnp.isfinite(leaf)) for leaf in gains]))
