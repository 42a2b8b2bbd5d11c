"""Interfaces of transforms: what a wrapper does to actions and observations, as pure functions."""

import abc
import dataclasses
from typing import Any, ClassVar, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from sb3_hds.core.declarations import Actuator, Channel
from sb3_hds.errors import ParameterError

# Arrays of NumPy or JAX; "outer" is the policy's side of a wrapper, "inner" the side of the plant.
OuterAction: TypeAlias = Float[Any, " outer"]
InnerAction: TypeAlias = Float[Any, " inner"]
InnerObs: TypeAlias = Float[Any, " obs"]
Seen: TypeAlias = Float[Any, " seen"]
Recalled: TypeAlias = Float[Any, " memory"]


class Signals(NamedTuple):
    """
    The commands and the observations of an environment or a twin.

    :param actuators: one for each command
    :param channels: one for each entry of the observation
    """

    actuators: tuple[Actuator, ...]
    channels: tuple[Channel, ...]

    def limits(self) -> tuple[np.ndarray, np.ndarray]:
        """:return: smallest and largest commands, each of shape ``(n_act,)``"""
        return np.array([a.low for a in self.actuators]), np.array([a.high for a in self.actuators])

    def rest(self) -> np.ndarray:
        """
        :return: the admissible command nearest to zero, shape ``(n_act,)``; it acts before an
            episode
        """
        return np.clip(0.0, *self.limits())

    def clip(self, command: Float[Any, " act"]) -> Float[Any, " act"]:
        """:return: the command within the limits of the actuators"""
        low, high = self.limits()
        return command.clip(like(command, low), like(command, high))


@dataclasses.dataclass(frozen=True)
class ObservationTransform(abc.ABC):
    """
    Maps the observation of the wrapped twin to that of the policy.

    A subclass is a frozen dataclass whose fields are plain data: it can be saved and compared.
    ``below`` are the channels of the twin below.
    """

    #: the name it is saved under
    name: ClassVar[str]

    @abc.abstractmethod
    def channels(self, below: tuple[Channel, ...]) -> tuple[Channel, ...]:
        """
        :return: the channels that the policy sees
        :raises ParameterError: if the transform does not fit the twin below
        """

    @abc.abstractmethod
    def observe(
        self, obs: Float[Array, " inner"], below: tuple[Channel, ...]
    ) -> Float[Array, " outer"]:
        """:return: what the policy sees"""

    @abc.abstractmethod
    def invert(
        self, obs: Float[Array, " outer"], below: tuple[Channel, ...]
    ) -> Float[Array, " inner"]:
        """:return: what the twin below reports; the inverse of :meth:`observe`"""


@dataclasses.dataclass(frozen=True)
class ActionTransform(abc.ABC):
    """
    Maps the action of the policy to the command of the wrapped twin.

    A subclass is a frozen dataclass whose fields are plain data: it can be saved and compared.
    ``below`` are the actuators of the twin below.
    """

    #: the name it is saved under
    name: ClassVar[str]

    @abc.abstractmethod
    def actuators(self, below: tuple[Actuator, ...]) -> tuple[Actuator, ...]:
        """
        :return: the actuators that the policy commands
        :raises ParameterError: if the transform does not fit the twin below
        """

    @abc.abstractmethod
    def apply(
        self, action: Float[Array, " outer"], below: tuple[Actuator, ...]
    ) -> Float[Array, " inner"]:
        """:return: the command for the twin below"""


@dataclasses.dataclass(frozen=True, kw_only=True)
class StatefulTransform(abc.ABC):
    r"""
    A wrapper with memory :math:`m`, which may look at the observation before it commands:

    .. math:: u_k, m_{k+1} = f(a_k, o_k, m_k), \qquad \text{seen: } (o_k, m_k)

    A subclass is a frozen dataclass whose fields are plain data: it can be saved and compared. Its
    methods take NumPy and JAX arrays alike, so that the wrapper of an environment and the twin
    behind that wrapper run the same code. ``below`` are the signals of what it wraps.

    :param observed: whether the policy sees :math:`m_k`; without it the task is no longer Markov,
        and a twin infers the memory of the start of an episode
    """

    #: the name it is saved under
    name: ClassVar[str]
    #: whether the memory outlives the episode
    persists: ClassVar[bool] = False

    observed: bool = True

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            object.__setattr__(self, field.name, _hashable(getattr(self, field.name)))

    @abc.abstractmethod
    def remembers(self, below: Signals) -> tuple[Channel, ...]:
        """
        :return: one channel for each entry of the memory
        :raises ParameterError: if the transform does not fit what lies below
        """

    @abc.abstractmethod
    def act(
        self, action: OuterAction, obs: InnerObs, memory: Recalled, below: Signals
    ) -> tuple[InnerAction, Recalled]:
        """
        :param obs: what is observed below when the action is chosen
        :return: the command, and the memory after it
        """

    @abc.abstractmethod
    def start(self, obs: InnerObs, below: Signals) -> Recalled:
        """:return: the memory at the start of an episode that begins with ``obs``"""

    def cost(self, action: OuterAction, obs: InnerObs, memory: Recalled, below: Signals) -> Any:
        """:return: the penalty that is subtracted from the reward of this step"""
        return 0.0

    def actuators(self, below: Signals) -> tuple[Actuator, ...]:
        """:return: the actuators that the policy commands"""
        return below.actuators

    def channels(self, below: Signals) -> tuple[Channel, ...]:
        """:return: the channels that the policy sees"""
        remembered = self.remembers(below)
        return below.channels + remembered if self.observed else below.channels

    def draw(
        self, key: PRNGKeyArray, obs: Float[Array, " obs"], below: Signals
    ) -> Float[Array, " memory"]:
        """:return: a memory that an episode of a twin may begin with"""
        return self.start(obs, below)

    def observe(self, obs: InnerObs, memory: Recalled) -> Seen:
        """:return: what the policy sees"""
        return namespace(obs).concatenate([obs, memory]) if self.observed else obs

    def infer(self, seen: Seen, below: Signals) -> tuple[InnerObs, Recalled]:
        """:return: the observation below and the memory; see ``observed``"""
        obs = seen[: len(below.channels)]
        return obs, seen[len(below.channels) :] if self.observed else self.start(obs, below)

    def refuse_unless(self, field: str, allowed: bool, wanted: str) -> None:
        """:raises ParameterError: naming the field, what it may be and what it is"""
        if not allowed:
            raise ParameterError(
                f"{type(self).__name__}({field}={getattr(self, field)!r}): {field} must be "
                f"{wanted}."
            )


def like(array: Any, values: Any) -> Any:
    """:return: the values as an array of the same library, in the same precision"""
    return namespace(array).asarray(np.asarray(values), dtype=array.dtype)


def namespace(array: Any) -> Any:
    """:return: ``numpy`` or ``jax.numpy``, wherever the array is from"""
    return array.__array_namespace__()


def _hashable(value: Any) -> Any:
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    return tuple(map(_hashable, value)) if isinstance(value, list | tuple) else value
