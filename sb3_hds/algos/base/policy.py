"""What all policies share: prediction, weights and training state, both saved as tensors."""

import dataclasses
from abc import abstractmethod
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Self

import jax
import jax.numpy as jnp
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.preprocessing import is_image_space, maybe_transpose
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.common.utils import get_device, is_vectorized_observation

from sb3_hds.algos.base.files import (
    damage_reported,
    from_state_dict,
    refuse_damaged,
    to_state_dict,
)
from sb3_hds.algos.nets.observations import flattener
from sb3_hds.algos.nets.optimizers import TrainState
from sb3_hds.algos.nets.options import by_names, widths
from sb3_hds.core.numerics.compilation import GENERATOR


def check_observation(observation: Any) -> None:
    """
    :raises ValueError: for the tuple that ``reset`` returns, anything that is not numeric, and
        observations that are not finite
    """
    if isinstance(observation, tuple) and len(observation) == 2:
        raise ValueError(
            "predict() got a tuple instead of an observation. Gymnasium's reset() returns "
            "(obs, info) where a VecEnv's returns obs, mixing Gym API with SB3 VecEnv API: use "
            "`obs, info = env.reset()`, or `obs = vec_env.reset()`."
        )
    parts = observation.values() if isinstance(observation, dict) else [observation]
    if not all(np.asarray(part).dtype.kind in "biuf" for part in parts):
        raise ValueError(
            f"predict() got {observation!s:.100}, which is no observation: pass what reset() and "
            "step() return, an array of numbers."
        )
    if not all(np.isfinite(part).all() for part in parts):
        raise ValueError(
            f"predict() got an observation that is not finite: {observation}. No "
            "action follows from it: repeat the last one, or stop the robot safely."
        )


@dataclasses.dataclass(frozen=True, eq=False)
class PolicyConfig:
    """
    Arguments that SB3 passes to every policy.

    :param observation_space: of the environment
    :param action_space: a bounded Box
    :param lr_schedule: maps the remaining progress to the learning rate
    """

    observation_space: spaces.Space
    action_space: spaces.Box
    lr_schedule: Schedule

    def arguments(self) -> dict[str, Any]:
        """:return: all but the spaces"""
        names = [f.name for f in dataclasses.fields(self) if not f.name.endswith("_space")]
        return {name: getattr(self, name) for name in names}


class TensorPolicy(BasePolicy):
    """
    A policy whose networks are pytrees, saved as tensors. It extends SB3's base class, not SBX's,
    which imports TensorFlow Probability.

    Subclasses implement ``weights`` and ``training_state``, each with a setter, and store the
    arguments of their constructor in ``arguments``.
    """

    #: arguments of the constructor without the spaces
    arguments: dict[str, Any]

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.optimizer = TrainingTensors(self)  # type: ignore[assignment]  # what SB3 saves

    def forward(self, obs: Any, deterministic: bool = False) -> np.ndarray:
        return self._predict(obs, deterministic)  # type: ignore[return-value]

    def reset_noise(self, batch_size: int = 1) -> None:
        """
        Draw exploration noise again, if the policy has any that lasts several steps.

        :param batch_size: number of environments
        """

    def predict(  # type: ignore[override]
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """
        :param observation: one, or a batch with one row for each copy of the environment
        :return: action of the same number of rows, in the units of the action space; ``state``
        :raises ValueError: if the observation has another shape than the observation space, or is
            not finite
        """
        check_observation(observation)
        batch, vectorized = self.prepare_obs(observation)
        scaled = np.array(self._predict(batch, deterministic=deterministic))
        scaled = scaled.reshape(-1, *self.action_space.shape)  # type: ignore[misc]
        actions = self.unscale_action(np.clip(scaled, -1.0, 1.0))
        return actions if vectorized else actions.squeeze(axis=0), state

    def prepare_obs(self, observation: Any) -> tuple[Any, bool]:
        """:return: a batch of observations, and whether it was one already"""
        space = self.observation_space
        if is_image_space(space):
            observation = maybe_transpose(observation, space)
        rows = np.array(observation)
        vectorized = is_vectorized_observation(rows, space)
        return rows.reshape(-1, *space.shape), vectorized  # type: ignore[misc]

    def unscale_action(self, scaled_action: np.ndarray) -> np.ndarray:
        """SB3's, clipped: rounding may leave the bounds by one unit in the last place."""
        low, high = self.action_space.low, self.action_space.high  # type: ignore[attr-defined]
        return np.clip(super().unscale_action(scaled_action), low, high)

    def set_up(self) -> None:
        """Nothing to do at the end of the constructor: networks are initialised on first use."""

    def move_to(self, device: Any) -> None:
        """
        Move the networks, if there are any.

        :param device: of JAX
        """

    @property
    def weights(self) -> Any:
        """The pytree that prediction needs."""
        raise AttributeError("weights")

    @weights.setter
    def weights(self, tree: Any) -> None:
        raise AttributeError("weights")

    @property
    def training_state(self) -> Any:
        """The pytree that only training needs: optimiser states, counters, random keys."""
        raise AttributeError("training_state")

    @training_state.setter
    def training_state(self, tree: Any) -> None:
        raise AttributeError("training_state")

    def _get_constructor_parameters(self) -> dict[str, Any]:
        """The arguments that ``save`` stores beside the weights and ``load`` constructs with."""
        spaces_and_more = super()._get_constructor_parameters()
        spaces_and_more.pop("normalize_images")
        arguments = by_names(self.arguments)
        if "lr_schedule" in arguments:
            # As in SB3: prediction needs no schedule, and a user's function may not be picklable.
            arguments["lr_schedule"] = self._dummy_schedule
        return spaces_and_more | arguments

    @classmethod
    def load(cls, path: str, device: Any = "auto") -> Self:
        """
        SB3's ``load`` of a policy alone. It unpickles: load only files that you saved yourself.

        :param path: of a file that ``save`` of a policy wrote
        :param device: as in SB3
        :raises ValueError: for a damaged file
        """
        refuse_damaged(path)
        with damage_reported(path):
            # As in SB3: spaces are no tensors.
            saved = th.load(path, map_location="cpu", weights_only=False)
        policy = cls(**saved["data"])
        policy.load_state_dict(saved["state_dict"])
        policy.to(get_device(device))
        return policy

    def state_dict(self, *args: Any, **kwargs: Any) -> dict[str, th.Tensor]:
        return to_state_dict(self.weights)

    def load_state_dict(self, state_dict: dict, strict: bool = True, assign: bool = False) -> None:
        self.weights = from_state_dict(self.weights, state_dict, strict)


class TrainingTensors:
    """
    Training state of a policy as SB3 saves it: in place of an optimiser, by its ``state_dict``.

    :param policy: whose training state is saved
    """

    def __init__(self, policy: TensorPolicy) -> None:
        self._policy = policy

    def state_dict(self) -> dict[str, th.Tensor]:
        return to_state_dict(self._policy.training_state)

    def load_state_dict(self, state_dict: dict[str, th.Tensor], strict: bool = True) -> None:
        self._policy.training_state = from_state_dict(
            self._policy.training_state, state_dict, strict
        )


class LearningPolicy(TensorPolicy):
    """
    Abstract: a policy with a state that updates change, a named tuple of networks with their
    optimisers (:class:`~sb3_hds.algos.nets.optimizers.TrainState`), a random ``key``, and more.
    """

    #: further fields of the state that are saved with the weights, not with the training state
    saved_with_weights: ClassVar[tuple[str, ...]]
    #: hidden widths of the actor and of the critics
    widths: tuple[tuple[int, ...], tuple[int, ...]]
    #: width of critics that a CPU can train
    narrow: ClassVar[int] = 256
    #: maps observations to rows of numbers
    flatten: Callable[[Any], np.ndarray]

    def __init__(self, config: Any) -> None:
        """:param config: a :class:`PolicyConfig` with a ``net_arch``"""
        super().__init__(config.observation_space, config.action_space, squash_output=True)
        self.arguments, net = config.arguments(), config.net_arch
        self.arguments["net_arch"] = dict(net) if isinstance(net, Mapping) else net
        self.widths = widths(net, "qf")
        self.n_obs = spaces.flatdim(config.observation_space)
        self.n_act = int(np.prod(config.action_space.shape))
        self.flatten = flattener(config.observation_space)
        self._agent_state: Any = None

    @abstractmethod
    def build_default(self) -> None:
        """Initialise networks for a policy that is used without an algorithm."""

    @abstractmethod
    def critic(self, obs: Any, actions: Any) -> tuple[np.ndarray, ...]:
        """
        Q-values, as ``model.critic`` of SB3.

        :param obs: with a leading axis, as the environment returns them
        :param actions: within [-1, 1], shape ``(n, act)``
        :return: of each critic, shape ``(n, 1)``; the mean over quantiles, if it has several
        """

    def set_random_seed(self, seed: int) -> None:
        """Reset the random key of updates and of exploratory actions."""
        # Networks of this seed were initialised with the unfolded key.
        key = jax.random.fold_in(jax.random.key(seed, impl=GENERATOR), 1)
        placed = jax.device_put(key, self.agent_state.key.sharding)
        self.agent_state = self.agent_state._replace(key=placed)

    def discard_noise(self) -> None:
        """Discard exploration noise that lasts several steps, if there is any."""

    @property
    def actor(self) -> "LearningPolicy":
        """The policy itself, where SB3 has a separate actor."""
        return self

    @property
    def agent_state(self) -> Any:
        """The state that updates change."""
        if self._agent_state is None:
            self.build_default()
        return self._agent_state

    @agent_state.setter
    def agent_state(self, state: Any) -> None:
        self._agent_state = state

    def move_to(self, device: Any) -> None:
        self.agent_state = jax.device_put(self.agent_state, device)

    def prepare_obs(self, observation: Any) -> tuple[Any, bool]:
        space = self.observation_space
        if not isinstance(space, spaces.Dict):
            return super().prepare_obs(observation)
        if not isinstance(observation, dict) or observation.keys() != space.spaces.keys():
            raise ValueError(
                f"predict() got {type(observation).__name__} instead of a dictionary with "
                f"{', '.join(space.spaces)}."
            )
        parts = {name: np.asarray(part) for name, part in observation.items()}
        vectorized = any(is_vectorized_observation(parts[name], space[name]) for name in parts)
        rows = {name: part.reshape(-1, *space[name].shape) for name, part in parts.items()}  # type: ignore[misc]
        if len({len(part) for part in rows.values()}) > 1:
            numbers = ", ".join(f"{name}: {len(part)}" for name, part in rows.items())
            raise ValueError(f"predict() got different numbers of observations ({numbers}).")
        return rows, vectorized

    @property
    def weights(self) -> Any:
        fields = self.agent_state._asdict()
        networks = {n: part.weights for n, part in fields.items() if isinstance(part, TrainState)}
        return networks | {name: fields[name] for name in self.saved_with_weights}

    @weights.setter
    def weights(self, tree: Any) -> None:
        self._replace_parts("weights", tree)

    @property
    def training_state(self) -> Any:
        """Random keys are stored as 64-bit integers, which torch can hold."""
        fields = self.agent_state._asdict()
        state = {
            name: part.optimizer if isinstance(part, TrainState) else part
            for name, part in fields.items()
            if name not in self.saved_with_weights
        }
        return state | {"key": np.asarray(jax.random.key_data(fields["key"]), np.int64)}

    @training_state.setter
    def training_state(self, tree: Any) -> None:
        data = jnp.asarray(np.asarray(tree["key"]).astype(np.uint32))
        key = jax.random.wrap_key_data(data, impl=GENERATOR)
        placed = jax.device_put(key, self.agent_state.key.sharding)
        self._replace_parts("optimizer", tree | {"key": placed})

    def _replace_parts(self, of_networks: str, tree: Any) -> None:
        before = self.agent_state._asdict()
        after = {
            name: before[name]._replace(**{of_networks: part})
            if isinstance(before[name], TrainState)
            else part
            for name, part in tree.items()
        }
        self.agent_state = self.agent_state._replace(**after)
