"""Learning with several seeds in one compiled program, in the twin of the environment."""

import io
import warnings
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from rich.progress import track
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.type_aliases import TrainFrequencyUnit

from sb3_hds.algos.base.config import is_count
from sb3_hds.algos.model_free.sac.algorithm import SoftActorCritic, next_power_of_2
from sb3_hds.algos.model_free.sac.compiled.run import (
    Loop,
    Round,
    Run,
    Step,
    init_run,
    run_rounds,
    runs_axes,
)
from sb3_hds.algos.model_free.sac.update import Hyperparams
from sb3_hds.core import Twin
from sb3_hds.core.numerics.compilation import GENERATOR
from sb3_hds.envs.mirror import check_mirrors, twin_of
from sb3_hds.errors import SeedsDivergedError

Algorithm = TypeVar("Algorithm", bound=SoftActorCritic)

_STEPS_PER_CALL = 1_000
_LEAST_CAPACITY = 1 << 14
_NO_LIMIT = np.iinfo(np.int32).max


class Episodes(NamedTuple):
    """
    Training episodes of one seed.

    :param timesteps: timestep at the end of each episode
    :param returns: undiscounted sums of rewards
    """

    timesteps: np.ndarray
    returns: np.ndarray


def learn_compiled(
    model: Algorithm,
    total_timesteps: int,
    seeds: Iterable[int] = (0,),
    progress_bar: bool = False,
    twin: Twin | None = None,
) -> tuple[list[Algorithm], list[Episodes]]:
    """
    Learn from scratch with each seed, without leaving the accelerator: the same program steps the
    twin of the environment and updates the networks.

    It is compiled once for all ``total_timesteps`` up to 16,384, again for each doubling, for a
    smaller ``buffer_size``, and for another number of seeds. Callbacks, loggers and monitors are
    not called. Schedules act round by round. Interrupted (Ctrl-C), it returns what was learned
    until then.

    :param model: hyperparameters and environment, not changed: any algorithm of the SAC family
        whose environment has a twin; BRO resets its networks after 15,000 steps and is refused for
        more, unless it is made with ``param_resets=[]``
    :param total_timesteps: of each seed, rounded up to full rounds of ``train_freq``
    :param seeds: of the initial networks, as in the constructor, and of the training
    :param progress_bar: whether to show a progress bar
    :param twin: stepped instead of the twin that belongs to the environment with its wrappers
    :return: for each seed a model that can act, be saved, and continue learning from its
        transitions; and its episodes
    :raises NoTwinError: for an environment without a twin
    :raises EnvironmentMismatchError: for a wrapper that its twin does not have, and for a twin with
        other actions or observations
    :raises ValueError: for features that need steps in Python: other algorithms, several
        environments, ``VecNormalize``, another replay buffer, ``optimize_memory_usage``, n-step
        returns, action noise, ``param_resets``, episodes as ``train_freq``, a layer that stores
        executed actions
    :raises SeedsDivergedError: if a seed diverged, after the others are done; it has their models
        and episodes
    """
    if not isinstance(seeds, Iterable):
        raise ValueError(f"learn_compiled(seeds={seeds!r}): pass several, such as range(4).")
    seeds = [int(seed) for seed in seeds]
    _refuse_what_needs_python(model, total_timesteps, seeds)
    models = [_copy_of(model, seed) for seed in seeds]
    env: Any = model.get_env()
    if twin is None:
        twin = twin_of(env)
    else:
        check_mirrors(env, twin)
    loop = _loop_of(models[0], total_timesteps, twin)
    runs, done = _initial_runs(loop, models, seeds), []
    diverged = np.zeros(len(seeds), bool)
    try:
        for rounds in _rounds_of_calls(model, loop, total_timesteps, progress_bar):
            runs, now, report = run_rounds(loop, loop.twin.params, runs, rounds)
            done.append((now, rounds))
            diverged |= _diverged(report)
            if diverged.all():
                break
    except KeyboardInterrupt:
        n_done = _n_steps([_without_padding(*call) for call in done])
        warnings.warn(f"Interrupted after {n_done} of {total_timesteps} steps.")
    steps = [_without_padding(*call) for call in done]
    on_host = jax.device_get(runs._replace(key=jax.random.key_data(runs.key)))
    kept = np.flatnonzero(~diverged).tolist()
    for i in kept:
        _continue_from(models[i], _of_seed(runs, i), _of_seed(on_host, i), _n_steps(steps))
    episodes = [_episodes(steps, i) for i in range(len(seeds))]
    if diverged.any():
        raise SeedsDivergedError(
            f"Learning diverged with the seeds {[seeds[i] for i in np.flatnonzero(diverged)]}. "
            "Lower the learning rate, or scale rewards. The models and episodes of the other seeds "
            "are attributes of this error.",
            {seeds[i]: models[i] for i in kept},
            {seeds[i]: episodes[i] for i in kept},
        )
    return models, episodes


def _refuse_what_needs_python(model: Any, total_timesteps: Any, seeds: Sequence[int]) -> None:
    if not isinstance(model, SoftActorCritic):
        raise ValueError(
            f"learn_compiled() is for the SAC family, not {type(model).__name__}: use its learn()."
        )
    if not is_count(total_timesteps, 1) or not seeds:
        raise ValueError(
            "learn_compiled() needs at least one step and one seed, got "
            f"total_timesteps={total_timesteps!r} and seeds={list(seeds)!r}."
        )
    frequency: Any = model.train_freq
    unfit = {
        "several environments (n_envs > 1)": (model.n_envs != 1, "make one"),
        "VecNormalize": (model.get_vec_normalize_env() is not None, "leave it out"),
        "n_steps > 1": (model.n_steps > 1, "pass n_steps=1"),
        "another replay buffer": (
            model.replay_buffer_class not in (None, ReplayBuffer),
            "leave it out",
        ),
        "action_noise": (model.action_noise is not None, "leave it out"),
        "time limits that count as ends, which optimize_memory_usage needs": (
            not (model.replay_buffer_kwargs or {}).get("handle_timeout_termination", True),
            "leave out replay_buffer_kwargs and optimize_memory_usage",
        ),
        "param_resets": (
            any(at < total_timesteps for at in model.param_resets or []),
            "pass param_resets=[]",
        ),
        "episodes as train_freq": (
            frequency.unit is not TrainFrequencyUnit.STEP,
            "pass a number of steps",
        ),
        "observations that are no vector": (
            not isinstance(model.observation_space, spaces.Box),
            "flatten them",
        ),
        "layers with store='executed'": (
            _attribute(model.get_env(), "store") == "executed",
            "use store='raw'",
        ),
    }
    for what, (is_so, remedy) in unfit.items():
        if is_so:
            raise ValueError(
                f"learn_compiled() cannot do {what}: {remedy}, or use {type(model).__name__}"
                ".learn()."
            )


def _attribute(env: Any, name: str) -> Any:
    """:return: of the environment, or of its outermost layer that has it; None: there is none"""
    try:
        return env.get_attr(name)[0]
    except AttributeError:
        return None


def _copy_of(model: Algorithm, seed: int) -> Algorithm:
    """:return: a copy of the model, as if constructed with this seed"""
    file = io.BytesIO()
    model.save(file)
    file.seek(0)
    copy = type(model).load(file, env=model.get_env(), seed=seed, device=model._device_name)
    copy._build(copy.network_seed)
    copy.num_timesteps = copy._n_updates = 0
    return copy


def _loop_of(model: SoftActorCritic, total_timesteps: int, twin: Twin) -> Loop:
    env: Any = model.get_env()
    frequency = model.train_freq.frequency  # type: ignore[union-attr]
    n_steps = _rounded_up(total_timesteps, frequency)
    return Loop(
        twin=twin,
        update_config=model.policy.update_config,
        limit=_attribute(env, "_max_episode_steps")
        or _attribute(env, "max_episode_steps")
        or _NO_LIMIT,
        capacity=min(model.buffer_size, max(_LEAST_CAPACITY, next_power_of_2(n_steps))),
        learning_starts=model.learning_starts,
        train_freq=frequency,
        gradient_steps=frequency if model.gradient_steps == -1 else model.gradient_steps,
        batch_size=model.batch_size,
        gamma=model.gamma,
        sde_sample_freq=model.sde_sample_freq,
        warm=model.use_sde_at_warmup,
    )


def _initial_runs(loop: Loop, models: Sequence[SoftActorCritic], seeds: Sequence[int]) -> Run:
    """Initial runs; the random numbers of a seed do not depend on the other seeds."""
    singles = []
    for model, seed in zip(models, seeds, strict=True):
        network_key, key = jax.random.split(jax.random.key(seed, impl="threefry2x32"))
        state = model.policy.agent_state._replace(key=network_key)
        singles.append(init_run(loop, loop.twin.params, state, key))
    stacked = jax.tree.map(lambda *parts: jnp.stack(parts), *singles)
    state = stacked.agent._replace(n_updates=singles[0].agent.n_updates)
    # Results of a program are committed to a device; uncommitted arrays would compile another one.
    (device,) = models[0].policy.agent_state.key.devices()
    return jax.device_put(stacked._replace(agent=state), device)


def _rounds_of_calls(
    model: SoftActorCritic, loop: Loop, total_timesteps: int, progress_bar: bool
) -> Iterable[Round]:
    """The rounds of each call of the program, with the hyperparameters of their schedules."""
    total = _rounded_up(total_timesteps, loop.train_freq)
    begins = np.arange(0, total, loop.train_freq)
    table = np.array([_hyper_at(model, 1.0 - begin / total) for begin in begins], np.float32)
    per_call = max(1, _STEPS_PER_CALL // loop.train_freq)
    calls = [
        _padded(begins[at : at + per_call], table[at : at + per_call], per_call)
        for at in range(0, len(begins), per_call)
    ]
    return track(calls, "learning", disable=not progress_bar)


def _hyper_at(model: SoftActorCritic, remaining: float) -> Hyperparams:
    now, model._current_progress_remaining = model._current_progress_remaining, remaining
    hyper = model.hyperparams()
    model._current_progress_remaining = now
    return hyper


def _padded(begins: np.ndarray, table: np.ndarray, n: int) -> Round:
    more = n - len(begins)
    active = np.arange(n) < len(begins)
    begins, table = np.pad(begins, (0, more)), np.pad(table, ((0, more), (0, 0)))
    columns: Any = jnp.asarray(table).T
    return Round(jnp.asarray(begins, jnp.int32), jnp.asarray(active), Hyperparams(*columns))


def _continue_from(model: SoftActorCritic, run: Run, on_host: Run, n_steps: int) -> None:
    """Continue the model from the end of the run."""
    key = jax.random.key(int(on_host.key[-1]), impl=GENERATOR)
    device = next(iter(model.policy.agent_state.key.devices()))
    model.policy.agent_state = jax.device_put(run.agent._replace(key=key), device)
    model.num_timesteps = n_steps
    model._n_updates = int(run.agent.n_updates)
    buffer: Any = model.replay_buffer
    memory, held = on_host.memory, min(n_steps, buffer.buffer_size)
    shape = buffer.observations.shape[2:]
    buffer.observations[:held, 0] = memory.obs[:held].reshape(held, *shape)
    if buffer.optimize_memory_usage:
        buffer.observations[held % buffer.buffer_size, 0] = memory.next_obs[held - 1]
    else:
        buffer.next_observations[:held, 0] = memory.next_obs[:held].reshape(held, *shape)
    buffer.actions[:held, 0] = memory.action[:held]
    buffer.rewards[:held, 0] = memory.reward[:held]
    buffer.dones[:held, 0] = memory.terminated[:held]
    buffer.pos, buffer.full = n_steps % buffer.buffer_size, n_steps >= buffer.buffer_size


def _of_seed(runs: Run, i: int) -> Run:
    pick = lambda axis: lambda x: x if axis is None else x[i]  # noqa: E731
    axes = runs_axes()
    state = type(runs.agent)(
        *(jax.tree.map(pick(axis), part) for axis, part in zip(axes.agent, runs.agent, strict=True))
    )
    rest = runs._replace(agent=None)  # type: ignore[arg-type]
    return jax.tree.map(pick(0), rest)._replace(agent=state)


def _episodes(steps: Sequence[Step], i: int) -> Episodes:
    if not steps:
        return Episodes(np.zeros(0, int), np.zeros(0))
    ended = np.concatenate([step.ended[i].ravel() for step in steps])
    totals = np.concatenate([step.total[i].ravel() for step in steps])
    return Episodes(1 + np.flatnonzero(ended), totals[ended])


def _without_padding(steps: Step, rounds: Round) -> Step:
    n = int(rounds.active.sum())
    return jax.tree.map(lambda x: np.asarray(x)[:, :n], steps)


def _n_steps(steps: Sequence[Step]) -> int:
    return sum(step.ended[0].size for step in steps)


def _diverged(report: Any) -> np.ndarray:
    """:return: of each seed, whether a metric of its last update is not finite"""
    values = jax.device_get(report)
    return ~np.logical_and.reduce([np.isfinite(value) for value in values])


def _rounded_up(total_timesteps: int, frequency: int) -> int:
    return -(-total_timesteps // frequency) * frequency
