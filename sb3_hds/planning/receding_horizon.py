"""Replanning while acting: model-predictive control in the twin."""

from collections.abc import Callable

import jax
import jax.numpy as jnp

from sb3_hds.core import Flag, State
from sb3_hds.planning.problem import Controls, Plan, Problem, assemble


def receding_horizon(
    problem: Problem,
    start: State,
    n_steps: int,
    initial: Controls,
    improve: Callable[[Problem, State, Controls], Plan],
    replan_every: int = 1,
) -> Plan:
    """
    Plan ``horizon`` steps, carry out the first ``replan_every``, shift the plan, plan again.

    The shifted plan is the warm start of the next one; its last control is repeated.

    :param n_steps: steps to act in all; a multiple of ``replan_every``
    :param initial: first warm start; its length is the planning horizon
    :param improve: an improver, for example ``gauss_newton``
    :param replan_every: steps between two plans, at most the horizon
    :return: what was carried out, ``n_steps`` long, scored as a plan of its own
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
