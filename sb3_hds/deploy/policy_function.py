"""What a policy computes where nothing is explored, as a pure function of its memory, too."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple, Self

import numpy as np
from jaxtyping import Array, Float


class Memory(NamedTuple):
    """
    What a policy carries from one step to the next.

    :param name: of the input; that of the output is ``next_<name>``
    :param initial: at the start of an episode, shape ``(n,)``
    """

    name: str
    initial: np.ndarray


class Joints(NamedTuple):
    """
    Joints that a policy reads from the machine, beside the observation.

    :param position: of each, its entry in ``qpos`` followed by ``qvel``
    :param velocity: likewise
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
    A policy's method ``policy_function`` returns one; exporting asks nothing else of it.

    :param act: observations, flat, choices one-hot; positions and velocities of the joints where
        ``joints`` names some, otherwise nothing; the memory. To actions, and the memory after them
    :param squashed: whether actions are within [-1, 1] and stand for the range of the action space;
        otherwise they are in its units, and are clipped to it
    :param memory: one entry for each array of the memory
    :param joints: that the policy reads beside the observation
    :param scales: mean and standard deviation of the flat observations that it met, where it knows
        them: a file is compared on observations of that size
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
        :param scales: see above
        """
        return cls(lambda obs, joints, memory: (act(obs), memory), squashed, scales=scales)
