"""The deterministic policy as a pure function of observations and memory."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple, Self

import numpy as np
from jaxtyping import Array, Float


class Memory(NamedTuple):
    """
    State that a policy carries from one step to the next.

    :param name: of the input; the output is ``next_<name>``
    :param initial: value at the start of an episode, shape ``(n,)``
    """

    name: str
    initial: np.ndarray


class Joints(NamedTuple):
    """
    Joints that a policy reads from the robot in addition to the observation.

    :param position: index of each position in ``qpos`` followed by ``qvel``
    :param velocity: index of each velocity there
    """

    position: tuple[int, ...]
    velocity: tuple[int, ...]


Act = Callable[
    [
        Float[Array, "batch obs"],
        tuple[Float[Array, "batch act"], ...],
        tuple[Float[Array, "batch memory"], ...],
    ],
    tuple[Float[Array, "batch act"], tuple[Float[Array, "batch memory"], ...]],
]


@dataclasses.dataclass(frozen=True)
class PolicyFunction:
    """
    What ``policy_function``, a method of policies, returns for an export.

    :param act: from flat observations with one-hot choices, positions and velocities of the joints
        (an empty tuple without ``joints``) and the memory, to actions and the next memory
    :param squashed: whether actions are in [-1, 1] and scaled to the range of the action space;
        otherwise they are in its units, and are clipped to it
    :param memory: one entry for each array of the memory
    :param joints: read in addition to the observation; None: none
    :param scales: mean and standard deviation of the flat observations in training, if known: the
        file is checked on observations of that scale
    """

    act: Act
    squashed: bool
    memory: tuple[Memory, ...] = ()
    joints: Joints | None = None
    scales: tuple[np.ndarray, np.ndarray] | None = None

    @classmethod
    def without_memory(
        cls,
        act: Callable[[Any], Any],
        squashed: bool,
        scales: tuple[np.ndarray, np.ndarray] | None = None,
    ) -> Self:
        """
        :param act: flat observations, shape ``(batch, obs)``, to actions, shape ``(batch, act)``
        :param scales: as above
        """
        return cls(lambda obs, joints, memory: (act(obs), memory), squashed, scales=scales)
