"""
The update of TD7, a pure function: encoder, critics, actor, and copies into the target networks.

Source: Fujimoto et al., *For SALE: State-Action Representation Learning for Deep Reinforcement
Learning*, NeurIPS 2023.
"""

import dataclasses
from functools import partial
from typing import Any, NamedTuple, cast

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from sb3_hds.algos.model_free.replay import Batch
from sb3_hds.algos.model_free.update import UpdateStep, apply_schedule
from sb3_hds.algos.nets.optimizers import Optimizer, TrainState, Weights
from sb3_hds.core.numerics.compilation import QUICK_COMPILATION


@dataclasses.dataclass(frozen=True)
class UpdateConfig:
    """
    Static configuration of the update.

    :param target_update_interval: updates between two copies into the target networks
    :param policy_delay: updates of the critics per update of the actor
    :param target_noise: standard deviation of the noise on the target policy's actions
    :param noise_clip: limit of that noise
    :param alpha: exponent of errors in priorities
    :param uniform: whether transitions are drawn uniformly and weighted in the loss instead
    """

    encoder: nn.Module
    actor: nn.Module
    critic: nn.Module
    n_critics: int
    optimizer: Optimizer
    qf_optimizer: Optimizer
    target_update_interval: int = 250
    policy_delay: int = 2
    target_noise: float = 0.2
    noise_clip: float = 0.5
    alpha: float = 0.4
    uniform: bool = False


class Range(NamedTuple):
    """Range of the values of targets."""

    low: Float[Array, ""]
    high: Float[Array, ""]


class Copies(NamedTuple):
    """
    Weights that change with copies only, not with every update.

    :param encoder: its embeddings are inputs of actor and critics
    :param target_encoder: its embeddings are inputs of target actor and target critics
    """

    encoder: Weights
    actor: Weights
    critic: Weights
    target_encoder: Weights


class Checkpoint(NamedTuple):
    """
    The policy that provides deterministic actions.

    :param kept: 1: there is a checkpoint; 0: its weights are meaningless. A number, since SB3 saves
        it as a parameter.
    """

    encoder: Weights
    actor: Weights
    kept: Float[Array, ""]


class TD7State(NamedTuple):
    """
    Everything that an update changes.

    :param clip: range to which next values are clipped
    :param range: range of all targets so far, never reset, as in the authors' code; each copy
        copies it into ``clip``
    """

    encoder: TrainState
    actor: TrainState
    critic: TrainState
    copies: Copies
    checkpoint: Checkpoint
    clip: Range
    range: Range
    key: PRNGKeyArray
    n_updates: Int[Array, ""]


class UpdateMetrics(NamedTuple):
    """Of the last update; the actor's of its own last update."""

    critic_loss: Float[Array, ""]
    actor_loss: Float[Array, ""]
    encoder_loss: Float[Array, ""]


@partial(jax.jit, static_argnums=(0, 1, 2), compiler_options=QUICK_COMPILATION)
def init_state(config: UpdateConfig, n_obs: int, n_act: int, key: PRNGKeyArray) -> TD7State:
    """:return: newly initialised networks and optimisers"""
    key, encoder_key, actor_key, critic_key = jax.random.split(key, 4)
    obs, action = jnp.zeros((1, n_obs)), jnp.zeros((1, n_act))
    encoder = config.encoder.init(encoder_key, obs, action)
    zs, zsa = cast(tuple[Array, Array], config.encoder.apply(encoder, obs, action))
    actor = config.actor.init(actor_key, obs, zs)
    init = lambda key: config.critic.init(key, obs, action, zsa, zs)  # noqa: E731
    critic = jax.vmap(init)(jax.random.split(critic_key, config.n_critics))
    zero = jnp.zeros(())
    infinite = jnp.full_like(zero, jnp.inf)
    return TD7State(
        encoder=config.qf_optimizer.train_state(encoder),
        actor=config.optimizer.train_state(actor),
        critic=config.qf_optimizer.train_state(critic),
        copies=Copies(encoder, actor, critic, encoder),
        checkpoint=Checkpoint(encoder, actor, zero),
        clip=Range(zero, zero),
        range=Range(infinite, -infinite),
        key=key,
        n_updates=jnp.zeros((), jnp.int32),
    )


def act(config: UpdateConfig, encoder: Weights, actor: Weights, obs: Array) -> Array:
    """:return: actions in [-1, 1] with these weights"""
    no_action = jnp.zeros((*obs.shape[:-1], cast(Any, config.actor).n_act))
    zs, _ = cast(tuple[Array, Array], config.encoder.apply(encoder, obs, no_action))
    return cast(Array, config.actor.apply(actor, obs, zs))


def embed(config: UpdateConfig, weights: Weights, obs: Array, action: Array) -> tuple[Array, Array]:
    """:return: embeddings of states, and of pairs of state and action"""
    return cast(tuple[Array, Array], config.encoder.apply(weights, obs, action))


def q_values(
    config: UpdateConfig, weights: Weights, obs: Array, action: Array, zs: Array, zsa: Array
) -> Array:
    """:return: values of all critics, shape ``(critics, batch)``"""
    one = lambda w: config.critic.apply(w, obs, action, zsa, zs)  # noqa: E731
    return cast(Array, jax.vmap(one)(weights))


@partial(jax.jit, static_argnums=0)
def update(
    config: UpdateConfig,
    state: TD7State,
    batch: Batch,
    learning_rate: float,
    qf_learning_rate: float,
    metrics: UpdateMetrics,
) -> tuple[TD7State, UpdateMetrics, Float[Array, " batch"]]:
    """
    :param batch: of one update
    :return: the state, the metrics, and new priorities of the transitions
    """
    embedded = embed(config, state.copies.encoder, batch.obs, batch.action)
    critics = partial(_update_critics, config, batch, embedded, qf_learning_rate)
    actor = partial(_update_actor, config, batch, embedded[0], learning_rate)
    state, report = apply_schedule(
        state,
        _Report(metrics, jnp.zeros(batch.reward.shape)),
        UpdateStep(("encoder", "critic", "range"), 1, critics),
        UpdateStep(("actor",), config.policy_delay, actor),
        UpdateStep(("copies", "clip"), config.target_update_interval, _copy),
    )
    return state, report.metrics, report.priority


def priorities_of(
    config: UpdateConfig, error: Float[Array, "critics batch"]
) -> Float[Array, " batch"]:
    """:return: priorities of transitions with these absolute errors"""
    return jnp.maximum(error.max(0), 1.0) ** config.alpha


def loss_of(config: UpdateConfig, error: Float[Array, "critics batch"]) -> Float[Array, ""]:
    """
    :param error: absolute errors
    :return: LAP's loss; with uniform sampling, the loss with the same expected gradient

    Source: Fujimoto, Meger and Precup, *An Equivalence between Loss Functions and Non-Uniform
    Sampling in Experience Replay*, NeurIPS 2020.
    """
    loss = jnp.where(error < 1.0, 0.5 * error**2, error)
    if config.uniform:
        priority = jax.lax.stop_gradient(priorities_of(config, error))
        loss = loss * priority / priority.mean()
    return jnp.sum(jnp.mean(loss, 1))


class _Report(NamedTuple):
    """:param priority: of the batch's transitions"""

    metrics: UpdateMetrics
    priority: Float[Array, " batch"]


def _update_critics(
    config: UpdateConfig,
    batch: Batch,
    embedded: tuple[Array, Array],
    rate: float,
    state: TD7State,
    report: _Report,
    key: PRNGKeyArray,
) -> tuple[tuple[TrainState, TrainState, Range], _Report]:
    """Regress the encoder, and the critics on targets of the copied networks."""
    copies = state.copies
    encoder, encoder_loss = _update_encoder(config, state.encoder, batch, rate)
    noise = config.target_noise * jax.random.normal(key, batch.action.shape)
    noise = jnp.clip(noise, -config.noise_clip, config.noise_clip)
    next_action = act(config, copies.target_encoder, copies.actor, batch.next_obs)
    next_action = jnp.clip(next_action + noise, -1.0, 1.0)
    next_embedded = embed(config, copies.target_encoder, batch.next_obs, next_action)
    next_value = q_values(config, copies.critic, batch.next_obs, next_action, *next_embedded).min(0)
    next_value = jnp.clip(next_value, state.clip.low, state.clip.high)
    target = batch.reward + (1.0 - batch.terminated) * batch.discount * next_value
    seen = Range(
        jnp.minimum(state.range.low, target.min()), jnp.maximum(state.range.high, target.max())
    )

    def loss_and_error(params: Any) -> tuple[Array, Array]:
        value = q_values(config, {"params": params}, batch.obs, batch.action, *embedded)
        error = jnp.abs(value - target)
        return loss_of(config, error), error

    loss_and_gradient = jax.value_and_grad(loss_and_error, has_aux=True)
    (loss, error), gradient = loss_and_gradient(state.critic.weights["params"])
    critic = config.qf_optimizer.apply(gradient, state.critic, rate)
    metrics = report.metrics._replace(critic_loss=loss, encoder_loss=encoder_loss)
    return (encoder, critic, seen), _Report(metrics, priorities_of(config, error))


def _update_encoder(
    config: UpdateConfig, encoder: TrainState, batch: Batch, rate: float
) -> tuple[TrainState, Array]:
    """Regress the embedding of state and action on the embedding of the next state."""
    wanted, _ = embed(config, encoder.weights, batch.next_obs, batch.action)

    def loss(params: Any) -> Array:
        _, zsa = embed(config, {"params": params}, batch.obs, batch.action)
        return jnp.mean((zsa - jax.lax.stop_gradient(wanted)) ** 2)

    value, gradient = jax.value_and_grad(loss)(encoder.weights["params"])
    return config.qf_optimizer.apply(gradient, encoder, rate), value


def _update_actor(
    config: UpdateConfig,
    batch: Batch,
    zs: Array,
    rate: float,
    state: TD7State,
    report: _Report,
    _: PRNGKeyArray,
) -> tuple[tuple[TrainState], _Report]:
    """Maximise the mean of the critics over the actor."""

    def loss(params: Any) -> Array:
        action = cast(Array, config.actor.apply({"params": params}, batch.obs, zs))
        _, zsa = embed(config, state.copies.encoder, batch.obs, action)
        value = q_values(config, state.critic.weights, batch.obs, action, zs, zsa)
        return -jnp.mean(value)

    value, gradient = jax.value_and_grad(loss)(state.actor.weights["params"])
    actor = config.optimizer.apply(gradient, state.actor, rate)
    return (actor,), report._replace(metrics=report.metrics._replace(actor_loss=value))


def _copy(
    state: TD7State, report: _Report, _: PRNGKeyArray
) -> tuple[tuple[Copies, Range], _Report]:
    """Copy networks and the range of targets into those that compute targets."""
    copies = Copies(
        state.encoder.weights,
        state.actor.weights,
        state.critic.weights,
        state.copies.encoder,
    )
    return (copies, state.range), report
