"""Ends of episodes under random actions, as a learner sees them."""

import copy
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv

from sb3_hds.wrappers.vec_env import obs_of

#: ends after which sampling stops
ENOUGH = 20


class End(NamedTuple):
    """
    :param length: steps of the episode
    :param terminated: whether a learner treats the end as a termination
    :param info: of the last step
    :param last_obs: last observation of the episode; None if it is not reported
    :param first_obs: first observation of the next episode
    """

    length: int
    terminated: bool
    info: dict[str, Any]
    last_obs: Any
    first_obs: Any


class Seen(NamedTuple):
    """
    :param ends: in chronological order
    :param n_steps: in total over all copies
    :param clock: whether observations contain the time since the start of the episode
    """

    ends: list[End]
    n_steps: int
    clock: bool


def ends_of_env(env: gymnasium.Env, n_steps: int, seed: int) -> Seen:
    """
    :param n_steps: at most
    :raises ValueError: if ``step`` does not return five values
    """
    space, ends, traces = _seeded_copy(env.action_space, seed), [], [[]]
    obs, _ = env.reset(seed=seed)
    n_taken = 0
    while n_taken < n_steps and len(ends) < ENOUGH:
        n_taken += 1
        traces[-1].append(_flat(env.observation_space, obs))
        obs, _, terminated, truncated, info = env.step(space.sample())
        if terminated or truncated:
            last, length = obs, len(traces[-1])
            obs, _ = env.reset()
            # Gymnasium's TimeLimit may set both flags; SB3 then takes it for a termination.
            ends.append(End(length, bool(terminated), info, last, obs))
            traces.append([])
    return Seen(ends, n_taken, _is_clock(traces))


def ends_of_vec_env(env: VecEnv, n_steps: int, seed: int) -> Seen:
    space = _seeded_copy(env.action_space, seed)
    env.seed(seed)
    obs, ends, n_taken = env.reset(), [], 0
    lengths, traces = np.zeros(env.num_envs, int), [[[]] for _ in range(env.num_envs)]
    while n_taken < n_steps and len(ends) < ENOUGH:
        n_taken += env.num_envs
        for i, trace in enumerate(traces):
            trace[-1].append(_flat(env.observation_space, obs_of(obs, i)))
        actions = np.stack([space.sample() for _ in range(env.num_envs)])
        obs, _, dones, infos = env.step(actions)
        lengths += 1
        for i in np.flatnonzero(dones).tolist():
            info = dict(infos[i])
            cut, last = bool(info.get("TimeLimit.truncated")), info.get("terminal_observation")
            ends.append(End(int(lengths[i]), not cut, info, last, obs_of(obs, i)))
            lengths[i] = 0
            traces[i].append([])
    return Seen(ends, n_taken, _is_clock([one for trace in traces for one in trace]))


def is_same(first: Any, second: Any) -> bool:
    """:return: whether two observations are equal"""
    if isinstance(first, dict):
        return all(is_same(part, second[name]) for name, part in first.items())
    return np.array_equal(np.asarray(first), np.asarray(second))


def _seeded_copy(space: spaces.Space, seed: int) -> spaces.Space:
    """:return: a copy to sample from, which leaves the generator of the original untouched"""
    copied = copy.deepcopy(space)
    copied.seed(seed)
    return copied


def _flat(space: spaces.Space, obs: Any) -> np.ndarray:
    if isinstance(space, spaces.Dict):
        return np.concatenate([_flat(part, obs[name]) for name, part in space.items()])
    return np.asarray(obs, np.float64).ravel()


def _is_clock(traces: list[list[np.ndarray]]) -> bool:
    """Whether some entry is strictly monotonic and the same function of time in all episodes."""
    episodes = [np.stack(trace) for trace in traces if len(trace) > 1]
    if len(episodes) < 2:
        return False
    n = min(map(len, episodes))
    rows = np.stack([episode[:n] for episode in episodes])
    same = np.ptp(rows, axis=0).max(0) < 1e-6
    monotonic = (np.diff(rows[0], axis=0) > 0).all(0) | (np.diff(rows[0], axis=0) < 0).all(0)
    return bool((same & monotonic).any())
