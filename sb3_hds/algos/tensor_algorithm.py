"""What all our algorithms share: one way in, weights as tensors, files that are whole or not there,
and no measurement that is not finite."""

import io
import pathlib
from collections.abc import Iterable
from typing import Any, ClassVar, Self

import numpy as np
from sbx.common.off_policy_algorithm import OffPolicyAlgorithmJax
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback

from sb3_hds.algos.call_forms import check_origin, device_or_cpu
from sb3_hds.algos.executed_actions import executed
from sb3_hds.algos.persistence import TensorPolicy, damage_reported, write_whole


class TensorAlgorithm(OffPolicyAlgorithmJax):
    """Abstract: an off-policy algorithm whose policy is a :class:`TensorPolicy`."""

    default_timesteps: ClassVar[int] = 1_000
    #: whether a layer around the environment may decide that executed actions are stored
    stores_executed: ClassVar[bool] = True
    policy: TensorPolicy
    saved_by: str

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
        Act in the environment and learn from it.

        :param total_timesteps: steps of the *environment*; default ``default_timesteps``
        :param callback: called at every step of the environment
        :param log_interval: episodes between two log lines
        :param tb_log_name: name of the run for TensorBoard; default: the class's name
        :param reset_num_timesteps: False goes on counting
        :param progress_bar: show one
        """
        if total_timesteps is None:
            total_timesteps = self.default_timesteps
        return super().learn(
            total_timesteps,
            callback,
            log_interval,  # type: ignore[arg-type]
            tb_log_name or type(self).__name__,
            reset_num_timesteps,
            progress_bar,
        )

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
        if not all(_is_finite(measured) for measured in (new_obs, reward, *ends)):
            self._last_obs = None
            raise ValueError(
                f"Step {self.num_timesteps} of the environment is not finite: observation "
                f"{new_obs}, reward {reward}. The model and the steps before are as they were: "
                "mend the sensor, then learn(..., reset_num_timesteps=False)."
            )
        if self.stores_executed:
            buffer_action = executed(self.action_space, buffer_action, infos)
        super()._store_transition(replay_buffer, buffer_action, new_obs, reward, dones, infos)  # type: ignore[arg-type]

    def save(
        self,
        path: str | pathlib.Path | io.BufferedIOBase,
        exclude: Iterable[str] | None = None,
        include: Iterable[str] | None = None,
    ) -> None:
        """
        Write a zip file as SB3 does, whole or not at all.

        :param path: of the file; ``.zip`` is appended where it has no suffix
        :param exclude: attributes to leave out besides the usual ones
        :param include: attributes to write although they are usually left out
        :raises OSError: if the file cannot be written; an older one is then left as it was
        """
        write = super().save
        write_whole(path, "zip", lambda file: write(file, exclude, include))

    def save_replay_buffer(self, path: str | pathlib.Path | io.BufferedIOBase) -> None:
        write_whole(path, "pkl", super().save_replay_buffer)

    @classmethod
    def load(
        cls,
        path: str | pathlib.Path | io.BufferedIOBase,
        env: GymEnv | None = None,
        device: Any = "auto",
        *args: Any,
        **kwargs: Any,
    ) -> Self:
        """
        SB3's ``load``.

        :param path: of a file that this class saved
        :param env: to go on training in; none is needed to predict
        :param device: where to; ``"cuda"`` means the CPU where there is none, with a warning
        :raises ValueError: for a damaged file, or one that another algorithm saved
        """
        with damage_reported(path):
            return super().load(path, env, device_or_cpu(device), *args, **kwargs)

    def get_parameters(self) -> dict[str, dict]:
        """:return: by the object's name its tensors by theirs; objects that have some"""
        return {name: tensors for name, tensors in super().get_parameters().items() if tensors}

    def set_parameters(
        self,
        load_path_or_dict: str | dict[str, Any],
        exact_match: bool = True,
        device: Any = "auto",
    ) -> None:
        """
        SB3's ``set_parameters``.

        :param load_path_or_dict: of a file, or what ``get_parameters`` returned
        :param exact_match: whether nothing may be missing
        :param device: where to
        :raises ValueError: for names of objects that this model does not have, or has and misses
        :raises RuntimeError: for tensors that do not fit
        """
        given = load_path_or_dict
        if not isinstance(given, dict):
            _, given, _ = load_from_zip_file(given, device=device, load_data=False)
        own, (names, _) = self.get_parameters(), self._get_torch_save_params()
        empty: dict[str, Any] = {name: {} for name in names if name not in own}
        super().set_parameters(empty | given, exact_match, device)

    def _setup_model(self) -> None:
        check_origin(type(self), self.saved_by)
        self.check_arguments()
        super()._setup_model()

    def check_arguments(self) -> None:
        """
        :raises ValueError: for an argument that would otherwise fail later, or not at all
        """

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy", "policy.optimizer"], []

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "policy", "key", "_device_name"]


def _is_finite(measured: Any) -> bool:
    parts = measured.values() if isinstance(measured, dict) else [measured]
    return all(np.isfinite(part).all() for part in parts)
