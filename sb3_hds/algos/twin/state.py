"""What the algorithms that learn through a twin carry from one planning epoch to the next."""

import dataclasses
import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, PRNGKeyArray

from sb3_hds.algos.twin.networks import Actor, Value, output, value_of
from sb3_hds.core import Obs, Params, State, Twin
from sb3_hds.core.numerics.compilation import GENERATOR, QUICK_COMPILATION, QUICKEST_COMPILATION
from sb3_hds.planning import Plan, Problem, best_of_random

# The typical shortfall of the first rollouts becomes this many units of the objective.
_TYPICAL_SHORTFALL = 12.0
# Without discounting, or nearly so, a value counts rewards of at most this many steps.
_LONGEST = 1000.0
# Rows that are vectorised together, see `for_each`.
_GROUP = 16
# Episode length where a twin declares none.
_LONG_EPISODE = 1000


@dataclasses.dataclass(frozen=True)
class EpochConfig:
    """
    What makes two epochs different programs: a change compiles again. The fields are documented as
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
    random_share: float
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


class View(NamedTuple):
    """
    An affine map with clipping, as ``VecNormalize`` applies to observations.

    :param mean: shape ``(n_obs,)``
    :param scale: shape ``(n_obs,)``
    :param clip: largest absolute value that comes out
    """

    mean: Float[Array, " obs"]
    scale: Float[Array, " obs"]
    clip: Any

    def __call__(self, obs: Obs) -> Obs:
        return jnp.clip((obs - self.mean) / self.scale, -self.clip, self.clip)


class Hyperparams(NamedTuple):
    """
    What may change from epoch to epoch without compiling again.

    :param params: the twin's parameters
    :param varied: those of them that differ between rollouts, each of shape ``(n_rollouts,)``
    :param learning_rate: of policy and value
    :param noise: standard deviation of the exploration noise, in units of the control scale
    :param temperature: of the annealed acceptance, in units of the mean gain of the last epoch
    :param reset_share: share of start states drawn from the reset distribution in each epoch
    :param gain_weight: 0..1, how much a sample counts by what its plan gained
    :param sensitivity_weight: 0..1, how much a sample counts by what an error of it costs
    :param averaging: decay of the average of policies, per epoch
    :param gradient_steps: regression steps
    :param view: what the environment's own normalisation does to an observation
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
    view: View


class Networks(NamedTuple):
    """
    What is learned, and saved with a model.

    :param actor: parameters of the policy that is trained
    :param average: moving average of ``actor``
    :param value: parameters of the value network
    :param inside: the networks' own normalisation of their input
    :param acting: the policy that acts: the best of the averages that were compared
    :param acting_inside: the normalisation that belongs to it
    """

    actor: Mapping[str, Any]
    average: Mapping[str, Any]
    value: Mapping[str, Any]
    inside: View
    acting: Mapping[str, Any]
    acting_inside: View


class Progress(NamedTuple):
    """
    What training needs to go on after a break, and is saved with a model.

    :param actor_optimizer: state of Adam
    :param value_optimizer: state of Adam
    :param reward_scale: scale of the objective
    :param reward_offset: reward that counts as zero
    :param control_scale: geometric mean of the size of the plans' controls, shape ``(n_act,)``
    :param gain: mean gain of the last epoch's plans, in units of the objective
    :param n_epochs: epochs done
    :param key: for random numbers, as integers
    """

    actor_optimizer: Any
    value_optimizer: Any
    reward_scale: jax.Array
    reward_offset: jax.Array
    control_scale: jax.Array
    gain: jax.Array
    n_epochs: jax.Array
    key: jax.Array


class Samples(NamedTuple):
    """
    States of plans that were kept, with what is to be learned there. Leaves have shape
    ``(plan_memory, horizon * n_rollouts, ...)``, first steps first: one row for each of the last
    epochs.

    :param obs: as the state sees them
    :param control: scaled to [-1, 1]
    :param value: objective from here on
    :param weight: in the policy's loss; zero where there is nothing to learn
    :param alive: in the value's loss, 0 or 1
    """

    obs: jax.Array
    control: jax.Array
    value: jax.Array
    weight: jax.Array
    alive: jax.Array


class Workspace(NamedTuple):
    """
    What is rebuilt after loading.

    :param starts: start states of the next epoch
    :param ages: how many steps each of them is from a reset
    :param samples: of the last epochs
    :param n_filled: rows of ``samples`` written so far
    """

    starts: State
    ages: jax.Array
    samples: Samples
    n_filled: jax.Array


class Scales(NamedTuple):
    """
    :param inside: of the networks' input
    :param reward_scale: of the objective
    :param reward_offset: reward that counts as zero
    """

    inside: View
    reward_scale: jax.Array
    reward_offset: jax.Array


class EpochState(NamedTuple):
    """Everything that an epoch reads and changes."""

    networks: Networks
    progress: Progress
    workspace: Workspace


@partial(jax.jit, static_argnums=(0, 1, 2, 3), compiler_options=QUICKEST_COMPILATION)
def fresh_networks(
    actor: Actor, value: Value, n_obs: int, max_grad_norm: float, key: PRNGKeyArray
) -> tuple[Networks, Progress]:
    """:return: networks and training state before the first epoch, with scales of one"""
    k_actor, k_value, k_next = jax.random.split(key, 3)
    obs = jnp.zeros(n_obs)
    weights, value_weights = actor.init(k_actor, obs), value.init(k_value, obs)
    inside = View(jnp.zeros(n_obs), jnp.ones(n_obs), _unclipped())
    adam = clipped_adam(max_grad_norm)
    zero = jnp.zeros(())
    progress = Progress(
        adam.init(weights),
        adam.init(value_weights),
        jnp.ones(()),
        zero,
        jnp.ones(actor.n_act),
        zero,
        jnp.zeros((), jnp.int32),
        jax.random.key_data(k_next),
    )
    return Networks(weights, weights, value_weights, inside, weights, inside), progress


@partial(jax.jit, static_argnums=0, compiler_options=QUICK_COMPILATION)
def init_workspace(
    config: EpochConfig, params: Params, view: View, progress: Progress
) -> tuple[Workspace, Scales, Progress]:
    """
    Start states from the twin's reset, no samples, and the scales of observations and rewards, read
    off random rollouts: nothing needs to be set by hand for a new task.

    :return: both, and the training state with its random key moved on
    """
    key = jax.random.wrap_key_data(progress.key, impl=GENERATOR)
    key, k_starts, k_plans = jax.random.split(key, 3)
    n, n_obs, n_act = config.n_rollouts, view.mean.shape[0], len(config.twin.actuators)
    rows = (config.plan_memory, config.horizon * n)
    empty = jnp.zeros(rows)
    samples = Samples(jnp.zeros((*rows, n_obs)), jnp.zeros((*rows, n_act)), empty, empty, empty)
    starts = resets(config.twin, params, k_starts, n)
    workspace = Workspace(starts, jnp.zeros(n), samples, jnp.zeros((), jnp.int32))

    problem = Problem(config.twin, params, config.discount)
    search = lambda start, k: best_of_random(problem, start, k, config.horizon, 1)  # noqa: E731
    plans = jax.vmap(search)(starts, jax.random.split(k_plans, n))
    seen = jax.vmap(jax.vmap(lambda state: view(problem.observe(state))))(plans.states)
    offset = _best_reward(plans) if config.discount < 1.0 else jnp.zeros(())
    shortfall = _typical_shortfall(plans, offset, config.discount)
    scale = _TYPICAL_SHORTFALL / jnp.maximum(shortfall, 1e-6)
    scales = Scales(_input_scales(seen, plans), scale, offset)
    return workspace, scales, progress._replace(key=jax.random.key_data(key))


def clipped_adam(max_grad_norm: float) -> optax.GradientTransformation:
    """Adam without its learning rate, which is a knob."""
    return optax.chain(optax.clip_by_global_norm(max_grad_norm), optax.scale_by_adam(0.9, 0.99))


def resets(twin: Twin, params: Params, key: PRNGKeyArray, n: int) -> State:
    """:return: ``n`` states at the start of an episode"""
    return jax.vmap(lambda k: twin.initial(k, params))(jax.random.split(key, n))


def for_each(function: Callable, *rows: Any) -> Any:
    """
    ``jax.vmap`` over two axes instead of one: on a CPU, XLA multiplies thin matrices twice as fast
    when they have a batch dimension, which is most of what following a policy costs.

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
    """:return: steps after which an episode is cut off, also where the twin declares no limit"""
    return twin.max_episode_steps or _LONG_EPISODE


def problem_of(config: EpochConfig, state: EpochState, hyper: Hyperparams) -> Problem:
    """:return: what the planner maximises with the networks as they are now"""

    def roots(obs: Obs) -> jax.Array:
        seen = state.networks.inside(hyper.view(obs))
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


def _unclipped() -> jax.Array:
    """Of a dtype of its own: one that adapts would be another program than a loaded model's."""
    return jnp.full((), jnp.inf, jnp.float32)


def _input_scales(seen: jax.Array, plans: Plan) -> View:
    lived = plans.alive[..., None] & jnp.isfinite(seen)
    count = jnp.maximum(jnp.sum(lived, (0, 1)), 1)
    mean = jnp.sum(jnp.where(lived, seen, 0.0), (0, 1)) / count
    variance = jnp.sum(jnp.where(lived, (seen - mean) ** 2, 0.0), (0, 1)) / count
    scale = jnp.sqrt(variance)
    return View(mean, jnp.where(scale > 1e-6, scale, 1.0), _unclipped())


def _best_reward(plans: Plan) -> jax.Array:
    counted = plans.alive[:, :-1] & jnp.isfinite(plans.rewards)
    best = jnp.max(jnp.where(counted, plans.rewards, -jnp.inf))
    return jnp.where(jnp.isfinite(best), best, 0.0)


def _typical_shortfall(plans: Plan, offset: jax.Array, discount: float) -> jax.Array:
    """Geometric mean of what rollouts lose on the best reward, as if they went on as they did."""
    counted = plans.alive[:, :-1] & jnp.isfinite(plans.rewards)
    weights = jnp.where(counted, discount ** jnp.arange(plans.rewards.shape[1]), 0.0)
    shortfalls = jnp.where(counted, plans.rewards - offset, 0.0)
    mean = jnp.sum(weights * shortfalls, 1) / jnp.maximum(jnp.sum(weights, 1), 1e-6)
    length = min(1.0 / (1.0 - discount), _LONGEST) if discount < 1.0 else plans.rewards.shape[1]
    return jnp.exp(jnp.mean(jnp.log(jnp.abs(mean) + 1e-9))) * length
