"""Batches from SB3's replay buffers, without the way over torch where there is a shorter one."""

from typing import TYPE_CHECKING, Any

import numpy as np
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer

from sb3_hds.algos.model_free.sac.update import Batch

if TYPE_CHECKING:
    from sb3_hds.algos.model_free.algorithm import ModelFreeAlgorithm


def batches_of(model: "ModelFreeAlgorithm", n: int, batch_size: int, capacity: int) -> Batch:
    """
    :param n: batches that are drawn
    :param capacity: batches of the result; those beyond ``n`` are empty
    :return: arrays of shape ``(capacity, batch_size, ...)``
    """
    buffer: Any = model.replay_buffer
    direct = type(buffer) is ReplayBuffer and not buffer.optimize_memory_usage
    drawn = (_directly if direct else _over_torch)(model, buffer, n * batch_size)
    missing = (capacity - n) * batch_size

    def stacked(rows: np.ndarray) -> np.ndarray:
        if missing:
            rows = np.concatenate([rows, np.zeros((missing, *rows.shape[1:]), np.float32)])
        return rows.reshape(capacity, batch_size, *rows.shape[1:])

    return Batch(**{name: stacked(rows) for name, rows in drawn.items()})  # type: ignore[arg-type]


def _directly(model: "ModelFreeAlgorithm", buffer: ReplayBuffer, n: int) -> dict[str, np.ndarray]:
    """As ``ReplayBuffer.sample`` does it."""
    steps = np.random.randint(buffer.buffer_size if buffer.full else buffer.pos, size=n)
    copies = np.random.randint(buffer.n_envs, size=n)
    return transitions(model, buffer, steps, copies)


def transitions(
    model: "ModelFreeAlgorithm", buffer: ReplayBuffer, steps: np.ndarray, copies: np.ndarray
) -> dict[str, np.ndarray]:
    """
    :param steps: rows of the buffer, shape ``(n,)``
    :param copies: of which environment, shape ``(n,)``
    :return: the fields of a ``Batch``, each of ``n`` rows; a time limit is no termination
    """
    normalizer, flatten = model.get_vec_normalize_env(), model.policy.flatten
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
        "discount": np.full(len(steps), model.gamma, np.float32),
    }


def _over_torch(model: "ModelFreeAlgorithm", buffer: Any, n: int) -> dict[str, np.ndarray]:
    buffer.device = th.device("cpu")  # what is drawn goes to JAX by NumPy
    data, flatten = buffer.sample(n, env=model.get_vec_normalize_env()), model.policy.flatten

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
        "discount": np.full(n, model.gamma, np.float32)
        if discounts is None
        else discounts.numpy().ravel(),
    }
