"""State, configuration and hyperparameters of a planning epoch."""

import dataclasses
import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray

from sb3_hds.algos.twin.policy import (
    Actor,
    Networks,
    Normalization,
    TrainingState,
    Value,
    output,
    unclipped,
    value_of,
)
from sb3_hds.core import Obs, Params, State, Twin
from sb3_hds.core.numerics.compilation import GENERATOR, QUICK_COMPILATION
from sb3_hds.planning import Plan, Problem, best_of_random

# Typical shortfall of the first rollouts after scaling, in units of the objective.
_TYPICAL_SHORTFALL = 12.0
# Limit of the effective horizon 1 / (1 - discount) in the scale of rewards [steps].
_LONGEST = 1000.0
# Rows that are vectorised together, see `grouped_vmap`.
_GROUP = 16
# Episode length of twins that declare none [steps].
_LONG_EPISODE = 1000


@dataclasses.dataclass(frozen=True)
class EpochConfig:
    """
    Static configuration of an epoch: a change recompiles its programs. The fields are documented as
    arguments of ``PODS`` and ``HDS``.
    """

    twin: Twin
    actor: Actor
    value: Value
    n_rollouts: int
    horizon: int
    lookahead: int
    advance: int
    planner: str
    n_iterations: int
    n_step_sizes: int
    n_candidates: int
    discount: float
    terminal_value: bool
    shift_ends: bool
    plan_memory: int
    n_learned: int
    batch_size: int
    squared_error: bool
    max_grad_norm: float
    annealed: bool
    adapt_scales: bool


class Hyperparams(NamedTuple):
    """
    What may change between two epochs without recompiling.

    :param params: the twin's parameters
    :param varied: parameters that differ between rollouts, each of shape ``(n_rollouts,)``
    :param learning_rate: of policy and value
    :param noise: standard deviation of the exploration noise, in units of the control scale
    :param temperature: of the annealed acceptance, in units of the mean gain of the last epoch
    :param reset_share: share of start states drawn from the reset distribution in each epoch
    :param gain_weight: 0..1, share of a sample's weight that is proportional to its plan's gain
    :param sensitivity_weight: 0..1, share that is proportional to the cost of an error in it
    :param averaging: decay of the moving average of policies, per epoch
    :param gradient_steps: regression steps
    :param vec_normalize: the environment's own normalisation of observations
    """

    params: Params
    varied: Params
    learning_rate: float
    noise: float
    temperature: float
    reset_share: float
    gain_weight: float
    sensitivity_weight: float
    averaging: float
    gradient_steps: int
    vec_normalize: Normalization


class Samples(NamedTuple):
    """
    Regression samples at the states of kept plans. Leaves have shape ``(plan_memory, horizon *
    n_rollouts, ...)``: a row for each of the last epochs, with the first steps first.

    :param obs: after the environment's own normalisation
    :param control: target of the policy, in [-1, 1]
    :param value: target of the value: objective from this state on
    :param weight: in the policy's loss; zero after the end of an episode
    :param alive: weight in the value's loss, 0 or 1
    """

    obs: jax.Array
    control: jax.Array
    value: jax.Array
    weight: jax.Array
    alive: jax.Array


class Workspace(NamedTuple):
    """
    State of the training that is not saved, but rebuilt after loading.

    :param starts: start states of the next epoch
    :param ages: steps of each start state since its reset
    :param samples: of the last epochs
    :param n_filled: number of rows of ``samples`` written so far
    """

    starts: State
    ages: jax.Array
    samples: Samples
    n_filled: jax.Array


class Scales(NamedTuple):
    """
    Scales of a task, from random rollouts.

    :param inside: normalisation of the networks' input
    :param reward_scale: factor from rewards to the objective
    :param reward_offset: reward that counts as zero
    """

    inside: Normalization
    reward_scale: jax.Array
    reward_offset: jax.Array


class EpochState(NamedTuple):
    """Everything that an epoch reads and changes."""

    networks: Networks
    progress: TrainingState
    workspace: Workspace


@partial(jax.jit, static_argnums=0, compiler_options=QUICK_COMPILATION)
def init_workspace(
    config: EpochConfig, params: Params, vec_normalize: Normalization, progress: TrainingState
) -> tuple[Workspace, Scales, TrainingState]:
    """
    Draw start states, without samples, and take the scales of observations and rewards from random
    rollouts, so that a new task needs no manual scaling.

    :return: workspace, scales, and the training state with a new random key
    """
    key = jax.random.wrap_key_data(progress.key, impl=GENERATOR)
    key, k_starts, k_plans = jax.random.split(key, 3)
    n, n_obs, n_act = config.n_rollouts, vec_normalize.mean.shape[0], len(config.twin.actuators)
    rows = (config.plan_memory, config.horizon * n)
    empty = jnp.zeros(rows)
    samples = Samples(jnp.zeros((*rows, n_obs)), jnp.zeros((*rows, n_act)), empty, empty, empty)
    starts = resets(config.twin, params, k_starts, n)
    workspace = Workspace(starts, jnp.zeros(n), samples, jnp.zeros((), jnp.int32))

    problem = Problem(config.twin, params, config.discount)
    search = lambda start, k: best_of_random(problem, start, k, config.horizon, 1)  # noqa: E731
    plans = jax.vmap(search)(starts, jax.random.split(k_plans, n))
    seen = jax.vmap(jax.vmap(lambda state: vec_normalize(problem.observe(state))))(plans.states)
    offset = _best_reward(plans) if config.discount < 1.0 else jnp.zeros(())
    shortfall = _typical_shortfall(plans, offset, config.discount)
    scale = _TYPICAL_SHORTFALL / jnp.maximum(shortfall, 1e-6)
    scales = Scales(_input_scales(seen, plans), scale, offset)
    return workspace, scales, progress._replace(key=jax.random.key_data(key))


def resets(twin: Twin, params: Params, key: PRNGKeyArray, n: int) -> State:
    """:return: ``n`` states at the start of an episode"""
    return jax.vmap(lambda k: twin.initial(k, params))(jax.random.split(key, n))


def grouped_vmap(function: Callable, *rows: Any) -> Any:
    """
    ``jax.vmap`` over two axes instead of one: on a CPU, XLA multiplies thin matrices, the main cost
    of rolling out a policy, twice as fast with a batch dimension.

    :param function: of one row
    :param rows: pytrees whose leaves have a leading axis of one length
    :return: pytree whose leaves have that axis
    """
    n = jax.tree.leaves(rows[0])[0].shape[0]
    group = math.gcd(n, _GROUP)
    split = lambda leaf: leaf.reshape(-1, group, *leaf.shape[1:])  # noqa: E731
    grouped = jax.vmap(jax.vmap(function))(*jax.tree.map(split, rows))
    return jax.tree.map(lambda leaf: leaf.reshape(n, *leaf.shape[2:]), grouped)


def longest_episode(twin: Twin) -> int:
    """:return: steps after which an episode is truncated, also if the twin declares no limit"""
    return twin.max_episode_steps or _LONG_EPISODE


def planning_problem(config: EpochConfig, state: EpochState, hyper: Hyperparams) -> Problem:
    """:return: the planning problem with the current networks"""

    def roots(obs: Obs) -> jax.Array:
        seen = state.networks.inside(hyper.vec_normalize(obs))
        return output(config.value, state.networks.value, seen)

    def of_shortfall(obs: Obs) -> jax.Array:
        found = roots(obs)
        return jnp.concatenate([jnp.minimum(found[:1], 0.0), found[1:]])

    return Problem(
        config.twin,
        hyper.params,
        config.discount,
        state.progress.reward_scale,
        state.progress.reward_offset,
        (lambda obs: value_of(roots(obs))) if config.terminal_value else None,
        terminal_roots=of_shortfall if config.terminal_value else None,
        shift_ends=config.shift_ends,
    )


def _input_scales(seen: jax.Array, plans: Plan) -> Normalization:
    lived = plans.alive[..., None] & jnp.isfinite(seen)
    count = jnp.maximum(jnp.sum(lived, (0, 1)), 1)
    mean = jnp.sum(jnp.where(lived, seen, 0.0), (0, 1)) / count
    variance = jnp.sum(jnp.where(lived, (seen - mean) ** 2, 0.0), (0, 1)) / count
    scale = jnp.sqrt(variance)
    return Normalization(mean, jnp.where(scale > 1e-6, scale, 1.0), unclipped())


def _best_reward(plans: Plan) -> jax.Array:
    counted = plans.alive[:, :-1] & jnp.isfinite(plans.rewards)
    best = jnp.max(jnp.where(counted, plans.rewards, -jnp.inf))
    return jnp.where(jnp.isfinite(best), best, 0.0)


def _typical_shortfall(plans: Plan, offset: jax.Array, discount: float) -> jax.Array:
    """Geometric mean of the rollouts' loss against the best reward, extrapolated to all steps."""
    counted = plans.alive[:, :-1] & jnp.isfinite(plans.rewards)
    weights = jnp.where(counted, discount ** jnp.arange(plans.rewards.shape[1]), 0.0)
    shortfalls = jnp.where(counted, plans.rewards - offset, 0.0)
    mean = jnp.sum(weights * shortfalls, 1) / jnp.maximum(jnp.sum(weights, 1), 1e-6)
    length = min(1.0 / (1.0 - discount), _LONGEST) if discount < 1.0 else plans.rewards.shape[1]
    return jnp.exp(jnp.mean(jnp.log(jnp.abs(mean) + 1e-9))) * length
