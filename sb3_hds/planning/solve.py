"""Uses of an improver: many start states, several warm starts, growing horizons, replanning."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from sb3_hds.core import Flag, State, Twin
from sb3_hds.planning.ilqr import gauss_newton, ilqr
from sb3_hds.planning.line_search import gradient_ascent
from sb3_hds.planning.problem import Controls, Plan, Problem, TerminalValue, assemble, simulate

# Knots of random sequences.
_KNOTS = 5
METHODS: Mapping[str, Callable[..., Plan]] = {
    "first_order": gradient_ascent,
    "gauss_newton": gauss_newton,
    "ilqr": lambda *args, **settings: ilqr(*args, **settings)[0],
}


def solve(
    twin: Twin,
    starts: State,
    controls: Float[Array, "batch horizon act"],
    method: str = "ilqr",
    n_iterations: int = 10,
    discount: float = 1.0,
    terminal_value: TerminalValue | None = None,
    terminal_curvature: bool = False,
    temperature: float = 0.0,
    key: PRNGKeyArray | None = None,
) -> Plan:
    """
    Improve one control sequence for each start state, in the twin as it is now.

    :param twin: any twin; its current parameter values are used
    :param starts: leaves of shape ``(batch, ...)``
    :param controls: scaled to [-1, 1]; clipped to that
    :param method: ``"first_order"``, ``"gauss_newton"`` or ``"ilqr"``
    :param n_iterations: improvements of each sequence
    :param discount: per step, in (0, 1]
    :param terminal_value: of the last observation; the same function object compiles only once
    :param terminal_curvature: whether second-order methods use its Hessian
    :param temperature: annealed acceptance; needs ``key``
    :return: plans, leaves of shape ``(batch, ...)``; a sequence with values that are not finite
        keeps its best finite version and does not affect the others
    :raises ValueError: for an unknown method or controls of the wrong shape
    """
    if method not in METHODS:
        raise ValueError(f"method must be one of {', '.join(METHODS)}, got {method!r}.")
    batch, n_act = starts.q.shape[0], len(twin.actuators)
    if controls.ndim != 3 or controls.shape[0] != batch or controls.shape[2] != n_act:
        raise ValueError(
            f"controls must have shape (batch, horizon, n_act) = ({batch}, horizon, {n_act}), "
            f"got {controls.shape}."
        )
    keys = None if key is None else jax.random.split(key, batch)
    settings = (twin, method, n_iterations, discount, terminal_value, terminal_curvature)
    return _solve(settings, twin.params, starts, jnp.clip(controls, -1.0, 1.0), temperature, keys)


@partial(jax.jit, static_argnums=0)
def _solve(settings, params, starts, controls, temperature, keys) -> Plan:
    twin, method, n_iterations, discount, terminal_value, terminal_curvature = settings
    problem = Problem(
        twin,
        params,
        discount,
        terminal_value=terminal_value,
        terminal_curvature=terminal_curvature,
    )
    improve = partial(METHODS[method], problem, n_iterations=n_iterations, temperature=temperature)
    one = lambda start, u, key: improve(start, u, key=key)  # noqa: E731
    return jax.vmap(one, (0, 0, None if keys is None else 0))(starts, controls, keys)


def random_controls(key: PRNGKeyArray, horizon: int, n_act: int, scale: float = 2.0) -> Controls:
    """
    Random sequence, piecewise linear through five normal knots and clipped: smooth, often at a
    limit.

    :param scale: standard deviation of the knots; above 1, much of the sequence is bang-bang
    """
    knots = scale * jax.random.normal(key, (_KNOTS, n_act))
    # Constant weights of the knots: interpolation inside the program takes a second to compile.
    distance = np.abs(np.linspace(0.0, _KNOTS - 1.0, horizon)[:, None] - np.arange(_KNOTS))
    hats = jnp.asarray(np.maximum(1.0 - distance, 0.0), knots.dtype)
    return jnp.clip(hats @ knots, -1.0, 1.0)


def best_of_random(
    problem: Problem, start: State, key: PRNGKeyArray, horizon: int, n_candidates: int
) -> Plan:
    """:return: the best of ``n_candidates`` random sequences"""
    keys = jax.random.split(key, n_candidates)
    draw = lambda k: random_controls(k, horizon, problem.n_controls)  # noqa: E731
    plans = jax.vmap(lambda k: simulate(problem, start, draw(k)))(keys)
    return jax.tree.map(lambda leaf: leaf[jnp.argmax(plans.value)], plans)


def multi_start(
    problem: Problem,
    start: State,
    initial: Sequence[Controls],
    improve: Callable[[Problem, State, Controls], Plan],
) -> Plan:
    """
    Improve several sequences and keep the best, against local optima.

    :param initial: sequences of one length
    :param improve: an improver, for example ``gauss_newton``
    """
    plans = jax.vmap(lambda u: improve(problem, start, u))(jnp.stack(initial))
    return jax.tree.map(lambda leaf: leaf[jnp.argmax(plans.value)], plans)


def horizon_continuation(
    problem: Problem,
    start: State,
    controls: Controls,
    horizons: Sequence[int],
    improve: Callable[[Problem, State, Controls], Plan],
) -> Plan:
    """
    Improve the first steps of a sequence, then growing parts of it, as for a long swing-up.

    :param controls: the sequence, shape ``(horizon, n_act)``
    :param horizons: growing lengths; the last one is the full horizon
    :param improve: an improver, for example ``gauss_newton``
    :return: the plan over the full horizon, or that of ``controls`` if it is better
    """
    if (
        list(horizons) != sorted(set(horizons))
        or horizons[-1] != controls.shape[0]
        or horizons[0] < 1
    ):
        raise ValueError(
            f"Horizons must grow from at least 1 to the length of the controls, "
            f"{controls.shape[0]}, got {list(horizons)}."
        )
    first = simulate(problem, start, controls)
    current = controls
    for horizon in horizons:
        plan = improve(problem, start, current[:horizon])
        current = jnp.concatenate([plan.controls, current[horizon:]])
    better = plan.value > first.value
    return jax.tree.map(lambda new, old: jnp.where(better, new, old), plan, first)


def receding_horizon(
    problem: Problem,
    start: State,
    n_steps: int,
    initial: Controls,
    improve: Callable[[Problem, State, Controls], Plan],
    replan_every: int = 1,
) -> Plan:
    """
    Model-predictive control in the twin: plan over ``horizon`` steps, execute the first
    ``replan_every``, shift the plan, replan.

    The shifted plan, with its last control repeated, is the next warm start.

    :param n_steps: number of executed steps; a multiple of ``replan_every``
    :param initial: first warm start; its length is the planning horizon
    :param improve: an improver, for example ``gauss_newton``
    :param replan_every: steps between two plans, at most the horizon
    :return: the executed steps as a plan of length ``n_steps``
    """
    horizon = initial.shape[0]
    if not 1 <= replan_every <= horizon or n_steps % replan_every:
        raise ValueError(
            f"replan_every must lie between 1 and the horizon, {horizon}, and "
            f"divide n_steps={n_steps}, got {replan_every}."
        )

    def act(carry: tuple[State, Flag, Controls], _: None):
        state, alive, warm = carry
        plan = improve(problem, state, warm)
        done = jax.tree.map(lambda leaf: leaf[:replan_every], plan.states)
        after = jax.tree.map(lambda leaf: leaf[replan_every], plan.states)
        lived = alive & plan.alive[: replan_every + 1]
        rewards = jnp.where(lived[:-1], plan.rewards[:replan_every], 0.0)
        repeated = jnp.broadcast_to(plan.controls[-1:], (replan_every, plan.controls.shape[1]))
        shifted = jnp.concatenate([plan.controls[replan_every:], repeated])
        taken = (done, lived[:-1], rewards, plan.controls[:replan_every])
        return (after, lived[-1], shifted), taken

    alive = ~problem.terminated(start)
    (end, alive, _), taken = jax.lax.scan(
        act, (start, alive, initial), None, length=n_steps // replan_every
    )
    merge = lambda leaf: leaf.reshape(n_steps, *leaf.shape[2:])  # noqa: E731
    return assemble(problem, end, alive, *jax.tree.map(merge, taken))
