"""What model-free updates share: batches from SB3's replay buffers, and the update schedule."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import torch as th
from jaxtyping import Array, Float, PRNGKeyArray
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.vec_env import VecNormalize

AnyMetrics = TypeVar("AnyMetrics", bound=NamedTuple)
AnyState = TypeVar("AnyState", bound=NamedTuple)
Found = TypeVar("Found")


class Batch(NamedTuple):
    """
    Transitions. ``discount`` multiplies the next value: :math:`\\gamma^n` for n-step returns.
    """

    obs: Float[Array, "*batch obs"]
    action: Float[Array, "*batch act"]
    next_obs: Float[Array, "*batch obs"]
    reward: Float[Array, "*batch"]
    terminated: Float[Array, "*batch"]
    discount: Float[Array, "*batch"]


class UpdateStep(NamedTuple):
    """
    One step of an update.

    :param fields: of the state that it changes
    :param interval: updates between two applications
    :param apply: maps the state, the metrics so far and a key to the new values of these fields and
        the new metrics
    """

    fields: tuple[str, ...]
    interval: int
    apply: Callable[[Any, Any, PRNGKeyArray], tuple[tuple[Any, ...], Any]]


def apply_schedule(state: AnyState, found: Found, *steps: UpdateStep) -> tuple[AnyState, Found]:
    """
    One update: apply its steps in order, each in its interval and with its own random key.

    :param state: has a ``key`` and counts its updates in ``n_updates``
    :param found: metrics, or a pytree that contains them
    :param steps: each receives the state and the metrics that the previous ones returned
    :return: state and metrics after the update
    """
    now: Any = state
    key, *keys = jax.random.split(now.key, 1 + len(steps))
    now = now._replace(key=key, n_updates=now.n_updates + 1)
    for step, key in zip(steps, keys, strict=True):
        apply = partial(step.apply, now, found, key)
        if step.interval == 1:
            fields, found = apply()
        else:
            # Only these fields pass through the branches, which copy their arguments.
            before = tuple(getattr(now, name) for name in step.fields), found
            due = now.n_updates % step.interval == 0
            fields, found = jax.lax.cond(due, apply, lambda before=before: before)
        now = now._replace(**dict(zip(step.fields, fields, strict=True)))
    return now, found


def zero_metrics(kind: type[AnyMetrics]) -> AnyMetrics:
    """
    :param kind: a named tuple of numbers
    :return: metrics before the first update
    """
    # NumPy: JAX would dispatch a program for each of them at every step.
    zero: Any = np.zeros((), jnp.result_type(float))
    return kind._make(zero for _ in kind._fields)


class Source(NamedTuple):
    """
    A replay buffer, and how batches are made of its transitions.

    :param buffer: of SB3
    :param normalizer: the environment's ``VecNormalize``; None: it has none
    :param flatten: maps observations to rows of numbers
    :param gamma: discount per step
    """

    buffer: Any
    normalizer: VecNormalize | None
    flatten: Callable[[Any], np.ndarray]
    gamma: float


def batches_of(source: Source, n: int, batch_size: int, capacity: int) -> Batch:
    """
    :param n: number of sampled batches
    :param capacity: batches of the result; those beyond ``n`` are zero
    :return: arrays of shape ``(capacity, batch_size, ...)``
    """
    buffer = source.buffer
    if type(buffer) is ReplayBuffer and not buffer.optimize_memory_usage:
        # Sample as ``ReplayBuffer.sample`` does, without torch.
        size = n * batch_size
        steps = np.random.randint(buffer.buffer_size if buffer.full else buffer.pos, size=size)
        drawn = transitions(source, steps, np.random.randint(buffer.n_envs, size=size))
    else:
        drawn = _over_torch(source, n * batch_size)
    missing = (capacity - n) * batch_size

    def stacked(rows: np.ndarray) -> np.ndarray:
        if missing:
            rows = np.concatenate([rows, np.zeros((missing, *rows.shape[1:]), np.float32)])
        return rows.reshape(capacity, batch_size, *rows.shape[1:])

    return Batch(**{name: stacked(rows) for name, rows in drawn.items()})  # type: ignore[arg-type]


def transitions(source: Source, steps: np.ndarray, copies: np.ndarray) -> dict[str, np.ndarray]:
    """
    :param steps: rows of the buffer, shape ``(n,)``
    :param copies: number of the environment, shape ``(n,)``
    :return: the fields of a ``Batch``, ``n`` rows each; a time limit is no termination
    """
    buffer, normalizer, flatten, gamma = source
    obs, next_obs = buffer.observations[steps, copies], buffer.next_observations[steps, copies]
    reward = buffer.rewards[steps, copies]
    if normalizer is not None:
        obs, next_obs = normalizer.normalize_obs(obs), normalizer.normalize_obs(next_obs)  # type: ignore[assignment]
        reward = normalizer.normalize_reward(reward)
    ended = buffer.dones[steps, copies] * (1.0 - buffer.timeouts[steps, copies])
    return {
        "obs": flatten(obs),
        "action": buffer.actions[steps, copies],
        "next_obs": flatten(next_obs),
        "reward": np.asarray(reward, np.float32),
        "terminated": np.asarray(ended, np.float32),
        "discount": np.full(len(steps), gamma, np.float32),
    }


def _over_torch(source: Source, n: int) -> dict[str, np.ndarray]:
    buffer, normalizer, flatten, gamma = source
    buffer.device = th.device("cpu")  # samples reach JAX through NumPy
    data = buffer.sample(n, env=normalizer)

    def plain(rows: Any) -> Any:
        if isinstance(rows, dict):
            return {name: part.numpy() for name, part in rows.items()}
        return rows.numpy()

    discounts = getattr(data, "discounts", None)
    return {
        "obs": flatten(plain(data.observations)),
        "action": data.actions.numpy().astype(np.float32),
        "next_obs": flatten(plain(data.next_observations)),
        "reward": data.rewards.numpy().ravel(),
        "terminated": data.dones.numpy().ravel(),
        "discount": np.full(n, gamma, np.float32)
        if discounts is None
        else discounts.numpy().ravel(),
    }
