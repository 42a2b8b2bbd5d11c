"""Batches from SB3's replay buffers, without the way over torch where there is a shorter one."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.vec_env import VecNormalize

from sb3_hds.algos.model_free.update import Batch


class Source(NamedTuple):
    """
    What batches are drawn from.

    :param buffer: of SB3
    :param normalizer: the environment's ``VecNormalize``; None: it has none
    :param flatten: observations to rows of numbers
    :param gamma: discount per step
    """

    buffer: Any
    normalizer: VecNormalize | None
    flatten: Callable[[Any], np.ndarray]
    gamma: float


def batches_of(source: Source, n: int, batch_size: int, capacity: int) -> Batch:
    """
    :param n: batches that are drawn
    :param capacity: batches of the result; those beyond ``n`` are empty
    :return: arrays of shape ``(capacity, batch_size, ...)``
    """
    buffer = source.buffer
    direct = type(buffer) is ReplayBuffer and not buffer.optimize_memory_usage
    drawn = (_directly if direct else _over_torch)(source, n * batch_size)
    missing = (capacity - n) * batch_size

    def stacked(rows: np.ndarray) -> np.ndarray:
        if missing:
            rows = np.concatenate([rows, np.zeros((missing, *rows.shape[1:]), np.float32)])
        return rows.reshape(capacity, batch_size, *rows.shape[1:])

    return Batch(**{name: stacked(rows) for name, rows in drawn.items()})  # type: ignore[arg-type]


def _directly(source: Source, n: int) -> dict[str, np.ndarray]:
    """As ``ReplayBuffer.sample`` does it."""
    buffer = source.buffer
    steps = np.random.randint(buffer.buffer_size if buffer.full else buffer.pos, size=n)
    copies = np.random.randint(buffer.n_envs, size=n)
    return transitions(source, steps, copies)


def transitions(source: Source, steps: np.ndarray, copies: np.ndarray) -> dict[str, np.ndarray]:
    """
    :param steps: rows of the buffer, shape ``(n,)``
    :param copies: of which environment, shape ``(n,)``
    :return: the fields of a ``Batch``, each of ``n`` rows; a time limit is no termination
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
    buffer.device = th.device("cpu")  # what is drawn goes to JAX by NumPy
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
