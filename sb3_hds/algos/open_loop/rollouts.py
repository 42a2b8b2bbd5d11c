"""Episodes of many gaits in the copies of a vectorised environment."""

from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecEnv,
    VecEnvWrapper,
    VecExtractDictObs,
    VecFrameStack,
    VecMonitor,
    VecNormalize,
)

from sb3_hds.algos.open_loop.gait import Constants
from sb3_hds.algos.open_loop.policy import OscillatorPolicy, targets_of


class Trial(NamedTuple):
    """
    One episode of a gait.

    :param row: number of the gait
    :param seed: of the reset
    :param place: index of its return
    """

    row: int
    seed: int
    place: tuple[Any, ...]


class Trials:
    """
    Run episodes in all copies of the environment in parallel. Copies without further trials
    continue to move until the others are done, and their steps count, too.

    :param model: with the environment and the counters
    :param policy: that tracks the targets of a gait
    :param callback: called at every step
    :param total_timesteps: number of timesteps at which to stop
    """

    def __init__(
        self,
        model: BaseAlgorithm,
        policy: OscillatorPolicy,
        callback: BaseCallback,
        total_timesteps: int,
    ) -> None:
        assert model.env is not None
        self._model, self._policy = model, policy
        self._callback, self._total = callback, total_timesteps
        self._env = model.env
        self._one_by_one = can_reset_one(model.env)
        self._steps = np.zeros(model.n_envs, np.int64)
        self._returns = np.zeros(model.n_envs)

    def run(
        self,
        gaits: Constants,
        trials: Sequence[Trial],
        keep: Callable[[Trial, float], None],
        horizon: int | None,
    ) -> bool:
        """
        :param gaits: one per row
        :param trials: in the order of their starts
        :param keep: called with each completed trial and its return
        :param horizon: steps after which an episode is truncated, if single copies can be reset
        :return: whether all trials are complete; False: no more timesteps, or the callback stopped
        """
        assert self._policy.robot is not None
        dt, waiting = self._policy.robot.dt, deque(trials)
        running: list[Trial | None] = [None] * self._env.num_envs
        if not self._one_by_one:
            self._model._last_obs = self._env.reset()  # type: ignore[assignment]
        for copy in range(len(running)):
            running[copy] = self._start(copy, waiting)
        while any(trial is not None for trial in running):
            rows = np.array([trial.row if trial else 0 for trial in running])
            acting = Constants(*(part[rows] for part in gaits))
            if not self._step(targets_of(acting, self._steps, dt), acting.kp, acting.kd):
                return False
            for copy, trial in enumerate(running):
                cut = self._one_by_one and self._steps[copy] == horizon
                if trial is not None and (self._dones[copy] or cut):
                    keep(trial, float(self._returns[copy]))
                    running[copy] = self._start(copy, waiting)
                elif self._dones[copy]:
                    self._steps[copy] = 0
        return True

    def _start(self, copy: int, waiting: deque[Trial]) -> Trial | None:
        """Reset a copy of the environment for the next trial, if there is one."""
        self._steps[copy], self._returns[copy] = 0, 0.0
        if not waiting:
            return None
        trial = waiting.popleft()
        if self._one_by_one:
            [(obs, _)] = self._env.env_method("reset", seed=trial.seed, indices=[copy])
            _forget_episode(self._env, copy)
            seen = self._model._last_obs
            if isinstance(seen, np.ndarray) and np.shape(obs) == seen.shape[1:]:
                seen[copy] = obs
        return trial

    def _step(self, targets: np.ndarray, kp: np.ndarray, kd: np.ndarray) -> bool:
        """:return: whether to continue"""
        model, callback = self._model, self._callback
        if model.num_timesteps >= self._total:
            return False
        actions = self._policy.command(targets, model._last_obs, kp, kd)
        new_obs, rewards, dones, infos = self._env.step(actions)
        normaliser = model.get_vec_normalize_env()
        earned = rewards if normaliser is None else normaliser.get_original_reward()
        if not np.isfinite(earned).all():
            raise ValueError(
                f"The reward at step {model.num_timesteps} of the environment is not finite: "
                f"{earned}. The search is as it was before this episode: mend the sensor, then "
                "learn(..., reset_num_timesteps=False)."
            )
        model.num_timesteps += self._env.num_envs
        callback.update_locals(locals())
        going = callback.on_step()
        # Some environments step into the array that they returned before.
        model._last_obs = new_obs.copy() if isinstance(new_obs, np.ndarray) else new_obs  # type: ignore[assignment]
        model._update_info_buffer(infos, dones)
        total = model._total_timesteps
        model._update_current_progress_remaining(model.num_timesteps, total)
        self._steps += 1
        self._returns += earned
        self._dones = dones
        return going


def can_reset_one(env: VecEnv) -> bool:
    """:return: whether a single copy can be reset with a seed, in spite of all wrappers"""
    while isinstance(env, VecEnvWrapper):
        if isinstance(env, VecFrameStack | VecExtractDictObs):
            return False
        env = env.venv
    return isinstance(env, DummyVecEnv | SubprocVecEnv)


def _forget_episode(env: Any, copy: int) -> None:
    """Reset what wrappers have accumulated of a truncated episode."""
    while isinstance(env, VecEnvWrapper):
        if isinstance(env, VecMonitor):
            env.episode_returns[copy], env.episode_lengths[copy] = 0.0, 0
        elif isinstance(env, VecNormalize):
            env.returns[copy] = 0.0
        env = env.venv
