"""
The compiled program of ``learn_compiled``: steps of the twin, replay buffer and updates.

SB3 steps an environment in Python and passes batches to JAX. With a twin, everything stays in the
program, and seeds are one more axis of every array (``vmap``).
"""

import dataclasses
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from sb3_hds.algos.model_free.replay import Batch
from sb3_hds.algos.model_free.sac.networks import ExploringActor, noise_std
from sb3_hds.algos.model_free.sac.update import (
    Hyperparams,
    SACState,
    UpdateConfig,
    UpdateMetrics,
    explore,
    update_once,
)
from sb3_hds.algos.model_free.update import zero_metrics
from sb3_hds.algos.nets.observations import RunningStats, normalize
from sb3_hds.core import Params, State, Twin


@dataclasses.dataclass(frozen=True)
class Loop:
    """
    Static configuration of the program; equal loops share compiled programs.

    :param limit: steps after which an episode is truncated
    :param capacity: of the replay buffer [transitions]
    :param learning_starts: steps with random actions before learning starts
    :param train_freq: steps per round
    :param gradient_steps: updates per round, after its steps
    :param sde_sample_freq: steps between two draws of gSDE's noise matrix; -1: once per round
    :param warm: whether gSDE also acts before learning starts
    """

    twin: Twin
    update_config: UpdateConfig
    limit: int
    capacity: int
    learning_starts: int
    train_freq: int
    gradient_steps: int
    batch_size: int
    gamma: float
    sde_sample_freq: int
    warm: bool

    @property
    def use_sde(self) -> bool:
        return isinstance(self.update_config.actor, ExploringActor)


class Run(NamedTuple):
    """
    State of the training with one seed.

    :param elapsed: steps since the start of the episode
    :param memory: the replay buffer, with a leading axis of ``capacity``
    :param matrix: gSDE's noise matrix; empty without gSDE
    :param total: return of the episode so far
    """

    agent: SACState
    state: State
    obs: Float[Array, " obs"]
    elapsed: Int[Array, ""]
    memory: Batch
    matrix: Float[Array, "latent act"]
    total: Float[Array, ""]
    key: PRNGKeyArray


class Step(NamedTuple):
    """
    What is recorded of a step.

    :param ended: whether an episode ended
    :param total: return of the episode so far
    """

    ended: Bool[Array, ""]
    total: Float[Array, ""]


class Round(NamedTuple):
    """
    Steps of the environment, then updates.

    :param steps: steps of the environment before the round
    :param active: False for padding, which makes all calls of the program equally long
    :param hyper: hyperparameters of the round
    """

    steps: Int[Array, ""]
    active: Bool[Array, ""]
    hyper: Hyperparams


def init_run(loop: Loop, params: Params, agent: SACState, key: PRNGKeyArray) -> Run:
    """
    :param agent: initial networks
    :return: a run at the start of its first episode, with an empty replay buffer
    """
    key, start_key = jax.random.split(key)
    state = loop.twin.initial(start_key, params)
    obs = loop.twin.observe(state, params)
    n_act, many = len(loop.twin.actuators), (loop.capacity,)
    memory = Batch(
        obs=jnp.zeros((*many, len(obs))),
        action=jnp.zeros((*many, n_act)),
        next_obs=jnp.zeros((*many, len(obs))),
        reward=jnp.zeros(many),
        terminated=jnp.zeros(many),
        discount=jnp.full(many, loop.gamma),
    )
    empty = jnp.zeros((0, n_act))
    matrix = _std_of(loop, agent) if loop.use_sde else empty
    count, total = jnp.zeros((), jnp.int32), jnp.zeros(())
    return Run(agent, state, obs, count, memory, matrix, total, key)


@partial(jax.jit, static_argnums=0, donate_argnums=2)
def run_rounds(
    loop: Loop, params: Params, runs: Run, rounds: Round
) -> tuple[Run, Step, UpdateMetrics]:
    """
    :param runs: with a leading axis of seeds, except for the shared number of updates
    :param rounds: with a leading axis of consecutive rounds
    :return: the runs after the rounds; steps with axes of seeds, rounds and ``train_freq``; metrics
        of the last update of each seed
    """
    axes = runs_axes()

    def one(run: Run) -> tuple[Run, Step, UpdateMetrics]:
        before = run, zero_metrics(UpdateMetrics)
        (run, metrics), steps = jax.lax.scan(partial(_round, loop, params), before, rounds)
        return run, steps, metrics

    return jax.vmap(one, in_axes=(axes,), out_axes=(axes, 0, 0))(runs)


def runs_axes() -> Run:
    """
    :return: axis of the seeds in each field. The number of updates has none: with one per seed,
        ``vmap`` would turn the delayed update of the actor into one that is always computed.
    """
    fields: Any = dict.fromkeys(Run._fields, 0)
    agent: Any = dict.fromkeys(SACState._fields, 0) | {"n_updates": None}
    return Run(**fields | {"agent": SACState(**agent)})


def _round(
    loop: Loop, params: Params, carry: tuple[Run, UpdateMetrics], now: Round
) -> tuple[tuple[Run, UpdateMetrics], Step]:
    def run_round() -> tuple[tuple[Run, UpdateMetrics], Step]:
        run, steps = jax.lax.scan(partial(_step, loop, params, now.steps), carry[0], counts)
        after = now.steps + loop.train_freq
        learn = lambda: _learn(loop, run, now.hyper, carry[1], after)  # noqa: E731
        return jax.lax.cond(after > loop.learning_starts, learn, lambda: (run, carry[1])), steps

    counts = jnp.arange(loop.train_freq)
    padding = Step(jnp.zeros(loop.train_freq, bool), jnp.zeros(loop.train_freq))
    return jax.lax.cond(now.active, run_round, lambda: (carry, padding))


def _step(loop: Loop, params: Params, before: Array, run: Run, count: Array) -> tuple[Run, Step]:
    """Step the twin and store the transition; at the end of an episode, start the next one."""
    twin, t = loop.twin, before + count
    key, act_key, noise_key, start_key = jax.random.split(run.key, 4)
    matrix = _noise_matrix(loop, run, count, t, noise_key)
    action = _action(loop, run, matrix, t, act_key)
    low, high = jnp.array([(a.low, a.high) for a in twin.actuators]).T
    command = low + 0.5 * (action + 1.0) * (high - low)
    state = twin.step(run.state, command, params)
    obs, terminated = twin.observe(state, params), twin.terminated(state, params)
    reward = twin.reward(run.state, command, state, params)
    elapsed, total = run.elapsed + 1, run.total + reward
    ended = terminated | (elapsed >= loop.limit)
    gamma = jnp.asarray(loop.gamma)
    row = Batch(run.obs, action, obs, reward, terminated.astype(jnp.float32), gamma)
    at = t % loop.capacity
    memory = jax.tree.map(lambda rows, new: rows.at[at].set(new), run.memory, row)
    agent = run.agent
    if loop.update_config.normalize_observations:
        agent = agent._replace(obs_stats=_updated_stats(agent.obs_stats, obs))
    fresh = twin.initial(start_key, params)
    start = fresh, twin.observe(fresh, params)
    state, obs = jax.tree.map(partial(jnp.where, ended), start, (state, obs))
    after = Run(
        agent,
        state,
        obs,
        jnp.where(ended, 0, elapsed),
        memory,
        matrix,
        jnp.where(ended, 0.0, total),
        key,
    )
    return after, Step(ended, total)


def _learn(
    loop: Loop, run: Run, hyper: Hyperparams, metrics: UpdateMetrics, n_steps: Array
) -> tuple[Run, UpdateMetrics]:
    held = jnp.minimum(n_steps, loop.capacity)

    def one(
        _: Array, carry: tuple[SACState, UpdateMetrics, Any]
    ) -> tuple[SACState, UpdateMetrics, Any]:
        agent, metrics, key = carry
        key, drawn = jax.random.split(key)
        rows = jax.random.randint(drawn, (loop.batch_size,), 0, held)
        batch = jax.tree.map(lambda x: x[rows], run.memory)
        return *update_once(loop.update_config, agent, batch, hyper, metrics), key

    agent, metrics, key = jax.lax.fori_loop(
        0, loop.gradient_steps, one, (run.agent, metrics, run.key)
    )
    return run._replace(agent=agent, key=key), metrics


def _action(
    loop: Loop, run: Run, matrix: Array, t: Array, key: PRNGKeyArray
) -> Float[Array, " act"]:
    """In [-1, 1]: random before learning starts, then exploratory actions of the policy."""
    config, agent = loop.update_config, run.agent
    random_key, noise_key = jax.random.split(key)
    n_act = len(loop.twin.actuators)
    obs = normalize(agent.obs_stats, run.obs[None])
    drawn = jax.random.normal(noise_key, (1, n_act))
    noise = lambda g: g.latent @ matrix if loop.use_sde else g.std * drawn  # noqa: E731
    action = explore(config, agent.actor.weights, agent.extra, obs, noise)
    if loop.use_sde and loop.warm:
        return action[0]
    random = jax.random.uniform(random_key, (n_act,), minval=-1.0, maxval=1.0)
    return jnp.where(t < loop.learning_starts, random, action[0])


def _noise_matrix(loop: Loop, run: Run, count: Array, t: Array, key: PRNGKeyArray) -> Array:
    if not loop.use_sde:
        return run.matrix
    std, every = _std_of(loop, run.agent), loop.sde_sample_freq
    due = count == 0 if every <= 0 else t % every == 0
    return jnp.where(due, std * jax.random.normal(key, std.shape), run.matrix)


def _std_of(loop: Loop, agent: SACState) -> Array:
    actor: Any = loop.update_config.actor
    return noise_std(actor, dict(agent.actor.weights))


def _updated_stats(stats: RunningStats, obs: Array) -> RunningStats:
    """Welford's update, in single precision."""
    count = stats.count + 1.0
    away = obs - stats.mean
    mean = stats.mean + away / count
    variance = (stats.variance * stats.count + away * (obs - mean)) / count
    return RunningStats(mean, variance, count)
