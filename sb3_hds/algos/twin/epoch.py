"""
One planning epoch as a pure function: roll the policy out in the twin, improve the plans, keep the
better ones, regress the policy on them, advance the start states.

``algorithm.py`` holds the state. Nothing here is specific to an environment.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from sb3_hds.algos.twin.policy import output
from sb3_hds.algos.twin.regression import (
    learn_from_plans,
    regressions,
    remember,
    rescale,
    samples_of,
)
from sb3_hds.algos.twin.state import (
    EpochConfig,
    EpochState,
    Hyperparams,
    grouped_vmap,
    longest_episode,
    planning_problem,
    resets,
)
from sb3_hds.core import Obs, Params, State
from sb3_hds.core.numerics.compilation import GENERATOR, QUICK_COMPILATION
from sb3_hds.planning import METHODS, Plan, Problem, best_of_random, follow, ilqr, score
from sb3_hds.planning.problem import Control

# Advantage of plans that start from the policy's own over random ones, in units of the objective.
_TIE = 1e-3
# Share of start states with random plans: they cost as much as the policy's own plans, and the
# policy does not learn a local optimum that half of the rollouts avoid.
_RANDOM_SHARE = 0.5


class PlanningMetrics(NamedTuple):
    """
    Metrics of planning. Returns are discounted planning rewards, in the reward's own unit.

    :param before: mean return of the policy's own plans
    :param after: mean return of the kept plans
    :param worsened: number of kept plans that are worse than the policy's own
    :param dropped: number of samples that were not finite
    """

    before: jax.Array
    after: jax.Array
    worsened: jax.Array
    dropped: jax.Array


class EpochMetrics(NamedTuple):
    """
    Metrics of an epoch.

    :param plans: metrics of planning
    :param policy_loss: mean regression loss of the policy
    :param value_loss: mean regression loss of the value
    :param gradient_norm: mean norm of the policy's gradient before it is clipped
    """

    plans: PlanningMetrics
    policy_loss: jax.Array
    value_loss: jax.Array
    gradient_norm: jax.Array


class KeptPlans(NamedTuple):
    """
    The plans of one epoch; leaves of shape ``(n_rollouts, ...)``.

    :param own: rollouts of the policy
    :param kept: plans to learn from
    :param tails: value of the last state of each plan in ``kept``
    :param sensitivity: cost of an error in each control of ``kept``
    """

    own: Plan
    kept: Plan
    tails: Float[Array, " rollouts"]
    sensitivity: Float[Array, "rollouts horizon"]


def epoch(
    config: EpochConfig, state: EpochState, hyper: Hyperparams
) -> tuple[EpochState, EpochMetrics]:
    """Plan from every start state, keep plans that are better than the policy, regress on them."""
    state, metrics = plan_ahead(config, state, hyper)
    state, losses = learn_from_plans(config, state, hyper)
    return state, EpochMetrics(metrics, *losses)


def epoch_log(
    metrics: EpochMetrics, hyper: Hyperparams, returns: Float[np.ndarray, " 2"] | None
) -> dict[str, float]:
    """
    :param returns: of the averaged policy and of the one that acted so far, if they were compared
    :return: logged values by key
    """
    compared = {}
    if returns is not None:
        compared["train/return_of_average"] = float(returns[0])
        compared["train/return_of_best"] = float(max(returns))
    return compared | {
        "train/learning_rate": hyper.learning_rate,
        "train/plan_return_before": float(metrics.plans.before),
        "train/plan_return_after": float(metrics.plans.after),
        "train/policy_loss": float(metrics.policy_loss),
        "train/value_loss": float(metrics.value_loss),
        "train/gradient_norm": float(metrics.gradient_norm),
        "train/worsened_plans": int(metrics.plans.worsened),
        "train/dropped_samples": int(metrics.plans.dropped),
        "train/exploration_noise": hyper.noise,
        "train/temperature": hyper.temperature,
    }


@partial(jax.jit, static_argnums=0, compiler_options=QUICK_COMPILATION)
def plan_ahead(
    config: EpochConfig, state: EpochState, hyper: Hyperparams
) -> tuple[EpochState, PlanningMetrics]:
    """The first half of an epoch: rollouts and planning in the twin."""
    key = jax.random.wrap_key_data(state.progress.key, impl=GENERATOR)
    key, k_noise, k_plan, k_move = jax.random.split(key, 4)
    problem = planning_problem(config, state, hyper)
    starts = state.workspace.starts
    own, exploring = _roll_out(config, state, hyper, problem, starts, k_noise)
    plans = _plan(config, state, hyper, problem, own, k_plan)
    gain = jnp.maximum(plans.kept.value - plans.own.value, 0.0)
    samples, finite = samples_of(hyper, problem, plans.kept, plans.tails, gain, plans.sensitivity)
    moved, ages = _advance_starts(config, state, hyper, exploring, k_move)
    metrics = _planning_metrics(config, state, plans, finite)
    state = remember(config, state, samples)
    if config.adapt_scales:
        state = rescale(state, samples)
    progress = state.progress._replace(gain=_mean(gain, finite), key=jax.random.key_data(key))
    workspace = state.workspace._replace(starts=moved, ages=ages)
    return state._replace(progress=progress, workspace=workspace), metrics


def _roll_out(
    config: EpochConfig,
    state: EpochState,
    hyper: Hyperparams,
    problem: Problem,
    starts: State,
    key: PRNGKeyArray,
) -> tuple[Plan, Plan]:
    """:return: rollouts of the policy from each start state, without and with exploration noise"""
    policy = partial(control_of, config, state, hyper)

    def act(start: State, offset: Control, varied: Params) -> Plan:
        here = problem.with_params(varied)
        return follow(here, start, lambda obs: policy(obs) + offset, config.horizon)

    n = config.n_rollouts
    noise = hyper.noise * state.progress.control_scale
    offsets = noise * jax.random.normal(key, (n, problem.n_controls))
    if not config.advance:
        own = grouped_vmap(act, starts, jnp.zeros_like(offsets), hyper.varied)
        return own, own
    rows, varied = _concatenated(starts, starts), _concatenated(hyper.varied, hyper.varied)
    paths = grouped_vmap(act, rows, jnp.concatenate([jnp.zeros_like(offsets), offsets]), varied)
    return _rows(paths, slice(n)), _rows(paths, slice(n, None))


def _plan(
    config: EpochConfig,
    state: EpochState,
    hyper: Hyperparams,
    problem: Problem,
    own: Plan,
    key: PRNGKeyArray,
) -> KeptPlans:
    """Improve the policy's own and random plans, and choose the plan to keep for each start."""
    k_random, k_improve, k_keep = jax.random.split(key, 3)
    n, slots = config.n_rollouts, _random_slots(config)
    policy = partial(control_of, config, state, hyper)
    first, tried = own, _rows(hyper.varied, slots)
    varied = hyper.varied
    if slots.size:
        # Without the barrier, XLA repeats the gather in every step of the loops.
        starts = jax.tree.map(lambda leaf: leaf[slots, 0], own.states)
        starts = jax.lax.optimization_barrier(starts)

        def search(start: State, key: PRNGKeyArray, varied: Params) -> Plan:
            here = problem.with_params(varied)
            return best_of_random(here, start, key, config.horizon, config.n_candidates)

        found = jax.vmap(search)(starts, jax.random.split(k_random, slots.size), tried)
        first, varied = _concatenated(own, found), _concatenated(varied, tried)
    improved, sensitivity = _improve(config, state, hyper, problem, first, varied, k_improve)

    plans, varied = _concatenated(improved, own), _concatenated(varied, hyper.varied)
    ends = jax.tree.map(lambda leaf: leaf[:, -1], plans.states)

    def value_of_end(end: State, varied: Params) -> jax.Array:
        return _tail(config, problem.with_params(varied), policy, end)

    tails = grouped_vmap(value_of_end, ends, varied)
    values = jax.vmap(lambda p, tail: score(problem, p.rewards, p.alive, tail))(plans, tails)
    plans = plans._replace(value=values)

    # Rows: the policy's plans after improvement, improved random ones, the policy's own before.
    rows_random, rows_own = n + np.arange(slots.size), n + slots.size + jnp.arange(n)
    better = values[rows_random] > values[slots] + _TIE
    best = jnp.arange(n).at[slots].set(jnp.where(better, rows_random, slots))
    advantage = values[best] - values[rows_own]
    if config.annealed:
        temperature = hyper.temperature * state.progress.gain
        advantage += temperature * jax.random.logistic(k_keep, (n,))
    kept = jnp.where(advantage > 0.0, best, rows_own)
    return KeptPlans(
        own=_rows(plans, rows_own),
        kept=_rows(plans, kept),
        tails=_rows(tails, kept),
        sensitivity=_rows(sensitivity, best),
    )


def _random_slots(config: EpochConfig) -> np.ndarray:
    """:return: indices of the rollouts that also get random plans"""
    count = round(config.n_rollouts * _RANDOM_SHARE) if config.n_candidates else 0
    return np.linspace(0, config.n_rollouts, count, endpoint=False).astype(int)


def _improve(
    config: EpochConfig,
    state: EpochState,
    hyper: Hyperparams,
    problem: Problem,
    first: Plan,
    varied: Params,
    key: PRNGKeyArray,
) -> tuple[Plan, Float[Array, "plans horizon"]]:
    """:return: the improved plans, and the cost of an error in each of their controls"""
    discounts = config.discount ** jnp.arange(config.horizon)
    temperature = hyper.temperature * state.progress.gain

    def one(first: Plan, varied: Params, key: PRNGKeyArray | None):
        here = problem.with_params(varied)
        start = jax.tree.map(lambda leaf: leaf[0], first.states)
        options = {
            "n_iterations": config.n_iterations,
            "n_step_sizes": config.n_step_sizes,
            "temperature": temperature,
            "key": key,
        }
        if config.planner == "ilqr":
            plan, gains = ilqr(here, start, first, **options)
            return plan, jnp.sqrt(gains.sensitivity / discounts)
        plan = METHODS[config.planner](here, start, first, **options)
        return plan, jnp.ones(config.horizon)

    keys = jax.random.split(key, first.value.shape[0]) if config.annealed else None
    return jax.vmap(one, (0, 0, None if keys is None else 0))(first, varied, keys)


def _tail(config: EpochConfig, problem: Problem, policy, end: State) -> jax.Array:
    """Value of a plan's end from a rollout of the policy, which does not exploit errors of V."""
    if not config.lookahead:
        return problem.value_at_end(end)
    return follow(problem, end, policy, config.lookahead).value


def _advance_starts(
    config: EpochConfig, state: EpochState, hyper: Hyperparams, exploring: Plan, key: PRNGKeyArray
) -> tuple[State, Float[Array, " rollouts"]]:
    """:return: the next start states, from the rollouts with exploration noise or resets; ages"""
    n = config.n_rollouts
    k_reset, k_draw = jax.random.split(key)
    reset_states = resets(config.twin, hyper.params, k_draw, n)
    if not config.advance:
        return reset_states, jnp.zeros(n)
    moved = jax.tree.map(lambda leaf: leaf[:, config.advance], exploring.states)
    ages = state.workspace.ages + config.advance
    finite = jnp.isfinite(moved.q).all(1) & jnp.isfinite(moved.v).all(1)
    too_old = ages >= longest_episode(config.twin)
    drawn = jax.random.uniform(k_reset, (n,)) < _reset_rates(hyper.reset_share, n)
    again = too_old | drawn | ~exploring.alive[:, config.advance] | ~finite
    return _choose_rows(again, reset_states, moved), jnp.where(again, 0.0, ages)


def _reset_rates(share: float, n: int) -> Float[Array, " rollouts"]:
    """
    Reset probability of each rollout: ``share`` on average, from nearly 0 to nearly 1, so that
    start states are both shortly and long after a reset.
    """
    position = (jnp.arange(n) + 0.5) / n
    return position ** (1.0 / share - 1.0)


def _planning_metrics(
    config: EpochConfig, state: EpochState, plans: KeptPlans, finite: jax.Array
) -> PlanningMetrics:
    forever = 1.0 / (1.0 - config.discount) if config.discount < 1.0 else config.horizon
    progress = state.progress
    unit = lambda value: value / progress.reward_scale + progress.reward_offset * forever  # noqa: E731
    both = finite & jnp.isfinite(plans.own.value)
    return PlanningMetrics(
        before=unit(_mean(plans.own.value, both)),
        after=unit(_mean(plans.kept.value, both)),
        worsened=jnp.sum(plans.kept.value < plans.own.value),
        dropped=jnp.sum(~finite) * config.horizon,
    )


def _mean(values: jax.Array, counted: jax.Array) -> jax.Array:
    return jnp.sum(jnp.where(counted, values, 0.0)) / jnp.maximum(jnp.sum(counted), 1)


def _concatenated(one, other):
    """:return: the rows of both"""
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b]), one, other)


def _rows(tree, index):
    """:return: the rows ``index`` of every leaf"""
    return jax.tree.map(lambda leaf: leaf[index], tree)


def _choose_rows(condition, new, old):
    """Choose row by row."""
    rows = lambda leaf: condition.reshape(-1, *[1] * (leaf.ndim - 1))  # noqa: E731
    return jax.tree.map(lambda a, b: jnp.where(rows(a), a, b), new, old)


def control_of(config: EpochConfig, state: EpochState, hyper: Hyperparams, obs: Obs) -> Control:
    """:return: control of the policy in training for an observation of the twin"""
    seen = state.networks.inside(hyper.vec_normalize(obs))
    return output(config.actor, state.networks.actor, seen)


def programs(config: EpochConfig, state: EpochState, hyper: Hyperparams) -> list[Callable[[], Any]]:
    """:return: the programs of an epoch, to be compiled in parallel by running each once"""
    used = [plan_ahead, *regressions(config)]
    return [partial(program, config, state, hyper) for program in used]


def twin_steps_per_epoch(config: EpochConfig) -> int:
    """
    :return: simulated steps of one epoch, line searches included; a Jacobian counts as many steps
        as finite differences would take, one per column and the step itself
    """
    s = config
    columns = 2 * len(s.twin.joints) + len(s.twin.actuators)
    improving = s.n_iterations * s.horizon * (1 + columns + s.n_step_sizes)
    n, n_random = s.n_rollouts, _random_slots(s).size
    acting = n * s.horizon * (2 if s.advance else 1)
    planning = (n + n_random) * improving + n_random * s.n_candidates * s.horizon
    return acting + planning + (2 * n + n_random) * s.lookahead
