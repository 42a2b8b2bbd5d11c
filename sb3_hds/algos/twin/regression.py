"""Learning from plans: the samples that they give, and the regressions on them."""

from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from sb3_hds.algos.twin.networks import output, squash, value_of, with_input_scales
from sb3_hds.algos.twin.state import EpochConfig, EpochState, Hyperparams, Samples, clipped_adam
from sb3_hds.planning import Plan, Problem

# Where the absolute error of the regression turns into a squared one, in units of the control
# scale.
_SMOOTH_ERROR = 0.1
# Epochs after which a new one counts one half in the scales that follow the plans.
_FORGETTING = 3.0
# Below this, an input does not move and its scale is left alone; controls are at least this large.
_LEAST_SPREAD, _LEAST_EFFORT = 1e-6, 1e-3
# No sample counts more than this many times the mean.
_LARGEST_WEIGHT = 20.0


def samples_of(
    hyper: Hyperparams,
    problem: Problem,
    kept: Plan,
    tails: Float[Array, " rollouts"],
    gain: Float[Array, " rollouts"],
    sensitivity: Float[Array, "rollouts horizon"],
) -> tuple[Samples, Bool[Array, " rollouts"]]:
    r"""
    At every state of the *improved* trajectories: the control to copy, the objective from there on

    .. math:: Y_t = r_t + \gamma Y_{t+1}

    and a weight that grows with what the plan gained over the policy and with what an error costs
    there.

    :param kept: plans, leaves of shape ``(n_rollouts, ...)``
    :param tails: value of each plan's last state
    :param gain: of each plan over the policy's own
    :param sensitivity: cost of an error of each control
    :return: samples, leaves of shape ``(horizon * n_rollouts, ...)``, and which plans were finite;
        the others weigh nothing
    """
    before = jax.tree.map(lambda leaf: leaf[:, :-1], kept.states)
    obs = jax.vmap(jax.vmap(lambda state: hyper.view(problem.observe(state))))(before)
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
        flat(obs),
        flat(kept.controls),
        flat(targets),
        flat(jnp.where(alive, weight, 0.0)),
        flat(alive.astype(weight.dtype)),
    )
    return samples, finite


def remember(config: EpochConfig, state: EpochState, samples: Samples) -> EpochState:
    """Write an epoch's samples over the oldest row."""
    work = state.workspace
    row = work.n_filled % config.plan_memory
    write = lambda rows, new: jax.lax.dynamic_update_index_in_dim(rows, new, row, 0)  # noqa: E731
    rows = jax.tree.map(write, work.samples, samples)
    return state._replace(workspace=work._replace(samples=rows, n_filled=work.n_filled + 1))


def rescale(state: EpochState, samples: Samples) -> EpochState:
    """
    Let the scales of inputs and controls follow the plans: near a balance both are far smaller than
    in the random rollouts from which they were first taken. Old epochs are forgotten at a rate of
    3/n. The networks' first layers change with their inputs, so that what they compute does not.
    """
    nets, progress = state.networks, state.progress
    counted = samples.alive[:, None]
    rate = _FORGETTING / (progress.n_epochs + _FORGETTING) * jnp.any(counted > 0.0)
    total = jnp.maximum(jnp.sum(counted), 1.0)
    mean = jnp.sum(counted * samples.obs, 0) / total
    spread = jnp.sqrt(jnp.sum(counted * (samples.obs - mean) ** 2, 0) / total)
    sizes = jnp.log(jnp.abs(samples.control) + _LEAST_EFFORT)
    effort = jnp.exp(jnp.sum(counted * sizes, 0) / total)
    follow = lambda old, new: old + rate * (new - old)  # noqa: E731
    spread = jnp.where(spread > _LEAST_SPREAD, spread, nets.inside.scale)
    inside = nets.inside._replace(
        mean=follow(nets.inside.mean, mean), scale=follow(nets.inside.scale, spread)
    )
    effort = jnp.clip(follow(progress.control_scale, effort), _LEAST_EFFORT, 1.0)
    actor, average, value = (
        with_input_scales(weights, nets.inside, inside)
        for weights in (nets.actor, nets.average, nets.value)
    )
    nets = nets._replace(actor=actor, average=average, value=value, inside=inside)
    return state._replace(
        networks=nets,
        progress=progress._replace(control_scale=effort),
    )


def regress_policy(
    config: EpochConfig, state: EpochState, hyper: Hyperparams, key: PRNGKeyArray
) -> tuple[Mapping[str, Any], Any, Float[Array, " 2"]]:
    r"""
    Adam on minibatches of the remembered samples.

    The policy learns from the first steps of each plan only: what a plan does towards its end
    depends on the value found there.

    Its loss is :math:`w\,\sqrt{e^2 + 0.1^2}` with the error :math:`e` in units of the control
    scale: a squared error averages between turning left and turning right, and blurs the moments
    of switching. The paper's :math:`w\,e^2/2`, in units of the control, is a setting.

    :param key: that of :func:`regress_value`, too: both draw from it, and not the same
    :return: the policy's parameters and the state of Adam; the mean loss, and the mean norm of the
        gradient before it is clipped
    """
    inside, unit = state.networks.inside, state.progress.control_scale

    def loss(actor, batch: Samples) -> jax.Array:
        error = output(config.actor, actor, inside(batch.obs)) - batch.control
        if config.squared_error:
            return jnp.mean(batch.weight[:, None] * 0.5 * error**2)
        return jnp.mean(batch.weight[:, None] * jnp.sqrt((error / unit) ** 2 + _SMOOTH_ERROR**2))

    n_early = config.n_learned * config.n_rollouts
    begin = state.networks.actor, state.progress.actor_optimizer
    keys = lambda i: jax.random.split(jax.random.fold_in(key, i))[0]  # noqa: E731
    return _descent(config, state, hyper, loss, n_early, keys, *begin)


def regress_value(
    config: EpochConfig, state: EpochState, hyper: Hyperparams, key: PRNGKeyArray
) -> tuple[Mapping[str, Any], Any, Float[Array, " 2"]]:
    """
    As :func:`regress_policy` does. The value, which is asked for at the ends of plans, learns from
    all of their steps.

    :return: the value's parameters and the state of Adam; the mean loss, and the mean norm of the
        gradient before it is clipped
    """
    inside = state.networks.inside

    def loss(value, batch: Samples) -> jax.Array:
        found = value_of(output(config.value, value, inside(batch.obs)))
        error = squash(found) - squash(batch.value)
        return jnp.mean(batch.alive * error**2)

    n_columns = config.horizon * config.n_rollouts
    begin = state.networks.value, state.progress.value_optimizer
    keys = lambda i: jax.random.split(jax.random.fold_in(key, i))[1]  # noqa: E731
    return _descent(config, state, hyper, loss, n_columns, keys, *begin)


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
    """Of each remembered epoch, the first ``n`` samples are drawn from."""
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


def _to_go(problem: Problem, plan: Plan, tail: jax.Array) -> Float[Array, " horizon"]:
    def back(after, stage):
        reward, still = stage
        now = reward + problem.discount * jnp.where(still, after, problem.value_when_terminated)
        return now, now

    return jax.lax.scan(back, tail, (plan.rewards, plan.alive[1:]), reverse=True)[1]


def _weight(quantity: jax.Array, share: float | jax.Array) -> jax.Array:
    """A weight with mean near one, a share of it in proportion to ``quantity``."""
    finite = jnp.where(jnp.isfinite(quantity), quantity, 0.0)
    relative = finite / (jnp.mean(finite) + 1e-6)
    return 1.0 - share + share * jnp.minimum(relative, _LARGEST_WEIGHT)
