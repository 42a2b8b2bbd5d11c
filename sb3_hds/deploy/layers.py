"""What lies between a policy and its environment: layers that go into the file, and the rest."""

from typing import Any, NamedTuple

import gymnasium
import numpy as np

from sb3_hds.core import Signals
from sb3_hds.core.transforms.base import StatefulTransform
from sb3_hds.deploy.policy_function import Joints
from sb3_hds.errors import ExportError
from sb3_hds.wrappers import CPGPrior
from sb3_hds.wrappers.action_layer import TransformLayer

# They change neither what is observed nor what is commanded; RL Zoo patches Gymnasium's limit.
_NEUTRAL = {
    "Monitor",
    "OrderEnforcing",
    "PassiveEnvChecker",
    "PatchedTimeLimit",
    "RealTime",
    "Record",
    "RecordEpisodeStatistics",
    "RecordVideo",
    "TimeLimit",
}


class Layer(NamedTuple):
    """
    :param name: of its memory in the file
    :param transform: what it does
    :param below: what lies below it
    :param memory: at the start of an episode
    :param action_space: of the environment below it
    :param joints: that it reads from the machine, where it does
    """

    name: str
    transform: StatefulTransform
    below: Signals
    memory: np.ndarray
    action_space: gymnasium.spaces.Box
    joints: Joints | None


class Stack(NamedTuple):
    """
    :param layers: from the policy inwards
    :param observation_space: below the innermost of them
    :param action_space: likewise
    :param outside: wrappers further in, which the file does not contain
    """

    layers: tuple[Layer, ...]
    observation_space: gymnasium.Space
    action_space: gymnasium.Space
    outside: tuple[str, ...]


def stack_of(env: gymnasium.Env, inside: bool) -> Stack:
    """
    Layers from the outside in, as far as they are :class:`~sb3_hds.core.StatefulTransform`.

    :param inside: whether they go into the file
    :raises ExportError: for a layer that begins each episode with what is observed there
    """
    layers: list[Layer] = []
    while isinstance(env, gymnasium.Wrapper):
        if isinstance(env, TransformLayer) and inside:
            layers.append(_layer(env, len(layers)))
        elif type(env).__name__ not in _NEUTRAL:
            break
        env = env.env
    outside, inner = [], env
    while isinstance(inner, gymnasium.Wrapper):
        if type(inner).__name__ not in _NEUTRAL:
            outside.append(type(inner).__name__)
        inner = inner.env
    return Stack(tuple(layers), env.observation_space, env.action_space, tuple(outside))


def _layer(env: TransformLayer, place: int) -> Layer:
    transform, below = env._transform, env._below
    n = len(below.channels)
    memory = transform.start(np.zeros(n), below)
    if transform.persists or not np.array_equal(memory, transform.start(np.ones(n), below)):
        raise ExportError(
            f"{type(env).__name__} begins an episode with what was observed or commanded before, "
            "and a file begins with constants. Export without wrappers, layers=False, and wrap the "
            "environment where the policy runs."
        )
    name = transform.name if place == 0 else f"{transform.name}_{place}"
    return Layer(name, transform, below, np.asarray(memory), env.commands, _joints(env))


def _joints(env: Any) -> Joints | None:
    found = env._joints if isinstance(env, CPGPrior) else None
    if found is None:
        return None
    velocity = tuple((found.n_positions + found.velocity).tolist())
    return Joints(tuple(found.position.tolist()), velocity)
