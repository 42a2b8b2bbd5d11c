"""Interfaces of transforms: the pure functions that wrappers apply to actions and observations."""

import abc
import dataclasses
from typing import Any, ClassVar, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from sb3_hds.core.declarations import Actuator, Channel
from sb3_hds.errors import ParameterError

# Arrays of NumPy or JAX; "outer" is the policy's side of a wrapper, "inner" the plant's side.
OuterAction: TypeAlias = Float[Any, " outer"]
InnerAction: TypeAlias = Float[Any, " inner"]
OuterObs: TypeAlias = Float[Any, " seen"]
InnerObs: TypeAlias = Float[Any, " obs"]
MemoryVector: TypeAlias = Float[Any, " memory"]


class Signals(NamedTuple):
    """
    The actuators and observation channels of an environment or a twin.

    :param actuators: one for each entry of the action
    :param channels: one for each entry of the observation
    """

    actuators: tuple[Actuator, ...]
    channels: tuple[Channel, ...]

    def limits(self) -> tuple[np.ndarray, np.ndarray]:
        """:return: smallest and largest commands, each of shape ``(n_act,)``"""
        return np.array([a.low for a in self.actuators]), np.array([a.high for a in self.actuators])

    def rest(self) -> np.ndarray:
        """
        :return: the admissible command nearest to zero, which counts as the command before an
            episode, shape ``(n_act,)``
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
    ``below`` are the channels of the wrapped twin.
    """

    #: the name it is saved under
    name: ClassVar[str]

    @abc.abstractmethod
    def channels(self, below: tuple[Channel, ...]) -> tuple[Channel, ...]:
        """
        :return: the channels of the policy's observation
        :raises ParameterError: if the transform does not fit the wrapped twin
        """

    @abc.abstractmethod
    def observe(
        self, obs: Float[Array, " inner"], below: tuple[Channel, ...]
    ) -> Float[Array, " outer"]:
        """:return: the observation of the policy"""

    @abc.abstractmethod
    def invert(
        self, obs: Float[Array, " outer"], below: tuple[Channel, ...]
    ) -> Float[Array, " inner"]:
        """:return: the observation of the wrapped twin; the inverse of :meth:`observe`"""


@dataclasses.dataclass(frozen=True)
class ActionTransform(abc.ABC):
    """
    Maps the action of the policy to the command of the wrapped twin.

    A subclass is a frozen dataclass whose fields are plain data: it can be saved and compared.
    ``below`` are the actuators of the wrapped twin.
    """

    #: the name it is saved under
    name: ClassVar[str]

    @abc.abstractmethod
    def actuators(self, below: tuple[Actuator, ...]) -> tuple[Actuator, ...]:
        """
        :return: the actuators that the policy commands
        :raises ParameterError: if the transform does not fit the wrapped twin
        """

    @abc.abstractmethod
    def apply(
        self, action: Float[Array, " outer"], below: tuple[Actuator, ...]
    ) -> Float[Array, " inner"]:
        """:return: the command of the wrapped twin"""


@dataclasses.dataclass(frozen=True, kw_only=True)
class StatefulTransform(abc.ABC):
    r"""
    A wrapper with memory :math:`m`, whose command :math:`u` may depend on the observation:

    .. math:: u_k, m_{k+1} = f(a_k, o_k, m_k), \qquad \text{observed: } (o_k, m_k)

    A subclass is a frozen dataclass whose fields are plain data: it can be saved and compared. Its
    methods take NumPy and JAX arrays alike, so that environments and twins run the same code.
    ``below`` are the signals of the wrapped environment or twin.

    :param observed: whether the policy observes :math:`m_k`; otherwise the task is not Markov, and
        a twin infers the memory of the start of an episode
    """

    #: the name it is saved under
    name: ClassVar[str]
    #: whether the memory is kept from one episode to the next
    persists: ClassVar[bool] = False

    observed: bool = True

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            object.__setattr__(self, field.name, _hashable(getattr(self, field.name)))

    @abc.abstractmethod
    def remembers(self, below: Signals) -> tuple[Channel, ...]:
        """
        :return: one channel for each entry of the memory
        :raises ParameterError: if the transform does not fit the signals below
        """

    @abc.abstractmethod
    def act(
        self, action: OuterAction, obs: InnerObs, memory: MemoryVector, below: Signals
    ) -> tuple[InnerAction, MemoryVector]:
        """
        :param obs: the observation below, from which the action was chosen
        :return: the command, and the memory after it
        """

    @abc.abstractmethod
    def start(self, obs: InnerObs, below: Signals) -> MemoryVector:
        """:return: the memory at the start of an episode that begins with ``obs``"""

    def cost(self, action: OuterAction, obs: InnerObs, memory: MemoryVector, below: Signals) -> Any:
        """:return: the penalty to subtract from the reward of this step"""
        return 0.0

    def actuators(self, below: Signals) -> tuple[Actuator, ...]:
        """:return: the actuators that the policy commands"""
        return below.actuators

    def channels(self, below: Signals) -> tuple[Channel, ...]:
        """:return: the channels of the policy's observation"""
        memory = self.remembers(below)
        return below.channels + memory if self.observed else below.channels

    def draw(
        self, key: PRNGKeyArray, obs: Float[Array, " obs"], below: Signals
    ) -> Float[Array, " memory"]:
        """:return: a random memory with which an episode of a twin begins"""
        return self.start(obs, below)

    def observe(self, obs: InnerObs, memory: MemoryVector) -> OuterObs:
        """:return: the observation of the policy"""
        return namespace(obs).concatenate([obs, memory]) if self.observed else obs

    def infer(self, seen: OuterObs, below: Signals) -> tuple[InnerObs, MemoryVector]:
        """:return: the observation below, and the memory; see ``observed``"""
        obs = seen[: len(below.channels)]
        return obs, seen[len(below.channels) :] if self.observed else self.start(obs, below)

    def refuse_unless(self, field: str, allowed: bool, wanted: str) -> None:
        """:raises ParameterError: with the field, its value and what it must be"""
        if not allowed:
            raise ParameterError(
                f"{type(self).__name__}({field}={getattr(self, field)!r}): {field} must be "
                f"{wanted}."
            )


def like(array: Any, values: Any) -> Any:
    """:return: the values as an array of the same library, in the same precision"""
    return namespace(array).asarray(np.asarray(values), dtype=array.dtype)


def namespace(array: Any) -> Any:
    """:return: ``numpy`` or ``jax.numpy``, by the type of the array"""
    return array.__array_namespace__()


def _hashable(value: Any) -> Any:
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    return tuple(map(_hashable, value)) if isinstance(value, list | tuple) else value
