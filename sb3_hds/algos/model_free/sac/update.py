"""
Updates of the model-free algorithms, pure and compiled once.

All go by :func:`in_turn`: critics, now and then the actor, now and then what is copied. The SAC
family shares these parts, too, and what differs between two of its algorithms is a :class:`Recipe`:
how the critics' next values become a target, how far predictions are from it, what the critics are
worth to the actor, and which networks and optimisers there are. TD7 has parts of its own.
"""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, Protocol, TypeVar, cast

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int, PRNGKeyArray

from sb3_hds.algos.nets.observations import Seen, seen
from sb3_hds.algos.nets.optimizers import Optimizer, Trained, Weights
from sb3_hds.algos.nets.squashed import Gaussian, log_probability
from sb3_hds.core.numerics.compilation import QUICK_COMPILATION

Values = Float[Array, "critics batch values"]
Targets = Float[Array, "batch targets"]
Loss = Float[Array, ""]
Losses = TypeVar("Losses", bound=NamedTuple)
AnyLearner = TypeVar("AnyLearner", bound=NamedTuple)
Found = TypeVar("Found")


class Batch(NamedTuple):
    """
    Transitions. ``discount`` is that of the next value: :math:`\\gamma^n` for n-step returns.
    """

    obs: Float[Array, "*batch obs"]
    action: Float[Array, "*batch act"]
    next_obs: Float[Array, "*batch obs"]
    reward: Float[Array, "*batch"]
    terminated: Float[Array, "*batch"]
    discount: Float[Array, "*batch"]


class Learner(NamedTuple):
    """
    Everything that an update changes.

    :param target: weights of the target critics; empty where there are none
    :param log_ent_coef: logarithm of the entropy coefficient, shape ``()``
    :param seen: what observations were like so far
    :param extra: what only one algorithm has
    """

    actor: Trained
    critic: Trained
    target: Weights
    log_ent_coef: Trained
    seen: Seen
    extra: Any
    key: PRNGKeyArray
    n_updates: Int[Array, ""]


class Knobs(NamedTuple):
    """What may change from call to call without compiling again."""

    learning_rate: float
    qf_learning_rate: float
    tau: float
    target_entropy: float


class Report(NamedTuple):
    """Of the last update; the actor's of the last one in which it was updated."""

    critic_loss: Loss
    actor_loss: Loss
    ent_coef: Loss
    ent_coef_loss: Loss


def before_any(report: type[Losses]) -> Losses:
    """
    :param report: a named tuple of numbers
    :return: one before any update
    """
    # Of NumPy: JAX would dispatch each as a program of its own, at every step.
    zero: Any = np.zeros((), jnp.result_type(float))
    return report._make(zero for _ in report._fields)


@dataclasses.dataclass(frozen=True)
class Recipe:
    """
    What an algorithm of the SAC family is made of. Static: equal recipes share compiled programs.

    :param actor: observation to ``Gaussian``
    :param critic: observation and action to values; an ensemble shares this one's structure
    :param n_critics: members of the ensemble
    :param target_of: next values of all critics to the values that become targets
    :param error: loss of all critics' values against targets
    :param worth: values of all critics to what the actor climbs, shape ``(batch,)``
    :param optimizer: of the actor
    :param qf_optimizer: of the critics
    :param ent_coef_optimizer: of the logarithm of the entropy coefficient; None: Adam
    :param policy_delay: updates of the critics for each of the actor
    :param target_every: updates of the critics for each of the target networks
    :param learns_ent_coef: whether the entropy coefficient follows the target entropy
    :param linear_ent_coef: whether its loss has it itself, not its logarithm
    :param joint_pass: whether current and next values come from one pass of the critics, without
        target networks (CrossQ)
    :param normalize: whether observations are normalised by running statistics (SimBa)
    :param extra: what else is updated after the actor; None: nothing
    """

    actor: nn.Module
    critic: nn.Module
    n_critics: int
    target_of: Callable[[Values], Targets]
    error: Callable[[Values, Targets], Loss]
    worth: Callable[[Values], Float[Array, " batch"]]
    optimizer: "Optimizer"
    qf_optimizer: "Optimizer"
    ent_coef_optimizer: "Optimizer | None" = None
    policy_delay: int = 1
    target_every: int = 1
    learns_ent_coef: bool = True
    linear_ent_coef: bool = False
    joint_pass: bool = False
    normalize: bool = False
    extra: "Extra | None" = None


class Extra(Protocol):
    """Something more that learns (BRO's optimistic actor)."""

    def init(self, actor: Weights, obs: Array, key: PRNGKeyArray) -> Any:
        """:return: its state, for fresh networks"""
        ...

    def update(
        self, recipe: Recipe, learner: Learner, batch: Batch, knobs: Knobs, key: PRNGKeyArray
    ) -> Any:
        """:return: its state after an update of the actor"""
        ...

    def explore(self, state: Any, obs: Array, gaussian: Gaussian, apart: Array) -> Array:
        """
        :param gaussian: of the actor
        :param apart: how far from its mean actions would be, before they are squashed
        :return: actions to explore by
        """
        ...


# --- how an ensemble's next values become a target, how far off it is, what it is worth


def least(values: Values) -> Targets:
    """Clipped double Q-learning (Fujimoto et al. 2018)."""
    return jnp.min(values, 0)


def average(values: Values) -> Targets:
    """Of the critics, value by value (BRO)."""
    return jnp.mean(values, 0)


def squared(values: Values, targets: Targets) -> Loss:
    """Half the mean squared error, summed over critics."""
    return 0.5 * jnp.sum(jnp.mean((values - targets[None]) ** 2, (1, 2)))


def pessimistic(values: Values) -> Float[Array, " batch"]:
    """The least of the critics (SAC)."""
    return jnp.min(jnp.mean(values, -1), 0)


def mean(values: Values) -> Float[Array, " batch"]:
    """Of critics and quantiles (DroQ, TQC, BRO)."""
    return jnp.mean(values, (0, 2))


# --- the skeleton of all updates


class Turn(NamedTuple):
    """
    A part of an update.

    :param fields: of the learner, which it changes
    :param every: updates from one turn of it to the next
    :param change: learner, what was found so far and a key to what becomes of these fields, and
        what is found now
    """

    fields: tuple[str, ...]
    every: int
    change: Callable[[Any, Any, PRNGKeyArray], tuple[tuple[Any, ...], Any]]


def in_turn(learner: AnyLearner, found: Found, *turns: Turn) -> tuple[AnyLearner, Found]:
    """
    One update of any model-free algorithm: its parts, each where it is due, with a random key.

    :param learner: has a ``key`` and counts its updates in ``n_updates``
    :param found: a report, or more
    :param turns: one after the other; each sees what those before it have changed
    :return: both after an update
    """
    now: Any = learner
    key, *keys = jax.random.split(now.key, 1 + len(turns))
    now = now._replace(key=key, n_updates=now.n_updates + 1)
    for turn, key in zip(turns, keys, strict=True):
        change = partial(turn.change, now, found, key)
        if turn.every == 1:
            fields, found = change()
        else:
            # Other fields stay outside: what a branch hands through is copied.
            before = tuple(getattr(now, name) for name in turn.fields), found
            due = now.n_updates % turn.every == 0
            fields, found = jax.lax.cond(due, change, lambda before=before: before)
        now = now._replace(**dict(zip(turn.fields, fields, strict=True)))
    return now, found


# --- the update of the SAC family


def act(
    actor: nn.Module, weights: Weights, obs: Array, train: bool = False
) -> tuple[Gaussian, Weights]:
    """:return: the actor's Gaussian, and its weights with the statistics of this pass"""
    if not train or "statistics" not in weights:
        return cast(Gaussian, actor.apply(weights, obs, train)), weights
    gaussian, changed = actor.apply(weights, obs, train, mutable=["statistics"])
    return cast(Gaussian, gaussian), {**weights, **changed}


def judge(
    recipe: Recipe,
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

    def one(
        weights: Weights, key: PRNGKeyArray, obs: Array, action: Array
    ) -> tuple[Array, Weights]:
        rngs = {"dropout": key}
        if not train or "statistics" not in weights:
            return cast(Array, recipe.critic.apply(weights, obs, action, train, rngs=rngs)), weights
        values, changed = recipe.critic.apply(
            weights, obs, action, train, rngs=rngs, mutable=["statistics"]
        )
        return cast(Array, values), {**weights, **changed}

    keys = jax.random.split(key, recipe.n_critics)
    if recipe.n_critics > 1:
        # Of inputs without an axis of the critics, XLA computes products that it then transposes.
        each = lambda x: jnp.broadcast_to(x, (recipe.n_critics, *x.shape))  # noqa: E731
        return jax.vmap(one)(weights, keys, each(obs), each(action))
    # One critic, mapped: XLA computes gradients of its kernels transposed, and Adam walks across.
    values, weights = one(jax.tree.map(lambda x: x[0], weights), keys[0], obs, action)
    return values[None], jax.tree.map(lambda x: x[None], weights)


def sample(gaussian: Gaussian, key: PRNGKeyArray) -> tuple[Array, Array]:
    """:return: actions drawn from it, and their log-density"""
    before = gaussian.mean + gaussian.std * jax.random.normal(key, gaussian.mean.shape)
    return jnp.tanh(before), log_probability(gaussian, before)


def explored(
    recipe: Recipe, weights: Weights, extra: Any, obs: Array, noise: Callable[[Gaussian], Array]
) -> Array:
    """
    :param weights: of the actor
    :param extra: what only one algorithm has
    :param obs: as the networks see them
    :param noise: how far from the Gaussian's mean actions are, before they are squashed
    :return: actions by which the algorithm explores
    """
    gaussian, _ = act(recipe.actor, weights, obs)
    if recipe.extra is not None:
        return recipe.extra.explore(extra, obs, gaussian, noise(gaussian))
    return jnp.tanh(gaussian.mean + noise(gaussian))


def log_of(ent_coef: Array | float) -> Array:
    """:return: its logarithm; of 0, that of the least positive number, with no infinity in it"""
    return jnp.log(jnp.maximum(jnp.asarray(ent_coef, jnp.float32), jnp.finfo(jnp.float32).tiny))


@partial(jax.jit, static_argnums=(0, 1, 2), compiler_options=QUICK_COMPILATION)
def begin(recipe: Recipe, n_obs: int, n_act: int, ent_coef: float, key: PRNGKeyArray) -> Learner:
    """:return: fresh networks and optimisers"""
    key, actor_key, critic_key, extra_key = jax.random.split(key, 4)
    obs, action = jnp.zeros((1, n_obs)), jnp.zeros((1, n_act))
    actor = recipe.actor.init(actor_key, obs)
    init = lambda key: recipe.critic.init({"params": key, "dropout": key}, obs, action)  # noqa: E731
    critic = jax.vmap(init)(jax.random.split(critic_key, recipe.n_critics))
    log_ent_coef = {"params": log_of(ent_coef)}
    of_ent_coef = recipe.ent_coef_optimizer or _ADAM
    return Learner(
        actor=Trained(actor, recipe.optimizer.init(actor["params"])),
        critic=Trained(critic, recipe.qf_optimizer.init(critic["params"])),
        target={} if recipe.joint_pass else critic,
        log_ent_coef=Trained(log_ent_coef, of_ent_coef.init(log_ent_coef["params"])),
        seen=Seen.nothing(n_obs),
        extra=recipe.extra.init(actor, obs, extra_key) if recipe.extra else {},
        key=key,
        n_updates=jnp.zeros((), jnp.int32),
    )


@partial(jax.jit, static_argnums=0)
def update(
    recipe: Recipe,
    learner: Learner,
    batches: Batch,
    n: int | Array,
    knobs: Knobs,
    report: Report,
) -> tuple[Learner, Report]:
    """
    :param batches: with a leading axis of at least ``n`` batches; the rest is not looked at, so
        that different ``n`` share a compiled program
    :param n: how many updates, at least 1
    :param report: of the updates before
    """

    def one(i: Array, carry: tuple[Learner, Report]) -> tuple[Learner, Report]:
        learner, report = carry
        return update_once(recipe, learner, jax.tree.map(lambda x: x[i], batches), knobs, report)

    before = learner, report
    if len(batches.reward) == 1:  # without a loop, whose carry would be copied
        return one(jnp.zeros((), jnp.int32), before)
    return jax.lax.fori_loop(0, n, one, before)


def update_once(
    recipe: Recipe, learner: Learner, batch: Batch, knobs: Knobs, report: Report
) -> tuple[Learner, Report]:
    """The critics on one batch; every ``policy_delay`` updates the actor on the same one."""
    if recipe.normalize:
        batch = batch._replace(
            obs=seen(learner.seen, batch.obs), next_obs=seen(learner.seen, batch.next_obs)
        )
    critics = partial(update_critics, recipe, batch, knobs)
    actor = partial(update_actor, recipe, batch, knobs)
    turns = [
        Turn(("critic",), 1, critics),
        Turn(("actor", "log_ent_coef", "extra"), recipe.policy_delay, actor),
    ]
    if not recipe.joint_pass:
        turns.append(Turn(("target",), recipe.target_every, partial(follow, knobs.tau)))
    return in_turn(learner, report, *turns)


def update_critics(
    recipe: Recipe,
    batch: Batch,
    knobs: Knobs,
    learner: Learner,
    report: Report,
    key: PRNGKeyArray,
) -> tuple[tuple[Trained], Report]:
    """Regress the critics on soft targets."""
    act_key, key, next_key = jax.random.split(key, 3)
    gaussian, _ = act(recipe.actor, learner.actor.weights, batch.next_obs)
    next_action, log_prob = sample(gaussian, act_key)
    bonus = -jnp.exp(learner.log_ent_coef.weights["params"]) * log_prob
    reward, discount = batch.reward, batch.discount * (1.0 - batch.terminated)

    def soft_targets(next_values: Values) -> Targets:
        chosen = recipe.target_of(next_values) + bonus[:, None]
        return jax.lax.stop_gradient(reward[:, None] + discount[:, None] * chosen)

    def apart(params: Any) -> tuple[Loss, Weights]:
        next_values, _ = judge(recipe, learner.target, batch.next_obs, next_action, next_key)
        weights = {**learner.critic.weights, "params": params}
        values, weights = judge(recipe, weights, batch.obs, batch.action, key, train=True)
        return recipe.error(values, soft_targets(next_values)), weights

    def jointly(params: Any) -> tuple[Loss, Weights]:
        weights = {**learner.critic.weights, "params": params}
        obs = jnp.concatenate([batch.obs, batch.next_obs])
        action = jnp.concatenate([batch.action, next_action])
        both, weights = judge(recipe, weights, obs, action, key, train=True)
        values, next_values = jnp.split(both, 2, axis=1)
        return recipe.error(values, soft_targets(next_values)), weights

    loss = jointly if recipe.joint_pass else apart
    gradient = jax.value_and_grad(loss, has_aux=True)
    (value, weights), slope = gradient(learner.critic.weights["params"])
    critic = recipe.qf_optimizer.apply(
        slope, Trained(weights, learner.critic.optimizer), knobs.qf_learning_rate
    )
    return (critic,), report._replace(critic_loss=value)


def follow(
    tau: float | Array, learner: Learner, report: Report, _: PRNGKeyArray
) -> tuple[tuple[Weights], Report]:
    """The target critics come nearer."""
    nearer = lambda old, new: old + tau * (new - old)  # noqa: E731
    return (jax.tree.map(nearer, learner.target, learner.critic.weights),), report


def update_actor(
    recipe: Recipe,
    batch: Batch,
    knobs: Knobs,
    learner: Learner,
    report: Report,
    key: PRNGKeyArray,
) -> tuple[tuple[Trained, Trained, Any], Report]:
    r"""
    Climb what the critics think of the actor's own actions, and follow the target entropy.

    The loss of the entropy coefficient is :math:`\log\alpha\,(H - \bar{H})`, as in SB3, SBX and
    the authors' code of DroQ and TQC; with ``linear_ent_coef``, it is
    :math:`\alpha\,(H - \bar{H})`, as in equation 18 of Haarnoja et al. Adam takes out the factor
    between their slopes only where it does not change. Where :math:`\alpha` steadily falls, the
    latter falls at :math:`\sqrt{1 + k^2} - k` of the speed, with :math:`k` the learning rate in
    units of 1e-3, as Adam remembers squares for 1000 updates: 0.9, 0.74 and 0.41 at 1e-4, 3e-4 and
    1e-3.
    """
    act_key, judge_key, extra_key = jax.random.split(key, 3)
    ent_coef = jnp.exp(learner.log_ent_coef.weights["params"])

    def loss(params: Any) -> tuple[Loss, tuple[Array, Weights]]:
        weights = {**learner.actor.weights, "params": params}
        gaussian, weights = act(recipe.actor, weights, batch.obs, train=True)
        action, log_prob = sample(gaussian, act_key)
        values, _ = judge(recipe, learner.critic.weights, batch.obs, action, judge_key)
        return jnp.mean(ent_coef * log_prob - recipe.worth(values)), (-log_prob.mean(), weights)

    gradient = jax.value_and_grad(loss, has_aux=True)
    (value, (entropy, weights)), slope = gradient(learner.actor.weights["params"])
    actor = recipe.optimizer.apply(
        slope, Trained(weights, learner.actor.optimizer), knobs.learning_rate
    )
    log_ent_coef, excess = learner.log_ent_coef, entropy - knobs.target_entropy
    linear = recipe.linear_ent_coef
    report = report._replace(
        actor_loss=value,
        ent_coef=ent_coef,
        ent_coef_loss=excess * (ent_coef if linear else log_ent_coef.weights["params"]),
    )
    if recipe.learns_ent_coef:
        of_ent_coef = recipe.ent_coef_optimizer or _ADAM
        slope = excess * ent_coef if linear else excess
        log_ent_coef = of_ent_coef.apply(slope, log_ent_coef, knobs.learning_rate)
    extra = learner.extra
    if recipe.extra is not None:
        now = learner._replace(actor=actor, log_ent_coef=log_ent_coef)
        extra = recipe.extra.update(recipe, now, batch, knobs, extra_key)
    return (actor, log_ent_coef, extra), report


_ADAM = Optimizer(optax.adam)
