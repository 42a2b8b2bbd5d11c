"""Ends of episodes under random actions, as a learner sees them."""

import copy
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv

from sb3_hds.wrappers.vec_env import obs_of

#: Ends after which nothing new is expected.
ENOUGH = 20


class End(NamedTuple):
    """
    :param length: steps of the episode
    :param terminated: whether a learner takes the end for a termination
    :param info: of the last step
    :param last_obs: last observation of the episode, if it is reported
    :param first_obs: first observation of the next episode
    """

    length: int
    terminated: bool
    info: dict[str, Any]
    last_obs: Any
    first_obs: Any


class Seen(NamedTuple):
    """
    :param ends: in the order in which they came
    :param n_steps: of all copies together
    :param clock: whether observations contain the time since the start of the episode
    """

    ends: list[End]
    n_steps: int
    clock: bool


def ends_of_env(env: gymnasium.Env, n_steps: int, seed: int) -> Seen:
    """
    :param n_steps: at most so many
    :raises ValueError: if ``step`` does not return five values
    """
    space, ends, traces = _drawing(env.action_space, seed), [], [[]]
    obs, _ = env.reset(seed=seed)
    taken = 0
    while taken < n_steps and len(ends) < ENOUGH:
        taken += 1
        traces[-1].append(_flat(env.observation_space, obs))
        obs, _, terminated, truncated, info = env.step(space.sample())
        if terminated or truncated:
            last, length = obs, len(traces[-1])
            obs, _ = env.reset()
            # Gymnasium's TimeLimit may set both: SB3 then counts a termination.
            ends.append(End(length, bool(terminated), info, last, obs))
            traces.append([])
    return Seen(ends, taken, _is_clock(traces))


def ends_of_vec_env(env: VecEnv, n_steps: int, seed: int) -> Seen:
    space = _drawing(env.action_space, seed)
    env.seed(seed)
    obs, ends, taken = env.reset(), [], 0
    lengths, traces = np.zeros(env.num_envs, int), [[[]] for _ in range(env.num_envs)]
    while taken < n_steps and len(ends) < ENOUGH:
        taken += env.num_envs
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
    return Seen(ends, taken, _is_clock([one for trace in traces for one in trace]))


def is_same(first: Any, second: Any) -> bool:
    """:return: whether two observations are equal"""
    if isinstance(first, dict):
        return all(is_same(part, second[name]) for name, part in first.items())
    return np.array_equal(np.asarray(first), np.asarray(second))


def _drawing(space: spaces.Space, seed: int) -> spaces.Space:
    """:return: a space to draw from that leaves the environment's own as it is"""
    drawing = copy.deepcopy(space)
    drawing.seed(seed)
    return drawing


def _flat(space: spaces.Space, obs: Any) -> np.ndarray:
    if isinstance(space, spaces.Dict):
        return np.concatenate([_flat(part, obs[name]) for name, part in space.items()])
    return np.asarray(obs, np.float64).ravel()


def _is_clock(traces: list[list[np.ndarray]]) -> bool:
    """Whether an entry is the same at the same time in all episodes, and never twice in one."""
    whole = [np.stack(trace) for trace in traces if len(trace) > 1]
    if len(whole) < 2:
        return False
    n = min(map(len, whole))
    rows = np.stack([trace[:n] for trace in whole])
    same = np.ptp(rows, axis=0).max(0) < 1e-6
    steady = (np.diff(rows[0], axis=0) > 0).all(0) | (np.diff(rows[0], axis=0) < 0).all(0)
    return bool((same & steady).any())
