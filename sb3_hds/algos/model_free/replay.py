"""Batches of transitions from SB3's replay buffers."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch as th
from jaxtyping import Array, Float
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.vec_env import VecNormalize


class Batch(NamedTuple):
    """Transitions. ``discount`` multiplies the next value: :math:`\\gamma^n` for n-step returns."""

    obs: Float[Array, "*batch obs"]
    action: Float[Array, "*batch act"]
    next_obs: Float[Array, "*batch obs"]
    reward: Float[Array, "*batch"]
    terminated: Float[Array, "*batch"]
    discount: Float[Array, "*batch"]


class ReplaySource(NamedTuple):
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


def batches_of(source: ReplaySource, n: int, batch_size: int, capacity: int) -> Batch:
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


def transitions(
    source: ReplaySource, steps: np.ndarray, copies: np.ndarray
) -> dict[str, np.ndarray]:
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


def _over_torch(source: ReplaySource, n: int) -> dict[str, np.ndarray]:
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
