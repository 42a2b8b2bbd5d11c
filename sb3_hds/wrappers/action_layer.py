"""Base classes of the layers between a policy and the commands of an environment."""

import abc
import inspect
from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium import spaces

from sb3_hds.core import Actuator, Channel, Signals
from sb3_hds.core.transforms.base import StatefulTransform
from sb3_hds.errors import ParameterError
from sb3_hds.wrappers.observations import extended_box, is_vector

_STORES = ("raw", "executed")


class ActionLayer(gymnasium.Wrapper, gymnasium.utils.RecordConstructorArgs, abc.ABC):
    """
    Abstract: maps the action of a policy to the command of the environment.

    ``step`` adds to ``info``, also for nested layers:

    - ``raw_action``: the action of the policy, before the outermost layer
    - ``safe_action``: the command of the environment, after the innermost layer
    - ``correction``: the sum of the changes by all layers, in command units
    - ``constraint_cost``: the sum of the constraint violations of all layers
    - ``executed_action``: the action that corresponds to the executed command, in the outermost
      layer's action space; the raw action if a layer has no such inverse
    - ``stored_action``: the same, if the outermost layer has ``store="executed"``: the action that
      a learner should store instead of its own

    :param env: with a bounded Box of one axis as action space
    :param store: ``"raw"``, or ``"executed"``
    :param arguments: the other arguments of the constructor, recorded in ``env.spec`` so that the
        wrapper can be rebuilt
    :raises ParameterError: for other actions, or another ``store``
    """

    #: whether a command may differ from the action
    alters_commands: ClassVar[bool] = True
    #: allowed values of ``store``
    stores: ClassVar[tuple[str, ...]] = _STORES

    def __init__(self, env: gymnasium.Env, store: str, **arguments: Any) -> None:
        gymnasium.utils.RecordConstructorArgs.__init__(self, store=store, **arguments)
        gymnasium.Wrapper.__init__(self, env)
        check_bounded(type(self), env.action_space)
        if store not in self.stores:
            raise ParameterError(
                f"{type(self).__name__}(store={store!r}): store must be one of {self.stores}."
            )
        self.store = store
        self._obs = np.zeros(0)

    @property
    def commands(self) -> spaces.Box:
        """The command space of the environment below."""
        assert isinstance(self.env.action_space, spaces.Box)
        return self.env.action_space

    @abc.abstractmethod
    def decide(self, action: np.ndarray) -> np.ndarray:
        """
        :param action: finite, of the shape of the action space
        :return: the command, in double precision
        """

    def nominal(self, action: np.ndarray) -> np.ndarray:
        """:return: the command that would count as uncorrected"""
        return np.clip(action, self.commands.low, self.commands.high)

    def action_for(self, command: np.ndarray) -> np.ndarray:
        """:return: the action whose command this is: the inverse of :meth:`nominal`"""
        return command

    def begin(self, obs: Any) -> None:
        """Start an episode with its first observation."""
        self._obs = vector(self.env.observation_space, obs)

    def observe(self, obs: Any, command: np.ndarray) -> None:
        """Take note of a command and of the observation that followed it."""
        self._obs = vector(self.env.observation_space, obs)

    def observation(self, obs: Any) -> Any:
        """:return: what the policy sees"""
        return obs

    def cost(self) -> float:
        """:return: violation of the layer's constraints at the latest observation"""
        return 0.0

    def penalty(self) -> float:
        """:return: penalty on the latest command, to subtract from the reward"""
        return 0.0

    def extra_info(self) -> dict[str, Any]:
        """:return: further entries of ``info``"""
        return {}

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        obs, info = self.env.reset(seed=seed, options=options)
        self.begin(obs)
        return self.observation(obs), info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """
        :return: as the environment, with the entries of ``info`` above
        :raises ValueError: for an action of another shape or not finite
        """
        raw = check_action(self, action)
        command = self._rounded(self.decide(raw))
        correction = command - self.nominal(raw)
        obs, reward, terminated, truncated, info = self.env.step(command)
        self.observe(obs, command)
        info = self._extended_info(raw, command, correction, info)
        return self.observation(obs), float(reward) - self.penalty(), terminated, truncated, info

    def _rounded(self, command: np.ndarray) -> np.ndarray:
        """The command in the environment's data type; rounding must not leave its limits."""
        space = self.commands
        return np.clip(command.astype(space.dtype), space.low, space.high)

    def _extended_info(
        self,
        raw: np.ndarray,
        command: np.ndarray,
        correction: np.ndarray,
        below: dict[str, Any],
    ) -> dict[str, Any]:
        inner = below.get("correction")
        if inner is not None and np.shape(inner) == correction.shape:
            correction = correction + inner
        info = below | {
            "raw_action": raw.astype(self.action_space.dtype),
            "safe_action": below.get("safe_action", command),
            "correction": correction,
            "constraint_cost": self.cost() + below.get("constraint_cost", 0.0),
        }
        info.pop("stored_action", None)
        executed = raw
        if "executed" in self.stores:
            executed = self.action_for(below.get("executed_action", command))
        info["executed_action"] = executed.astype(self.action_space.dtype)
        if self.store == "executed":
            info["stored_action"] = info["executed_action"]
        return info | self.extra_info()


class TransformLayer(ActionLayer):
    """
    Abstract: applies a :class:`~sb3_hds.core.StatefulTransform`, which can also wrap a twin.

    :param transform: from actions to commands
    :raises ParameterError: if it does not fit the environment
    """

    def __init__(
        self,
        env: gymnasium.Env,
        transform: StatefulTransform,
        store: str,
        **arguments: Any,
    ) -> None:
        super().__init__(env, store, **arguments)
        self._transform = transform
        self._below = signals_of(env)
        remembered = transform.remembers(self._below)
        self._memory = transform.start(np.zeros(len(self._below.channels)), self._below)
        if transform.observed and remembered:
            self.observation_space = with_channels(self, env.observation_space, remembered)
        self._appends = bool(transform.observed and remembered)
        self._penalty = 0.0

    @property
    def twin_transform(self) -> StatefulTransform | None:
        """The transform that wraps the twin alike; None if there is no exact one."""
        return self._transform

    @property
    def twin_transforms(self) -> list[tuple[str, StatefulTransform]]:
        """Layer classes and transforms, from here down to the environment."""
        layers, env = [], self
        while isinstance(env, gymnasium.Wrapper):
            if isinstance(env, TransformLayer) and env.twin_transform is not None:
                layers.append((type(env).__name__, env.twin_transform))
            env = env.env
        return layers

    def decide(self, action: np.ndarray) -> np.ndarray:
        given = action, self._obs, self._memory, self._below
        self._penalty = float(self._transform.cost(*given))
        command, self._memory = self._transform.act(*given)
        return command

    def penalty(self) -> float:
        return self._penalty

    def begin(self, obs: Any) -> None:
        super().begin(obs)
        if not self._transform.persists:
            self._memory = self._transform.start(self._obs, self._below)

    def observation(self, obs: Any) -> Any:
        if not self._appends:
            return obs
        assert self.observation_space.dtype is not None
        return np.concatenate([obs, self._memory]).astype(self.observation_space.dtype)


def check_bounded(layer: type, space: spaces.Space) -> None:
    """:raises ParameterError: unless actions are a bounded Box with one axis"""
    if not (is_vector(space) and space.is_bounded()):
        raise ParameterError(
            f"{layer.__name__} takes environments whose actions are a bounded Box with one axis, "
            f"got {space}. Flatten them, or give them limits, below this wrapper."
        )


def check_action(env: gymnasium.Env, action: Any) -> np.ndarray:
    """
    :return: the action in double precision
    :raises ValueError: for another shape, or numbers that are not finite
    """
    found = np.asarray(action, np.float64)
    if found.shape != env.action_space.shape:
        raise ValueError(f"{env} takes actions of shape {env.action_space.shape}, got {found!r}.")
    if not np.isfinite(found).all():
        raise ValueError(f"{env} takes finite actions, got {found.tolist()}.")
    return found


def vector(space: spaces.Space, obs: Any) -> np.ndarray:
    """:return: the observation in double precision; empty if it is not a vector"""
    return np.asarray(obs, np.float64) if is_vector(space) else np.zeros(0)


def signals_of(env: gymnasium.Env) -> Signals:
    """:return: the limits of an environment's actions and, if they are a vector, observations"""
    space, seen = env.action_space, env.observation_space
    assert isinstance(space, spaces.Box)
    actuators = tuple(Actuator(f"action[{i}]", "1", *e) for i, e in enumerate(_ends(space)))
    ends = _ends(seen) if is_vector(seen) else []
    channels = tuple(Channel(f"obs[{i}]", "1", *e) for i, e in enumerate(ends))
    return Signals(actuators, channels)


def with_channels(
    env: gymnasium.Env, space: spaces.Space, added: tuple[Channel, ...]
) -> spaces.Box:
    """
    :return: the observation space with ``added`` appended
    :raises ParameterError: unless observations are a Box with one axis
    """
    if not is_vector(space):
        switch = "observe_state" in inspect.signature(type(env).__init__).parameters
        or_else = ", or pass observe_state=False: then the task is no longer Markov" * switch
        raise ParameterError(
            f"{type(env).__name__} adds to observations that are a Box with one axis, got {space}. "
            f"Flatten them below (gymnasium.wrappers.FlattenObservation){or_else}."
        )
    return extended_box(space, [c.low for c in added], [c.high for c in added])


def _ends(space: spaces.Box) -> list[tuple[float, float]]:
    low, high = space.low.astype(float).tolist(), space.high.astype(float).tolist()
    return list(zip(low, high, strict=True))
