"""What the policies of model-free algorithms share: they hold all that updates change."""

from abc import abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.utils import is_vectorized_observation

from sb3_hds.algos.base.policy import TensorPolicy, TrainingTensors
from sb3_hds.algos.nets.optimizers import TrainState
from sb3_hds.core.numerics.compilation import GENERATOR


class LearningPolicy(TensorPolicy):
    """
    Abstract: a policy that holds a state, a named tuple of networks with their optimisers
    (:class:`~sb3_hds.algos.nets.optimizers.TrainState`), a random ``key``, and more.
    """

    #: fields of the state that are saved with the networks, not with their optimisers
    held: ClassVar[tuple[str, ...]]
    #: hidden widths of the actor and of the critics
    widths: tuple[tuple[int, ...], tuple[int, ...]]
    #: width of critics that a CPU can train
    narrow: ClassVar[int] = 256
    #: observations to rows of numbers
    flatten: Callable[[Any], np.ndarray]

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._agent_state: Any = None
        self.optimizer = TrainingTensors(self)  # type: ignore[assignment]  # what SB3 saves

    @abstractmethod
    def build_plain(self) -> None:
        """Draw networks for a policy that no algorithm has built."""

    @abstractmethod
    def critic(self, obs: Any, actions: Any) -> tuple[np.ndarray, ...]:
        """
        As ``model.critic`` of SB3, to look at values.

        :param obs: with a leading axis, as the environment gives them
        :param actions: within [-1, 1], shape ``(n, act)``
        :return: of each critic, shape ``(n, 1)``; the mean, where it has quantiles
        """

    def set_random_seed(self, seed: int) -> None:
        """Reset the random key of updates and of exploratory actions."""
        # Networks of this seed were drawn by the key that is folded here.
        key = jax.random.fold_in(jax.random.key(seed, impl=GENERATOR), 1)
        placed = jax.device_put(key, self.agent_state.key.sharding)
        self.agent_state = self.agent_state._replace(key=placed)

    def forget_noise(self) -> None:
        """Draw exploration noise that lasts several steps again, where there is some."""

    @property
    def actor(self) -> "LearningPolicy":
        """Where SB3 has the actor apart: here, it is the policy."""
        return self

    @property
    def agent_state(self) -> Any:
        """What updates change."""
        if self._agent_state is None:
            self.build_plain()
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

    def forward(self, obs: Any, deterministic: bool = False) -> np.ndarray:
        return self._predict(obs, deterministic)  # type: ignore[return-value]

    @property
    def weights(self) -> Any:
        fields = self.agent_state._asdict()
        networks = {n: part.weights for n, part in fields.items() if isinstance(part, TrainState)}
        return networks | {name: fields[name] for name in self.held}

    @weights.setter
    def weights(self, tree: Any) -> None:
        self._take("weights", tree)

    @property
    def training_state(self) -> Any:
        """Random keys are stored as 64-bit integers, which torch can hold."""
        fields = self.agent_state._asdict()
        state = {
            name: part.optimizer if isinstance(part, TrainState) else part
            for name, part in fields.items()
            if name not in self.held
        }
        return state | {"key": np.asarray(jax.random.key_data(fields["key"]), np.int64)}

    @training_state.setter
    def training_state(self, tree: Any) -> None:
        data = jnp.asarray(np.asarray(tree["key"]).astype(np.uint32))
        key = jax.random.wrap_key_data(data, impl=GENERATOR)
        placed = jax.device_put(key, self.agent_state.key.sharding)
        self._take("optimizer", tree | {"key": placed})

    def _take(self, of_networks: str, tree: Any) -> None:
        before = self.agent_state._asdict()
        after = {
            name: before[name]._replace(**{of_networks: part})
            if isinstance(before[name], TrainState)
            else part
            for name, part in tree.items()
        }
        self.agent_state = self.agent_state._replace(**after)
