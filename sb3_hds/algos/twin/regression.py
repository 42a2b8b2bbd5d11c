"""Regression of policy and value on plans: the second half of an epoch, and its samples."""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from sb3_hds.algos.twin.policy import (
    clipped_adam,
    output,
    root_of_value,
    value_of,
    with_input_scales,
)
from sb3_hds.algos.twin.state import (
    EpochConfig,
    EpochState,
    Hyperparams,
    Samples,
)
from sb3_hds.algos.twin.threads import run_in_parallel
from sb3_hds.core.numerics.compilation import GENERATOR
from sb3_hds.planning import Plan, Problem

# Error below which the absolute loss becomes quadratic, in units of the control scale.
_SMOOTH_ERROR = 0.1
# Numerator of the rate at which scales follow the plans: after this many epochs, it is 1/2.
_FORGETTING = 3.0
# Inputs with a smaller standard deviation keep their scale; smallest control scale.
_LEAST_STD, _LEAST_CONTROL = 1e-6, 1e-3
# Largest weight of a sample, in units of the mean weight.
_LARGEST_WEIGHT = 20.0


def learn_from_plans(
    config: EpochConfig, state: EpochState, hyper: Hyperparams
) -> tuple[EpochState, tuple[Any, Any, Any]]:
    """
    The second half of an epoch: the regressions of policy and value. They are independent and run
    in parallel, since with small networks, each uses little more than one core.

    :return: the state; the mean losses of policy and value, and the mean norm of the policy's
        gradient before it is clipped
    """
    learning = [partial(each, config, state, hyper) for each in regressions(config)]
    of_policy, *of_value = run_in_parallel(learning)
    actor, average, optimizer, loss, norm, n_epochs, key = of_policy
    nets = state.networks._replace(actor=actor, average=average)
    progress = state.progress._replace(actor_optimizer=optimizer, n_epochs=n_epochs, key=key)
    value_loss: Any = 0.0
    if of_value:
        value, optimizer, value_loss = of_value[0]
        nets = nets._replace(value=value)
        progress = progress._replace(value_optimizer=optimizer)
    return state._replace(networks=nets, progress=progress), (loss, value_loss, norm)


def regressions(config: EpochConfig) -> list[Callable[..., Any]]:
    """:return: the programs of the second half of an epoch"""
    return [learn_policy, *([learn_value] if config.terminal_value else [])]


@partial(jax.jit, static_argnums=0)
def learn_policy(config: EpochConfig, state: EpochState, hyper: Hyperparams) -> tuple[Any, ...]:
    r"""
    Regress the policy on the remembered samples: Adam on minibatches.

    The policy learns from the first steps of each plan only: the end of a plan depends on the
    learned value.

    The loss is :math:`w\,\sqrt{e^2 + 0.1^2}` with the error :math:`e` in units of the control
    scale: a squared error averages between turning left and turning right, and blurs switching
    times. The paper's :math:`w\,e^2/2`, in units of the control, is an option.

    :return: the policy's parameters, their moving average and the state of Adam; the mean loss, and
        the mean norm of the gradient before it is clipped; the number of epochs and the random key
        after this one
    """
    inside, unit = state.networks.inside, state.progress.control_scale

    def loss(actor, batch: Samples) -> jax.Array:
        error = output(config.actor, actor, inside(batch.obs)) - batch.control
        if config.squared_error:
            return jnp.mean(batch.weight[:, None] * 0.5 * error**2)
        return jnp.mean(batch.weight[:, None] * jnp.sqrt((error / unit) ** 2 + _SMOOTH_ERROR**2))

    nets, progress = state.networks, state.progress
    key, k_regress = _next_keys(state)
    # The value draws from the same key, but other numbers.
    keys = lambda i: jax.random.split(jax.random.fold_in(k_regress, i))[0]  # noqa: E731
    n_early = config.n_learned * config.n_rollouts
    begin = nets.actor, progress.actor_optimizer
    actor, optimizer, (mean_loss, norm) = _descent(
        config, state, hyper, loss, n_early, keys, *begin
    )
    decay = jnp.where(progress.n_epochs > 0, hyper.averaging, 0.0)
    average = jax.tree.map(lambda a, new: decay * a + (1.0 - decay) * new, nets.average, actor)
    after = progress.n_epochs + 1, jax.random.key_data(key)
    return actor, average, optimizer, mean_loss, norm, *after


@partial(jax.jit, static_argnums=0)
def learn_value(config: EpochConfig, state: EpochState, hyper: Hyperparams) -> tuple[Any, ...]:
    """
    Regress the value on the remembered samples. It is evaluated at the ends of plans, so it learns
    from all of their steps.

    :return: the value's parameters, the state of Adam, and the mean loss
    """
    inside = state.networks.inside
    _, key = _next_keys(state)

    def loss(value, batch: Samples) -> jax.Array:
        found = value_of(output(config.value, value, inside(batch.obs)))
        error = root_of_value(found) - root_of_value(batch.value)
        return jnp.mean(batch.alive * error**2)

    n_columns = config.horizon * config.n_rollouts
    begin = state.networks.value, state.progress.value_optimizer
    keys = lambda i: jax.random.split(jax.random.fold_in(key, i))[1]  # noqa: E731
    value, optimizer, losses = _descent(config, state, hyper, loss, n_columns, keys, *begin)
    return value, optimizer, losses[0]


def _descent(
    config: EpochConfig,
    state: EpochState,
    hyper: Hyperparams,
    loss: Callable[[Any, Samples], jax.Array],
    n: int,
    keys: Callable[[Any], PRNGKeyArray],
    weights: Mapping[str, Any],
    optimizer: Any,
) -> tuple[Mapping[str, Any], Any, Float[Array, " 2"]]:
    """Adam on batches that are drawn from the first ``n`` samples of each remembered epoch."""
    adam, work = clipped_adam(config.max_grad_norm), state.workspace
    filled = jnp.minimum(work.n_filled, config.plan_memory)

    def update(i, carry):
        weights, optimizer, sums = carry
        drawn = jax.random.randint(keys(i), (config.batch_size,), 0, filled * n)
        batch = jax.tree.map(lambda leaf: leaf[drawn // n, drawn % n], work.samples)
        lost, slope = jax.value_and_grad(loss)(weights, batch)
        norm = optax.tree.norm(slope)
        change, optimizer = adam.update(slope, optimizer, weights)
        weights = jax.tree.map(lambda w, c: w - hyper.learning_rate * c, weights, change)
        return weights, optimizer, sums + jnp.stack([lost, norm])

    first = (weights, optimizer, jnp.zeros(2))
    weights, optimizer, sums = jax.lax.fori_loop(0, hyper.gradient_steps, update, first)
    return weights, optimizer, sums / jnp.maximum(hyper.gradient_steps, 1)


def _next_keys(state: EpochState) -> jax.Array:
    """:return: the random key after this half of the epoch, and the one to use in it"""
    return jax.random.split(jax.random.wrap_key_data(state.progress.key, impl=GENERATOR))


def samples_of(
    hyper: Hyperparams,
    problem: Problem,
    kept: Plan,
    tails: Float[Array, " rollouts"],
    gain: Float[Array, " rollouts"],
    sensitivity: Float[Array, "rollouts horizon"],
) -> tuple[Samples, Bool[Array, " rollouts"]]:
    r"""
    Samples at every state of the *improved* trajectories: the control, the objective from there on

    .. math:: Y_t = r_t + \gamma Y_{t+1}

    and a weight that grows with the plan's gain over the policy and with the cost of an error.

    :param kept: plans, leaves of shape ``(n_rollouts, ...)``
    :param tails: value of each plan's last state
    :param gain: of each plan over the policy's own
    :param sensitivity: cost of an error in each control
    :return: samples, leaves of shape ``(horizon * n_rollouts, ...)``, and which plans were finite;
        the others have weight zero
    """
    before = jax.tree.map(lambda leaf: leaf[:, :-1], kept.states)
    obs = jax.vmap(jax.vmap(lambda state: hyper.vec_normalize(problem.observe(state))))(before)
    targets = jax.vmap(lambda plan, tail: _to_go(problem, plan, tail))(kept, tails)
    finite = jnp.isfinite(obs).all((1, 2)) & jnp.isfinite(targets).all(1) & jnp.isfinite(kept.value)
    alive = finite[:, None] & kept.alive[:, :-1]
    weight = _weight(gain, hyper.gain_weight)[:, None] * _weight(
        sensitivity, hyper.sensitivity_weight
    )

    def flat(x: jax.Array) -> jax.Array:
        clean = jnp.where(finite.reshape(-1, *[1] * (x.ndim - 1)), x, 0.0)
        return jnp.swapaxes(clean, 0, 1).reshape(-1, *x.shape[2:])

    samples = Samples(
        obs=flat(obs),
        control=flat(kept.controls),
        value=flat(targets),
        weight=flat(jnp.where(alive, weight, 0.0)),
        alive=flat(alive.astype(weight.dtype)),
    )
    return samples, finite


def remember(config: EpochConfig, state: EpochState, samples: Samples) -> EpochState:
    """Replace the oldest row of samples by those of this epoch."""
    work = state.workspace
    row = work.n_filled % config.plan_memory
    write = lambda rows, new: jax.lax.dynamic_update_index_in_dim(rows, new, row, 0)  # noqa: E731
    rows = jax.tree.map(write, work.samples, samples)
    return state._replace(workspace=work._replace(samples=rows, n_filled=work.n_filled + 1))


def rescale(state: EpochState, samples: Samples) -> EpochState:
    """
    Let the scales of inputs and controls follow the plans, at a rate of 3 / (n + 3) after n epochs:
    near a balance, both are far smaller than in the first, random rollouts. The networks' first
    layers change with the scales of their inputs, so that their outputs stay the same.
    """
    nets, progress = state.networks, state.progress
    counted = samples.alive[:, None]
    rate = _FORGETTING / (progress.n_epochs + _FORGETTING) * jnp.any(counted > 0.0)
    total = jnp.maximum(jnp.sum(counted), 1.0)
    mean = jnp.sum(counted * samples.obs, 0) / total
    std = jnp.sqrt(jnp.sum(counted * (samples.obs - mean) ** 2, 0) / total)
    sizes = jnp.log(jnp.abs(samples.control) + _LEAST_CONTROL)
    control_scale = jnp.exp(jnp.sum(counted * sizes, 0) / total)
    update = lambda old, new: old + rate * (new - old)  # noqa: E731
    std = jnp.where(std > _LEAST_STD, std, nets.inside.scale)
    inside = nets.inside._replace(
        mean=update(nets.inside.mean, mean), scale=update(nets.inside.scale, std)
    )
    control_scale = jnp.clip(update(progress.control_scale, control_scale), _LEAST_CONTROL, 1.0)
    actor, average, value = (
        with_input_scales(weights, nets.inside, inside)
        for weights in (nets.actor, nets.average, nets.value)
    )
    nets = nets._replace(actor=actor, average=average, value=value, inside=inside)
    return state._replace(networks=nets, progress=progress._replace(control_scale=control_scale))


def _to_go(problem: Problem, plan: Plan, tail: jax.Array) -> Float[Array, " horizon"]:
    def back(after, stage):
        reward, still = stage
        now = reward + problem.discount * jnp.where(still, after, problem.value_when_terminated)
        return now, now

    return jax.lax.scan(back, tail, (plan.rewards, plan.alive[1:]), reverse=True)[1]


def _weight(quantity: jax.Array, share: float | jax.Array) -> jax.Array:
    """:return: weights with a mean near one, a share of which is proportional to ``quantity``"""
    finite = jnp.where(jnp.isfinite(quantity), quantity, 0.0)
    relative = finite / (jnp.mean(finite) + 1e-6)
    return 1.0 - share + share * jnp.minimum(relative, _LARGEST_WEIGHT)
