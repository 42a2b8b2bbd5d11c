"""
The update of the SAC family, pure and compiled once.

:func:`update` makes several updates. :func:`update_once` regresses the critics on soft targets, in
intervals improves the actor and adapts the entropy coefficient, and in intervals Polyak-averages
the target critics. Algorithms of the family differ in their :class:`UpdateConfig`.
"""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, Protocol

import flax.linen as nn
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int, PRNGKeyArray

from sb3_hds.algos.model_free.replay import Batch
from sb3_hds.algos.model_free.sac.networks import Gaussian, log_probability
from sb3_hds.algos.model_free.update import UpdateStep, apply_schedule
from sb3_hds.algos.nets.observations import RunningStats, normalize
from sb3_hds.algos.nets.optimizers import Optimizer, TrainState, Weights
from sb3_hds.core.numerics.compilation import QUICK_COMPILATION

Values = Float[Array, "critics batch values"]
Targets = Float[Array, "batch targets"]
Loss = Float[Array, ""]


class SACState(NamedTuple):
    """
    Everything that an update changes.

    :param target: weights of the target critics; empty if there are none
    :param log_ent_coef: logarithm of the entropy coefficient, shape ``()``
    :param obs_stats: running statistics of the observations
    :param extra: state of :class:`Extra`; empty without one
    """

    actor: TrainState
    critic: TrainState
    target: Weights
    log_ent_coef: TrainState
    obs_stats: RunningStats
    extra: Any
    key: PRNGKeyArray
    n_updates: Int[Array, ""]


class Hyperparams(NamedTuple):
    """What may change between two calls without recompiling."""

    learning_rate: float
    qf_learning_rate: float
    tau: float
    target_entropy: float


class UpdateMetrics(NamedTuple):
    """Of the last update; the actor's and the entropy coefficient's of their own last update."""

    critic_loss: Loss
    actor_loss: Loss
    ent_coef: Loss
    ent_coef_loss: Loss


_ADAM = Optimizer(optax.adam)


@dataclasses.dataclass(frozen=True)
class UpdateConfig:
    """
    Static configuration of an algorithm's update; equal configs share compiled programs.

    :param actor: maps an observation to a ``Gaussian``
    :param critic: maps observation and action to values; the structure of all critics
    :param n_critics: number of critics
    :param target_values: maps the next values of all critics to the values in the targets
    :param critic_loss: loss of the values of all critics for given targets
    :param actor_objective: maps the values of all critics to what the actor maximises, shape
        ``(batch,)``
    :param optimizer: of the actor
    :param qf_optimizer: of the critics
    :param ent_coef_optimizer: of the logarithm of the entropy coefficient
    :param policy_delay: updates of the critics per update of the actor
    :param target_update_interval: updates of the critics per update of the target critics
    :param learns_ent_coef: whether the entropy coefficient is adapted to the target entropy
    :param linear_ent_coef: whether its loss is linear in the coefficient, not in its logarithm
    :param joint_pass: whether current and next values come from one forward pass of the critics,
        without target critics (CrossQ)
    :param normalize_observations: whether to normalise them by running statistics (SimBa)
    :param extra: what is updated in addition, after the actor; None: nothing
    """

    actor: nn.Module
    critic: nn.Module
    n_critics: int
    target_values: Callable[[Values], Targets]
    critic_loss: Callable[[Values, Targets], Loss]
    actor_objective: Callable[[Values], Float[Array, " batch"]]
    optimizer: Optimizer
    qf_optimizer: Optimizer
    ent_coef_optimizer: Optimizer = _ADAM
    policy_delay: int = 1
    target_update_interval: int = 1
    learns_ent_coef: bool = True
    linear_ent_coef: bool = False
    joint_pass: bool = False
    normalize_observations: bool = False
    extra: "Extra | None" = None


class Extra(Protocol):
    """An additional part that learns, such as BRO's optimistic actor."""

    def init(self, actor: Weights, obs: Array, key: PRNGKeyArray) -> Any:
        """:return: its initial state"""

    def update(
        self, config: UpdateConfig, state: SACState, batch: Batch, hyper: Hyperparams, key: Any
    ) -> Any:
        """:return: its state after an update of the actor"""

    def explore(self, state: Any, obs: Array, gaussian: Gaussian, noise: Array) -> Array:
        """
        :param gaussian: of the actor
        :param noise: deviation from the actor's mean, before tanh
        :return: exploratory actions
        """
        ...


@partial(jax.jit, static_argnums=(0, 1, 2), compiler_options=QUICK_COMPILATION)
def init_state(
    config: UpdateConfig, n_obs: int, n_act: int, ent_coef: float, key: PRNGKeyArray
) -> SACState:
    """:return: newly initialised networks and optimisers"""
    key, actor_key, critic_key, extra_key = jax.random.split(key, 4)
    obs, action = jnp.zeros((1, n_obs)), jnp.zeros((1, n_act))
    actor = config.actor.init(actor_key, obs)
    init = lambda key: config.critic.init({"params": key, "dropout": key}, obs, action)  # noqa: E731
    critic = jax.vmap(init)(jax.random.split(critic_key, config.n_critics))
    return SACState(
        actor=config.optimizer.train_state(actor),
        critic=config.qf_optimizer.train_state(critic),
        target={} if config.joint_pass else critic,
        log_ent_coef=config.ent_coef_optimizer.train_state({"params": log_of(ent_coef)}),
        obs_stats=RunningStats.empty(n_obs),
        extra=config.extra.init(actor, obs, extra_key) if config.extra else {},
        key=key,
        n_updates=jnp.zeros((), jnp.int32),
    )


# --- the update


@partial(jax.jit, static_argnums=0)
def update(
    config: UpdateConfig,
    state: SACState,
    batches: Batch,
    n: int | Array,
    hyper: Hyperparams,
    metrics: UpdateMetrics,
) -> tuple[SACState, UpdateMetrics]:
    """
    :param batches: with a leading axis of at least ``n`` batches; the rest is ignored, so that
        different ``n`` share a compiled program
    :param n: number of updates, at least 1
    :param metrics: of the previous updates
    """

    def one(i: Array, carry: tuple[SACState, UpdateMetrics]) -> tuple[SACState, UpdateMetrics]:
        state, metrics = carry
        return update_once(config, state, jax.tree.map(lambda x: x[i], batches), hyper, metrics)

    before = state, metrics
    if len(batches.reward) == 1:  # a loop would copy its carry
        return one(jnp.zeros((), jnp.int32), before)
    return jax.lax.fori_loop(0, n, one, before)


def update_once(
    config: UpdateConfig,
    state: SACState,
    batch: Batch,
    hyper: Hyperparams,
    metrics: UpdateMetrics,
) -> tuple[SACState, UpdateMetrics]:
    """Update the critics on one batch, every ``policy_delay`` updates the actor on the same one."""
    if config.normalize_observations:
        batch = batch._replace(
            obs=normalize(state.obs_stats, batch.obs),
            next_obs=normalize(state.obs_stats, batch.next_obs),
        )
    actor = partial(update_actor, config, batch, hyper)
    steps = [
        UpdateStep(("critic",), 1, partial(update_critics, config, batch, hyper)),
        UpdateStep(("actor", "log_ent_coef", "extra"), config.policy_delay, actor),
    ]
    if not config.joint_pass:
        average = partial(soft_update, hyper.tau)
        steps.append(UpdateStep(("target",), config.target_update_interval, average))
    return apply_schedule(state, metrics, *steps)


def update_critics(
    config: UpdateConfig,
    batch: Batch,
    hyper: Hyperparams,
    state: SACState,
    metrics: UpdateMetrics,
    key: PRNGKeyArray,
) -> tuple[tuple[TrainState], UpdateMetrics]:
    r"""
    Regress the critics on :math:`r + \gamma\,(Q'(s', a') - \alpha \log \pi(a' | s'))` with
    :math:`a' \sim \pi(s')`.
    """
    act_key, key, next_key = jax.random.split(key, 3)
    gaussian, _ = forward(config.actor, state.actor.weights, batch.next_obs)
    next_action, log_prob = sample(gaussian, act_key)
    bonus = -jnp.exp(state.log_ent_coef.weights["params"]) * log_prob
    reward, discount = batch.reward, batch.discount * (1.0 - batch.terminated)

    def loss(params: Any) -> tuple[Loss, Weights]:
        weights = {**state.critic.weights, "params": params}
        if config.joint_pass:
            obs = jnp.concatenate([batch.obs, batch.next_obs])
            action = jnp.concatenate([batch.action, next_action])
            both, weights = q_values(config, weights, obs, action, key, train=True)
            values, next_values = jnp.split(both, 2, axis=1)
        else:
            next_values, _ = q_values(config, state.target, batch.next_obs, next_action, next_key)
            values, weights = q_values(config, weights, batch.obs, batch.action, key, train=True)
        soft = config.target_values(next_values) + bonus[:, None]
        targets = jax.lax.stop_gradient(reward[:, None] + discount[:, None] * soft)
        return config.critic_loss(values, targets), weights

    loss_and_gradient = jax.value_and_grad(loss, has_aux=True)
    (value, weights), gradient = loss_and_gradient(state.critic.weights["params"])
    critic = TrainState(weights, state.critic.optimizer)
    critic = config.qf_optimizer.apply(gradient, critic, hyper.qf_learning_rate)
    return (critic,), metrics._replace(critic_loss=value)


def update_actor(
    config: UpdateConfig,
    batch: Batch,
    hyper: Hyperparams,
    state: SACState,
    metrics: UpdateMetrics,
    key: PRNGKeyArray,
) -> tuple[tuple[TrainState, TrainState, Any], UpdateMetrics]:
    r"""
    Maximise :math:`Q(s, a) - \alpha \log \pi(a | s)` over the actor, and adapt the entropy
    coefficient :math:`\alpha` to the target entropy.

    The loss of the entropy coefficient is :math:`\log\alpha\,(H - \bar{H})`, as in SB3, SBX and
    the authors' code of DroQ and TQC; with ``linear_ent_coef``, it is
    :math:`\alpha\,(H - \bar{H})`, as in equation 18 of Haarnoja et al. Adam cancels the factor
    :math:`\alpha` between their slopes only while it is constant. Where :math:`\alpha` falls
    steadily, the latter falls at :math:`\sqrt{1 + k^2} - k` of the speed, with :math:`k` the
    learning rate in units of 1e-3, since Adam averages squares over 1000 updates: 0.9, 0.74 and
    0.41 at 1e-4, 3e-4 and 1e-3.
    """
    act_key, q_key, extra_key = jax.random.split(key, 3)
    ent_coef = jnp.exp(state.log_ent_coef.weights["params"])

    def loss(params: Any) -> tuple[Loss, tuple[Array, Weights]]:
        weights = {**state.actor.weights, "params": params}
        gaussian, weights = forward(config.actor, weights, batch.obs, train=True)
        action, log_prob = sample(gaussian, act_key)
        values, _ = q_values(config, state.critic.weights, batch.obs, action, q_key)
        objective = config.actor_objective(values)
        return jnp.mean(ent_coef * log_prob - objective), (-log_prob.mean(), weights)

    loss_and_gradient = jax.value_and_grad(loss, has_aux=True)
    (value, (entropy, weights)), gradient = loss_and_gradient(state.actor.weights["params"])
    actor = TrainState(weights, state.actor.optimizer)
    actor = config.optimizer.apply(gradient, actor, hyper.learning_rate)
    log_ent_coef, excess = state.log_ent_coef, entropy - hyper.target_entropy
    linear, extra = config.linear_ent_coef, state.extra
    metrics = metrics._replace(
        actor_loss=value,
        ent_coef=ent_coef,
        ent_coef_loss=excess * (ent_coef if linear else log_ent_coef.weights["params"]),
    )
    if config.learns_ent_coef:
        gradient = excess * ent_coef if linear else excess
        log_ent_coef = config.ent_coef_optimizer.apply(gradient, log_ent_coef, hyper.learning_rate)
    if config.extra is not None:
        now = state._replace(actor=actor, log_ent_coef=log_ent_coef)
        extra = config.extra.update(config, now, batch, hyper, extra_key)
    return (actor, log_ent_coef, extra), metrics


def soft_update(
    tau: float | Array, state: SACState, metrics: UpdateMetrics, _: PRNGKeyArray
) -> tuple[tuple[Weights], UpdateMetrics]:
    """Polyak-average the target critics towards the online ones."""
    average = lambda target, online: target + tau * (online - target)  # noqa: E731
    return (jax.tree.map(average, state.target, state.critic.weights),), metrics


# --- what UpdateConfig chooses from


def min_values(values: Values) -> Targets:
    """Minimum over critics, value by value: clipped double Q-learning (Fujimoto et al. 2018)."""
    return jnp.min(values, 0)


def mean_values(values: Values) -> Targets:
    """Mean over critics, value by value (BRO)."""
    return jnp.mean(values, 0)


def squared_error(values: Values, targets: Targets) -> Loss:
    """Half the mean squared error, summed over critics."""
    return 0.5 * jnp.sum(jnp.mean((values - targets[None]) ** 2, (1, 2)))


def min_q(values: Values) -> Float[Array, " batch"]:
    """Minimum over critics (SAC)."""
    return jnp.min(jnp.mean(values, -1), 0)


def mean_q(values: Values) -> Float[Array, " batch"]:
    """Mean over critics and quantiles (DroQ, TQC, BRO)."""
    return jnp.mean(values, (0, 2))


# --- forward passes


def forward(
    network: nn.Module, weights: Weights, *inputs: Any, train: bool = False, **rngs: Any
) -> tuple[Any, Weights]:
    """:return: what the network computes, and its weights with the batch statistics of this pass"""
    if not train or "statistics" not in weights:
        return network.apply(weights, *inputs, train, **rngs), weights
    output, changed = network.apply(weights, *inputs, train, **rngs, mutable=["statistics"])
    return output, {**weights, **changed}


def q_values(
    config: UpdateConfig,
    weights: Weights,
    obs: Array,
    action: Array,
    key: PRNGKeyArray,
    train: bool = False,
) -> tuple[Values, Weights]:
    """
    :param key: of the dropout masks, which differ between critics
    :return: values of all critics, and their weights with the statistics of this pass
    """

    def one(weights: Weights, key: PRNGKeyArray, *inputs: Array) -> tuple[Array, Weights]:
        return forward(config.critic, weights, *inputs, train=train, rngs={"dropout": key})

    keys = jax.random.split(key, config.n_critics)
    if config.n_critics > 1:
        # For inputs without an axis of critics, XLA would compute products and transpose them.
        each = lambda x: jnp.broadcast_to(x, (config.n_critics, *x.shape))  # noqa: E731
        return jax.vmap(one)(weights, keys, each(obs), each(action))
    # For one critic under vmap, XLA would transpose the gradients of kernels, which slows Adam.
    values, weights = one(jax.tree.map(lambda x: x[0], weights), keys[0], obs, action)
    return values[None], jax.tree.map(lambda x: x[None], weights)


def sample(gaussian: Gaussian, key: PRNGKeyArray) -> tuple[Array, Array]:
    """:return: actions sampled from the policy, and their log-density"""
    before = gaussian.mean + gaussian.std * jax.random.normal(key, gaussian.mean.shape)
    return jnp.tanh(before), log_probability(gaussian, before)


def explore(
    config: UpdateConfig, weights: Weights, extra: Any, obs: Array, noise: Callable
) -> Array:
    """
    :param weights: of the actor
    :param extra: state of ``config.extra``
    :param obs: as the networks see them
    :param noise: maps a Gaussian to deviations from its mean, before tanh
    :return: exploratory actions
    """
    gaussian, _ = forward(config.actor, weights, obs)
    if config.extra is not None:
        return config.extra.explore(extra, obs, gaussian, noise(gaussian))
    return jnp.tanh(gaussian.mean + noise(gaussian))


def log_of(ent_coef: Array | float) -> Array:
    """:return: its logarithm, finite also for 0: that of the least positive normal number"""
    return jnp.log(jnp.maximum(jnp.asarray(ent_coef, jnp.float32), jnp.finfo(jnp.float32).tiny))
