"""What all off-policy algorithms share: ``learn``, checks of measurements, saved replay buffers."""

import copy
import io
import numbers
import pathlib
from typing import Any, ClassVar, Self

import numpy as np
from sbx.common.off_policy_algorithm import OffPolicyAlgorithmJax
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.type_aliases import MaybeCallback, RolloutReturn

from sb3_hds.algos.base.checks import (
    check_buffer,
    check_buffer_class,
    check_log_interval,
    check_origin,
    check_policy_kwargs,
)
from sb3_hds.algos.base.config import OffPolicyConfig, schedule_of
from sb3_hds.algos.base.executed_actions import executed
from sb3_hds.algos.base.files import damaged, write_whole
from sb3_hds.algos.base.pace import Pace
from sb3_hds.algos.base.policy import TensorPolicy
from sb3_hds.algos.base.root import TensorAlgorithm
from sb3_hds.algos.nets.options import by_names

_STATISTICS = ("obs_rms", "ret_rms", "returns")


class OffPolicyTensorAlgorithm(TensorAlgorithm, OffPolicyAlgorithmJax):
    """Abstract: an off-policy algorithm whose policy is a :class:`TensorPolicy`."""

    default_timesteps: ClassVar[int] = 1_000
    #: whether a wrapper may have executed actions stored in place of the chosen ones
    stores_executed: ClassVar[bool] = True
    #: base class that every policy of the algorithm extends
    policy_family: ClassVar[type[TensorPolicy]] = TensorPolicy
    policy: TensorPolicy
    #: statistics of ``VecNormalize`` after the last stored step
    _statistics: dict[str, Any] | None = None

    def construct(self, config: OffPolicyConfig, **more: Any) -> None:
        super().construct(config, **more)
        self._pace = Pace()

    @property
    def network_seed(self) -> int:
        """Seed of the next networks; each reset of the networks has its own."""
        return int(np.asarray(self.key)[-1]) + self.reset_idx

    def learn(  # type: ignore[override]
        self,
        total_timesteps: int | None = None,
        callback: MaybeCallback = None,
        log_interval: int | None = 4,
        tb_log_name: str | None = None,
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> Self:
        """
        Act in the environment and learn from it, PODS and HDS after their pretraining in the twin.

        :param total_timesteps: steps of the *environment*; default ``default_timesteps``. With 0,
            PODS and HDS run their pretraining only.
        :param callback: called at every step of the environment; with PODS and HDS also after every
            planning epoch of the pretraining, with ``locals["pretraining"]`` and no timestep
            counted
        :param log_interval: episodes between two log lines
        :param tb_log_name: name of the run for TensorBoard; default: the class's name
        :param reset_num_timesteps: False continues the count of timesteps
        :param progress_bar: whether to show a progress bar
        """
        check_log_interval(log_interval)
        if total_timesteps is None:
            total_timesteps = self.default_timesteps
        learned = super().learn(
            total_timesteps,
            callback,
            log_interval,  # type: ignore[arg-type]
            tb_log_name or type(self).__name__,
            reset_num_timesteps,
            progress_bar,
        )
        self.check_weights()
        return learned

    def _setup_learn(self, *args: Any, **kwargs: Any) -> tuple[int, BaseCallback]:
        """:raises ValueError: for a first observation that is not finite"""
        self._keep_statistics()
        self._pace.pause()
        found = super()._setup_learn(*args, **kwargs)
        self._refuse_unless_finite("What the environment begins with", self._last_obs)
        return found

    def collect_rollouts(self, *args: Any, **kwargs: Any) -> RolloutReturn:
        self._pace.updated(self)
        before = self.num_timesteps
        collected = super().collect_rollouts(*args, **kwargs)
        self._pace.collected(self, self.num_timesteps - before)
        return collected

    def check_environment(self, config: Any) -> None:
        """
        :param config: the arguments, checked
        :raises ValueError: for an argument that does not go with the environment
        :raises EnvironmentMismatchError: for an environment that does not go with the arguments
        """

    def remedies(self, updates_per_step: float) -> list[str]:
        """:return: arguments that would make a slow learner faster, for a warning"""
        raise NotImplementedError

    def _store_transition(
        self,
        replay_buffer: ReplayBuffer,
        buffer_action: np.ndarray,
        new_obs: np.ndarray | dict[str, np.ndarray],
        reward: np.ndarray,
        dones: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        """
        :raises ValueError: for a measurement that is not finite; the steps before it are kept, and
            the next call of ``learn`` resets the environment
        """
        ends = [info["terminal_observation"] for info in infos if "terminal_observation" in info]
        step = f"Step {self.num_timesteps} of the environment"
        self._refuse_unless_finite(step, new_obs, reward, *ends)
        self._keep_statistics()
        if self.stores_executed:
            buffer_action = executed(self.action_space, buffer_action, infos)
        super()._store_transition(replay_buffer, buffer_action, new_obs, reward, dones, infos)  # type: ignore[arg-type]
        self.after_step(new_obs, reward, dones)

    def after_step(
        self, new_obs: np.ndarray | dict[str, np.ndarray], reward: np.ndarray, dones: np.ndarray
    ) -> None:
        """
        Called after a step of every environment was added to the replay buffer.

        :param new_obs: observations after the step, normalised as policies see them
        :param reward: shape ``(n_envs,)``, normalised by ``VecNormalize`` if there is one
        :param dones: whether the episode ended, shape ``(n_envs,)``
        """

    def _keep_statistics(self) -> None:
        normalizer = self._vec_normalize_env
        if normalizer is not None:
            held = [name for name in _STATISTICS if hasattr(normalizer, name)]
            self._statistics = {name: copy.deepcopy(getattr(normalizer, name)) for name in held}

    def _refuse_unless_finite(self, what: str, *measured: Any) -> None:
        """``VecNormalize`` clips infinities, so check the raw values; undo its statistics, too."""
        normalizer = self._vec_normalize_env
        given = measured
        if normalizer is not None:
            own = normalizer.get_original_obs(), normalizer.get_original_reward()
            given = own[: len(measured)]
        if all(map(_is_finite, (*measured, *given))):
            return
        for name, value in (self._statistics or {}).items():
            setattr(normalizer, name, value)
        self._last_obs = None
        named = zip(("observation", "reward"), given, strict=False)
        raise ValueError(
            f"{what} is not finite: {', '.join(f'{name} {value}' for name, value in named)}. The "
            "model and the steps before are as they were: mend the sensor, then learn(..., "
            "reset_num_timesteps=False)."
        )

    def save_replay_buffer(self, path: str | pathlib.Path | io.BufferedIOBase) -> None:
        write_whole(path, "pkl", super().save_replay_buffer)

    def load_replay_buffer(
        self,
        path: str | pathlib.Path | io.BufferedIOBase,
        truncate_last_traj: bool = True,
    ) -> None:
        """
        SB3's ``load_replay_buffer``. It unpickles: load only files that you saved yourself.

        :param path: of a file that ``save_replay_buffer`` wrote; ``.pkl`` may be left out
        :param truncate_last_traj: for ``HerReplayBuffer``: whether to end the last episode
        :raises ValueError: for a damaged file, for a buffer of another environment, and for one
            that the algorithm cannot use; the model then keeps its buffer
        """
        before: Any = getattr(self, "replay_buffer", None)
        try:
            super().load_replay_buffer(path, truncate_last_traj)
        except (OSError, AssertionError):
            raise
        # Unpickling a damaged file may raise anything.
        except Exception as error:
            if getattr(self, "replay_buffer", None) is not before:
                raise
            raise damaged(path, error) from error
        try:
            self.check_replay_buffer(self.replay_buffer, path)
        except ValueError:
            self.replay_buffer = before
            raise
        # SB3 expects the model's device here; SBX sets the CPU.
        self.replay_buffer.device = self.device  # type: ignore[union-attr]

    def check_replay_buffer(self, buffer: Any, path: Any) -> None:
        """
        :param buffer: object that was read from ``path``
        :raises ValueError: for a buffer that the algorithm cannot use
        """
        check_buffer(self, buffer, path)

    def _setup_model(self) -> None:
        check_origin(type(self), self.saved_by)
        check_policy_kwargs(self.policy_class, self.policy_kwargs)
        self.policy_kwargs = by_names(self.policy_kwargs)
        if isinstance(self.learning_rate, str):
            self.learning_rate = schedule_of(self.learning_rate)
        elif isinstance(self.learning_rate, numbers.Real):
            self.learning_rate = float(self.learning_rate)
        self.check_environment(self.config)
        check_buffer_class(type(self), self.replay_buffer_class, self.observation_space)
        try:
            super()._setup_model()
        except MemoryError as error:
            raise MemoryError(
                f"{type(self).__name__}(buffer_size={self.buffer_size}): the replay buffer does "
                f"not fit into memory ({error}). Pass a smaller buffer_size."
            ) from error

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_statistics", "_pace"]


def _is_finite(measured: Any) -> bool:
    parts = measured.values() if isinstance(measured, dict) else [measured]
    return all(np.isfinite(part).all() for part in parts)
