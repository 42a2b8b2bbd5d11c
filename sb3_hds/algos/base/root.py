"""Construction, saving and loading of every algorithm; weights are saved as tensors."""

import contextlib
import inspect
import io
import os
import pathlib
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Any, ClassVar, Self

from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback

from sb3_hds.algos import registry
from sb3_hds.algos.base.checks import (
    callbacks_of,
    check_has_env,
    checked_env,
    checked_timesteps,
    device_or_cpu,
    in_one_line,
    policy_and_env,
)
from sb3_hds.algos.base.config import Config, arguments_of, check_known
from sb3_hds.algos.base.files import damage_reported, name_of, refuse_damaged, write_whole
from sb3_hds.algos.base.policy_file import described
from sb3_hds.algos.nets.options import by_names
from sb3_hds.core.numerics.compilation import cache_compiled_programs
from sb3_hds.errors import EnvironmentMismatchError

if TYPE_CHECKING:
    from sb3_hds.deploy import Exported


@contextlib.contextmanager
def _space_mismatch_reported() -> Iterator[None]:
    """:raises EnvironmentMismatchError: where SB3 finds that spaces do not match"""
    try:
        yield
    except ValueError as error:
        if "spaces do not match" not in str(error):
            raise
        raise EnvironmentMismatchError(
            f"{in_one_line(error)}: this model learned in an environment with the former. Pass one "
            "like it, or make a new model."
        ) from error


class _ByName:
    """The policy class of a model, stored and saved by its name in the registry if it has one."""

    def __get__(self, model: Any, owner: type | None = None) -> Any:
        if model is None:
            return self
        held = vars(model)["policy_class"]
        return registry.load(held) if isinstance(held, str) else held

    def __set__(self, model: Any, kind: Any) -> None:
        vars(model)["policy_class"] = registry.registered_name(kind) or kind


class TensorAlgorithm(BaseAlgorithm):
    """Abstract: an algorithm whose policy is a :class:`~sb3_hds.algos.base.policy.TensorPolicy`."""

    policy_class = _ByName()  # type: ignore[assignment]  # SB3 annotates what it returns
    policy_description: dict[str, Any] | None

    #: the dataclass whose fields are the arguments of the constructor
    config_class: ClassVar[type[Config]] = Config
    saved_by: str
    _device_name: str

    def construct(self, config: Config, **more: Any) -> None:
        """
        Pass on the arguments that SB3's constructor takes, and store the others as attributes.

        :param more: fixed arguments of SB3's constructor
        """
        cache_compiled_programs()
        policy, env = policy_and_env(
            type(self), config.policy, config.env, self.check_observations, config.monitor_wrapper
        )
        # SB3 seeds Python's generator, too, which takes no NumPy integer.
        seed = None if config.seed is None else int(config.seed)
        own: dict[str, Any] = {name: getattr(config, name) for name in arguments_of(config)}
        # SB3 and SBX write into dictionaries, which several models may have been given.
        own = {name: dict(x) if isinstance(x, dict) else x for name, x in own.items()}
        own |= {"policy": policy, "env": env, "seed": seed}
        del own["device"]  # of torch, where SB3 has one
        fixed = {"supported_action_spaces": (spaces.Box,), "support_multi_env": True, **more}
        of_sb3 = inspect.signature(super().__init__).parameters
        super().__init__(**{n: x for n, x in (own | fixed).items() if n in of_sb3})
        for name in own.keys() - of_sb3.keys():
            setattr(self, name, own[name])
        self.saved_by, self._device_name = type(self).__name__, str(config.device)

    def set_up(self) -> None:
        """
        Make networks and buffers, at the end of every constructor and of ``load``.

        :raises ValueError: without an environment
        """
        if self.env is None:
            name = type(self).__name__
            raise ValueError(f"{name} needs an environment, for example {name}('Pendulum-v1').")
        self._setup_model()

    @property
    def config(self) -> Any:
        """The current values of the arguments."""
        return self.config_class.of(self)

    @staticmethod
    def check_observations(space: spaces.Space) -> None:
        """:raises EnvironmentMismatchError: for observations that the algorithm cannot use"""

    def save(
        self,
        path: str | pathlib.Path | io.BufferedIOBase,
        exclude: Iterable[str] | None = None,
        include: Iterable[str] | None = None,
    ) -> None:
        """
        Write a zip file as SB3 does, atomically.

        :param path: of the file; ``.zip`` is appended where it has no suffix
        :param exclude: attributes to leave out besides the default ones
        :param include: attributes to write although they are left out by default
        :raises OSError: if the file cannot be written; an older file is then unchanged
        :raises DivergedError: for weights that are not finite
        """
        self.check_weights()
        self.policy_description = described(self.policy)  # type: ignore[arg-type]
        write = super().save
        write_whole(path, "zip", lambda file: write(file, exclude, include))

    def export_onnx(self, path: str | os.PathLike[str], **options: Any) -> "Exported":
        """
        Export the deterministic policy as an ONNX file, which :class:`~sb3_hds.deploy.OnnxPolicy`
        and every other ONNX runtime runs.

        :param path: an existing file is replaced
        :param options: see :func:`~sb3_hds.deploy.export_onnx`
        :return: description of the file
        :raises ExportError: if the file would not compute the same actions
        """
        from sb3_hds.deploy import export_onnx

        return export_onnx(self, path, **options)

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
        :param env: to continue training in; not needed for prediction
        :param device: of the weights; ``"cuda"`` falls back to the CPU with a warning
        :raises ValueError: for a damaged file, or one that another algorithm saved
        :raises TypeError: for an argument that neither ``load`` nor the constructor has
        """
        check_known(cls, cls.config_class, kwargs, loading=True)
        env = None if env is None else checked_env(cls, env)
        if kwargs.get("policy_kwargs"):
            kwargs["policy_kwargs"] = by_names(kwargs["policy_kwargs"])
        refuse_damaged(path, "data", "policy.pth")
        with damage_reported(path), _space_mismatch_reported():
            return super().load(path, env, device_or_cpu(device), *args, **kwargs)

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """
        SB3's ``set_env``.

        :param env: an environment with the same spaces, or its id
        :param force_reset: False continues from the environment's current state
        :raises EnvironmentMismatchError: unless it is an environment with the same spaces
        """
        with _space_mismatch_reported():
            super().set_env(checked_env(type(self), env), force_reset)

    def _setup_learn(
        self, total_timesteps: int, *args: Any, **kwargs: Any
    ) -> tuple[int, BaseCallback]:
        check_has_env(self)
        return super()._setup_learn(checked_timesteps(total_timesteps), *args, **kwargs)

    def _init_callback(self, callback: MaybeCallback, progress_bar: bool = False) -> BaseCallback:
        return super()._init_callback(callbacks_of(callback), progress_bar)  # type: ignore[arg-type]

    def check_weights(self) -> None:
        """
        :raises DivergedError: for weights that are not finite; some algorithms cannot have any
        """

    def get_parameters(self) -> dict[str, dict]:
        """:return: tensors by object and name; objects without tensors are left out"""
        return {name: tensors for name, tensors in super().get_parameters().items() if tensors}

    def set_parameters(
        self,
        load_path_or_dict: str | dict[str, Any],
        exact_match: bool = True,
        device: Any = "auto",
    ) -> None:
        """
        SB3's ``set_parameters``.

        :param load_path_or_dict: path of a file, or the result of ``get_parameters``
        :param exact_match: whether all objects must be given
        :param device: of the tensors
        :raises ValueError: for unknown or missing names of objects, and for a damaged file
        :raises RuntimeError: for tensors of other names or shapes
        """
        given = load_path_or_dict
        if not isinstance(given, dict):
            refuse_damaged(given, "policy.pth")
            with damage_reported(load_path_or_dict):
                _, given, _ = load_from_zip_file(given, device=device, load_data=False)
        own, (names, _) = self.get_parameters(), self._get_torch_save_params()
        empty: dict[str, Any] = {name: {} for name in names if name not in own}
        try:
            super().set_parameters(empty | given, exact_match, device)
        except ValueError as error:
            if isinstance(load_path_or_dict, dict):
                raise
            raise ValueError(
                f"{name_of(load_path_or_dict)} does not fit this model, or is damaged: {error}"
            ) from error

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy", "policy.optimizer"], []

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "policy", "key", "_device_name"]
