"""
One planning epoch as a pure function: roll the policy out in the twin, improve the plans, keep what
is better, regress the policy on it, move on.

The stateful shell around it is ``twin_algorithm.py``. Nothing here knows an environment's name.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from sb3_hds.algos.twin.networks import output
from sb3_hds.algos.twin.regression import regress, remember, rescale, samples_of
from sb3_hds.algos.twin.state import (
    Knobs,
    Learner,
    Settings,
    for_each,
    longest_episode,
    problem_of,
    resets,
)
from sb3_hds.core import Obs, Params, State
from sb3_hds.core.numerics.compilation import GENERATOR, QUICK_COMPILATION
from sb3_hds.planning import (
    Plan,
    Problem,
    best_of_random,
    follow,
    gauss_newton,
    gradient_ascent,
    ilqr,
    score,
)
from sb3_hds.planning.problem import Control

PLANNERS = ("first_order", "gauss_newton", "ilqr")
# By this much, in units of the objective, the plan that began as the policy's own is preferred.
_TIE = 1e-3


class Outcome(NamedTuple):
    """
    What came of planning. Returns are discounted planning rewards, in the reward's own unit.

    :param before: mean return of the policy's own plans
    :param after: mean return of the plans that were kept
    :param worsened: number of kept plans that are worse than the policy's own
    :param dropped: number of samples that were not finite
    """

    before: jax.Array
    after: jax.Array
    worsened: jax.Array
    dropped: jax.Array


class Report(NamedTuple):
    """
    What an epoch tells: its :class:`Outcome`, and

    :param policy_loss: mean regression loss of the epoch
    :param value_loss: mean regression loss of the value
    :param gradient_norm: mean norm of the policy's gradient before it is clipped
    """

    before: jax.Array
    after: jax.Array
    worsened: jax.Array
    dropped: jax.Array
    policy_loss: jax.Array
    value_loss: jax.Array
    gradient_norm: jax.Array


class Choice(NamedTuple):
    """
    The plans of one epoch; leaves of shape ``(n_rollouts, ...)``.

    :param own: what the policy does
    :param kept: what is learned from
    :param tails: value of the last state of ``kept``
    :param sensitivity: cost of an error of each control of ``kept``
    """

    own: Plan
    kept: Plan
    tails: Float[Array, " rollouts"]
    sensitivity: Float[Array, "rollouts horizon"]


def epoch(settings: Settings, learner: Learner, knobs: Knobs) -> tuple[Learner, Report]:
    """
    Plan from every start state, keep what is better than the policy, regress on it, move on.

    :return: the learner after the epoch, and what happened
    """
    learner, outcome = plan_ahead(settings, learner, knobs)
    learner, losses = learn_from_plans(settings, learner, knobs)
    return learner, Report(*outcome, *losses)


@partial(jax.jit, static_argnums=0, compiler_options=QUICK_COMPILATION)
def plan_ahead(settings: Settings, learner: Learner, knobs: Knobs) -> tuple[Learner, Outcome]:
    """The first half of an epoch: everything that happens in the twin."""
    key = jax.random.wrap_key_data(learner.progress.key, impl=GENERATOR)
    key, k_noise, k_plan, k_move = jax.random.split(key, 4)
    problem = problem_of(settings, learner, knobs)
    seen = jax.vmap(lambda obs: settings.twin.infer(obs, knobs.params))(knobs.visited)
    starts = _where(knobs.relabel, seen, learner.workspace.starts)

    own, wandering = _act(settings, learner, knobs, problem, starts, k_noise)
    choice = _plan(settings, learner, knobs, problem, own, k_plan)
    gain = jnp.maximum(choice.kept.value - choice.own.value, 0.0)
    samples, finite = samples_of(
        knobs, problem, choice.kept, choice.tails, gain, choice.sensitivity
    )
    moved, ages = _move_on(settings, learner, knobs, wandering, k_move)
    outcome = _outcome(settings, learner, choice, finite)
    learner = remember(settings, learner, samples)
    if settings.adapt_scales:
        learner = rescale(learner, samples)
    progress = learner.progress._replace(gain=_mean(gain, finite), key=jax.random.key_data(key))
    workspace = learner.workspace._replace(starts=moved, ages=ages)
    return learner._replace(progress=progress, workspace=workspace), outcome


@partial(jax.jit, static_argnums=0)
def learn_from_plans(
    settings: Settings, learner: Learner, knobs: Knobs
) -> tuple[Learner, Float[Array, " 3"]]:
    """The second half of an epoch: the regression."""
    key = jax.random.wrap_key_data(learner.progress.key, impl=GENERATOR)
    key, k_regress = jax.random.split(key)
    learner, losses = regress(settings, learner, knobs, k_regress)
    progress = learner.progress._replace(
        n_epochs=learner.progress.n_epochs + 1, key=jax.random.key_data(key)
    )
    return learner._replace(progress=progress), losses


def control_of(settings: Settings, learner: Learner, knobs: Knobs, obs: Obs) -> Control:
    """:return: what the policy in training does for an observation of the twin"""
    seen = learner.networks.inside(knobs.view(obs))
    return output(settings.actor, learner.networks.actor, seen)


def twin_steps_per_epoch(settings: Settings) -> int:
    """
    :return: simulated steps of one epoch, line searches included; a Jacobian counts one step for
        each of its columns besides the step itself, as many as finite differences would take
    """
    s = settings
    columns = 2 * len(s.twin.joints) + len(s.twin.actuators)
    improving = s.n_iterations * s.horizon * (1 + columns + s.n_step_sizes)
    n, n_random = s.n_rollouts, _random_slots(s).size
    acting = n * s.horizon * (2 if s.advance else 1)
    planning = (n + n_random) * improving + n_random * s.n_candidates * s.horizon
    return acting + planning + (2 * n + n_random) * s.lookahead


def _act(
    settings: Settings,
    learner: Learner,
    knobs: Knobs,
    problem: Problem,
    starts: State,
    key: PRNGKeyArray,
) -> tuple[Plan, Plan]:
    """What the policy does from each start state, and what it does with exploration noise."""
    policy = partial(control_of, settings, learner, knobs)

    def act(start: State, offset: Control, varied: Params) -> Plan:
        here = problem.with_params(varied)
        return follow(here, start, lambda obs: policy(obs) + offset, settings.horizon)

    n = settings.n_rollouts
    noise = knobs.noise * learner.progress.control_scale
    offsets = noise * jax.random.normal(key, (n, problem.n_controls))
    if not settings.advance:
        own = for_each(act, starts, jnp.zeros_like(offsets), knobs.varied)
        return own, own
    rows, varied = _joined(starts, starts), _joined(knobs.varied, knobs.varied)
    paths = for_each(act, rows, jnp.concatenate([jnp.zeros_like(offsets), offsets]), varied)
    return _pick(paths, slice(n)), _pick(paths, slice(n, None))


def _plan(
    settings: Settings,
    learner: Learner,
    knobs: Knobs,
    problem: Problem,
    own: Plan,
    key: PRNGKeyArray,
) -> Choice:
    """For each of the policy's own plans, the plan that is kept."""
    k_random, k_improve, k_keep = jax.random.split(key, 3)
    n, fresh = settings.n_rollouts, _random_slots(settings)
    policy = partial(control_of, settings, learner, knobs)
    first, tried = own, _pick(knobs.varied, fresh)
    varied = knobs.varied
    if fresh.size:
        # Without the barrier, XLA gathers again in every step of the loops.
        starts = jax.tree.map(lambda leaf: leaf[fresh, 0], own.states)
        starts = jax.lax.optimization_barrier(starts)

        def search(start: State, key: PRNGKeyArray, varied: Params) -> Plan:
            here = problem.with_params(varied)
            return best_of_random(here, start, key, settings.horizon, settings.n_candidates)

        found = jax.vmap(search)(starts, jax.random.split(k_random, fresh.size), tried)
        first, varied = _joined(own, found), _joined(varied, tried)
    improved, sensitivity = _improve(settings, learner, knobs, problem, first, varied, k_improve)

    plans, varied = _joined(improved, own), _joined(varied, knobs.varied)
    ends = jax.tree.map(lambda leaf: leaf[:, -1], plans.states)
    value_of_end = lambda end, own: _tail(settings, problem.with_params(own), policy, end)  # noqa: E731
    tails = for_each(value_of_end, ends, varied)
    values = jax.vmap(lambda p, tail: score(problem, p.rewards, p.alive, tail))(plans, tails)
    plans = plans._replace(value=values)

    others = n + np.arange(fresh.size)
    better = values[others] > values[fresh] + _TIE
    best = jnp.arange(n).at[fresh].set(jnp.where(better, others, fresh))
    unchanged = n + fresh.size + jnp.arange(n)
    advantage = values[best] - values[unchanged]
    if settings.annealed:
        temperature = knobs.temperature * learner.progress.gain
        advantage += temperature * jax.random.logistic(k_keep, (n,))
    kept = jnp.where(advantage > 0.0, best, unchanged)
    return Choice(
        _pick(plans, unchanged), _pick(plans, kept), _pick(tails, kept), _pick(sensitivity, best)
    )


def _random_slots(settings: Settings) -> np.ndarray:
    """:return: the rollouts for which random plans are tried too"""
    count = round(settings.n_rollouts * settings.random_share) if settings.n_candidates else 0
    return np.linspace(0, settings.n_rollouts, count, endpoint=False).astype(int)


def _improve(
    settings: Settings,
    learner: Learner,
    knobs: Knobs,
    problem: Problem,
    first: Plan,
    varied: Params,
    key: PRNGKeyArray,
) -> tuple[Plan, Float[Array, "plans horizon"]]:
    """:return: the improved plans, and what an error of each of their controls costs"""
    discounts = settings.discount ** jnp.arange(settings.horizon)
    temperature = knobs.temperature * learner.progress.gain

    def one(first: Plan, own: Params, key: PRNGKeyArray | None):
        here = problem.with_params(own)
        start = jax.tree.map(lambda leaf: leaf[0], first.states)
        options = {
            "n_iterations": settings.n_iterations,
            "n_step_sizes": settings.n_step_sizes,
            "temperature": temperature,
            "key": key,
        }
        if settings.planner == "ilqr":
            plan, gains = ilqr(here, start, first, **options)
            return plan, jnp.sqrt(gains.sensitivity / discounts)
        improver = gradient_ascent if settings.planner == "first_order" else gauss_newton
        return improver(here, start, first, **options), jnp.ones(settings.horizon)

    keys = jax.random.split(key, first.value.shape[0]) if settings.annealed else None
    return jax.vmap(one, (0, 0, None if keys is None else 0))(first, varied, keys)


def _tail(settings: Settings, problem: Problem, policy, end: State) -> jax.Array:
    """Value of a plan's end by what the policy makes of it: errors of V are not exploited."""
    if not settings.lookahead:
        return problem.value_at_end(end)
    return follow(problem, end, policy, settings.lookahead).value


def _move_on(
    settings: Settings, learner: Learner, knobs: Knobs, wandering: Plan, key: PRNGKeyArray
) -> tuple[State, Float[Array, " rollouts"]]:
    """The next start states: where the policy went with exploration noise, or a reset."""
    n = settings.n_rollouts
    k_reset, k_draw = jax.random.split(key)
    fresh = resets(settings.twin, knobs.params, k_draw, n)
    if not settings.advance:
        return fresh, jnp.zeros(n)
    moved = jax.tree.map(lambda leaf: leaf[:, settings.advance], wandering.states)
    ages = learner.workspace.ages + settings.advance
    finite = jnp.isfinite(moved.q).all(1) & jnp.isfinite(moved.v).all(1)
    too_old = ages >= longest_episode(settings.twin)
    drawn = jax.random.uniform(k_reset, (n,)) < _reset_rates(knobs.reset_share, n)
    again = too_old | drawn | ~wandering.alive[:, settings.advance] | ~finite
    return _where(again, fresh, moved), jnp.where(again, 0.0, ages)


def _reset_rates(share: float, n: int) -> Float[Array, " rollouts"]:
    """
    How often each rollout starts afresh: ``share`` on the average, spread from hardly ever to
    nearly always, so that there are start states soon after a reset and long after one.
    """
    position = (jnp.arange(n) + 0.5) / n
    return position ** (1.0 / share - 1.0)


def _outcome(settings: Settings, learner: Learner, choice: Choice, finite: jax.Array) -> Outcome:
    forever = 1.0 / (1.0 - settings.discount) if settings.discount < 1.0 else settings.horizon
    progress = learner.progress
    unit = lambda value: value / progress.reward_scale + progress.reward_offset * forever  # noqa: E731
    both = finite & jnp.isfinite(choice.own.value)
    return Outcome(
        unit(_mean(choice.own.value, both)),
        unit(_mean(choice.kept.value, both)),
        jnp.sum(choice.kept.value < choice.own.value),
        jnp.sum(~finite) * settings.horizon,
    )


def _mean(values: jax.Array, counted: jax.Array) -> jax.Array:
    return jnp.sum(jnp.where(counted, values, 0.0)) / jnp.maximum(jnp.sum(counted), 1)


def _joined(one, other):
    """:return: the rows of both"""
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b]), one, other)


def _pick(tree, index):
    """:return: the rows ``index`` of every leaf"""
    return jax.tree.map(lambda leaf: leaf[index], tree)


def _where(condition, new, old):
    """Choose row by row."""
    rows = lambda leaf: condition.reshape(-1, *[1] * (leaf.ndim - 1))  # noqa: E731
    return jax.tree.map(lambda a, b: jnp.where(rows(a), a, b), new, old)
