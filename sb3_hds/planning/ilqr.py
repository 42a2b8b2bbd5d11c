"""Second-order improvement of a control sequence: Gauss-Newton (PODS) and box-constrained iLQR."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from sb3_hds.core import Scalar, State, solve_spd
from sb3_hds.planning.expansion import Expansion, expand
from sb3_hds.planning.line_search import choose, climb, step_sizes
from sb3_hds.planning.problem import Control, Controls, Plan, Problem, as_plan, roll_out

_LEAST_REGULARISATION = 1e-6
# Smallest curvature along a control direction, in units of the scaled objective.
_LEAST_CURVATURE = 1e-4


class Gains(NamedTuple):
    """
    The policy that minimises a local model.

    :param feedforward: change of the controls, shape ``(horizon, m)``
    :param feedback: gain on a change of the state, shape ``(horizon, m, n)``
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
    Minimise the local model by a Riccati recursion from the last step to the first:

    .. math:: Q_z = \ell_z + [A\,B]^\top V_x', \quad
              Q_{zz} = \ell_{zz} + [A\,B]^\top V_{xx}' [A\,B], \quad
              k = -Q_{uu}^{-1} Q_u, \quad K = -Q_{uu}^{-1} Q_{ux}

    :math:`Q_{uu}` is made positive definite by raising pivots of its factorisation. With
    ``bounded``, controls at a limit whose optimum is beyond it stay there, without feedback.

    :param controls: around which the model was expanded
    :param regularisation: added to the diagonal of :math:`Q_{uu}`
    :param bounded: whether to respect the box [-1, 1]

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
    """Solve for the free controls; the others get zero."""
    both = free[:, None] & free[None, :]
    matrix = jnp.where(both, q_uu, 0.0) + jnp.diag(jnp.where(free, regularisation, 1.0))
    return solve_spd(matrix, jnp.where(free[:, None], right, 0.0), _LEAST_CURVATURE)


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
    objective never falls. Regularisation grows tenfold after an iteration without improvement and
    shrinks tenfold after one with. Only forward-mode derivatives of single steps are needed.

    :param start: initial state of the plan
    :param first: what to improve: controls of shape ``(horizon, n_act)``, or a plan from ``start``
    :param n_iterations: number of expansions
    :param n_step_sizes: candidates of each line search
    :param temperature: annealed acceptance, see :func:`~sb3_hds.planning.line_search.choose`
    :param key: needed with a temperature
    :return: the plan, and the gains of the last iteration, which belong to the plan before it
    """
    first = as_plan(problem, start, first)
    dtype = first.controls.dtype
    steps = jnp.array(step_sizes(n_step_sizes), dtype)
    keys = jnp.arange(n_iterations) if key is None else jax.random.split(key, n_iterations)

    def iterate(carry, draw):
        plan, regularisation = carry
        gains = solve_backward(expand(problem, plan), plan.controls, regularisation)
        finite = jnp.all(jnp.array([jnp.all(jnp.isfinite(leaf)) for leaf in gains]))
        gains = jax.tree.map(lambda leaf: jnp.where(finite, leaf, 0.0), gains)
        candidates = jax.vmap(
            lambda step: _roll_out_with_feedback(problem, start, plan, gains, step)
        )(steps)
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
    The paper's second-order step on the full action sequence: :math:`a \leftarrow a + \alpha H^{-1}
    g` with :math:`H = S^\top \ell_{ss} S + \ell_{aa}`, :math:`S = \partial s / \partial a`.

    A Riccati recursion computes :math:`H^{-1} g` at a cost linear in the horizon; curvature that is
    not positive is raised. As in the paper, the result is open-loop controls, clipped to the
    limits. "No change" is among the step sizes.

    :param start: initial state of the plan
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


def _roll_out_with_feedback(
    problem: Problem, start: State, plan: Plan, gains: Gains, step: Scalar
) -> Plan:
    """Roll out the plan with ``step`` times its change, and feedback; 0 changes nothing."""
    reference = jax.tree.map(lambda leaf: leaf[:-1], plan.states)
    feedback = jnp.where(step > 0.0, gains.feedback, 0.0)

    def decide(state: State, stage) -> Control:
        nominal, u, k, K = stage
        dx = problem.twin.difference(state, nominal)
        reaction = K @ jnp.where(jnp.isfinite(dx), dx, 0.0)
        return jnp.clip(u + step * k + reaction, -1.0, 1.0)

    stages = (reference, plan.controls, gains.feedforward, feedback)
    return roll_out(problem, start, decide, stages, plan.controls.shape[0])
