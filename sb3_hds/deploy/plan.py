"""What an exported file computes: layers around the environment, normalisation, policy."""

from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces

from sb3_hds.core import Signals
from sb3_hds.core.transforms.base import StatefulTransform
from sb3_hds.deploy.observations import (
    SINGLE,
    Normalization,
    Port,
    flat,
    normalized,
    observation_ports,
    parts_of,
)
from sb3_hds.deploy.policy_function import Joints, Memory, PolicyFunction
from sb3_hds.errors import ExportError
from sb3_hds.wrappers import CPGPrior
from sb3_hds.wrappers.action_layer import TransformLayer

# They change neither observations nor commands; PatchedTimeLimit is RL Zoo's.
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
    A wrapper inside the file.

    :param name: of its memory in the file
    :param transform: from its actions to commands
    :param below: signals of the environment below it
    :param memory: initial value in an episode
    :param action_space: of the environment below it
    :param joints: that it reads from the robot; None: none
    """

    name: str
    transform: StatefulTransform
    below: Signals
    memory: np.ndarray
    action_space: gymnasium.spaces.Box
    joints: Joints | None


class Stack(NamedTuple):
    """
    The wrappers between a policy and the environment.

    :param layers: inside the file, the outermost first
    :param observation_space: below the innermost layer
    :param action_space: below the innermost layer
    :param outside: wrappers further in, which are not in the file
    """

    layers: tuple[Layer, ...]
    observation_space: gymnasium.Space
    action_space: gymnasium.Space
    outside: tuple[str, ...]


class Plan(NamedTuple):
    """
    What a file computes.

    :param policy: with the interface of SB3
    :param function: what it computes; None for a torch policy
    :param stack: wrappers between it and the environment
    :param by: normalisation of its observations, by key
    """

    policy: Any
    function: PolicyFunction | None
    stack: Stack
    by: Mapping[str, Normalization]

    @property
    def memory(self) -> tuple[Memory, ...]:
        own = self.function.memory if self.function else ()
        return (*own, *(Memory(layer.name, layer.memory) for layer in self.stack.layers))

    @property
    def joints(self) -> Joints | None:
        """Those of the innermost layer that reads some, or else of the policy."""
        layers = (layer.joints for layer in reversed(self.stack.layers) if layer.joints)
        return next(layers, self.function.joints if self.function else None)


def checked_stack(stack: Stack, env: gymnasium.Env, policy: Any) -> Stack:
    """
    :return: the stack, with the spaces of the policy if it has no layers
    :raises ExportError: for an environment with other spaces than the policy
    """
    seen, commanded = env.observation_space, env.action_space
    fits = spaces.flatdim(seen) == spaces.flatdim(policy.observation_space)
    if not fits or commanded.shape != policy.action_space.shape:
        raise ExportError(
            f"The policy sees {policy.observation_space} and acts in {policy.action_space}, but "
            f"the environment has {seen} and {commanded}. Pass env= with all wrappers of the "
            "training."
        )
    if stack.layers:
        return stack
    return stack._replace(
        observation_space=policy.observation_space, action_space=policy.action_space
    )


def function_of(policy: Any) -> PolicyFunction | None:
    """
    :return: the function of a JAX policy; None for a torch policy
    :raises ExportError: for a policy that cannot be exported
    """
    from stable_baselines3.common.policies import BasePolicy

    if hasattr(policy, "policy_function"):
        return policy.policy_function()
    from sbx.common.policies import BaseJaxPolicy

    if isinstance(policy, BaseJaxPolicy):

        def of_one(obs: Any) -> Any:
            return policy._predict(obs[None], deterministic=True)[0]

        # TensorFlow Probability does not support a batch of symbolic size.
        return PolicyFunction.without_memory(jax.vmap(of_one), squashed=policy.squash_output)
    if not isinstance(policy, BasePolicy):
        raise ExportError(
            f"A model or a policy of ours, of SBX or of Stable-Baselines3 can be exported, got "
            f"{type(policy).__name__}."
        )
    if hasattr(policy, "lstm_actor"):
        raise ExportError("Recurrent policies of sb3-contrib cannot be exported.")
    return None


def ports_of(plan: Plan) -> dict[str, Port]:
    """Inputs by key of the observation; joints and memory by name."""
    double = bool(plan.memory)
    kind = "float64" if double else "float32"
    ports = observation_ports(plan.stack.observation_space, double)
    if plan.joints is not None:
        n = len(plan.joints.position)
        for name in ("joint_position", "joint_velocity"):
            ports[name] = Port(name, (n,), kind)
    for part in plan.memory:
        ports[part.name] = Port(part.name, part.initial.shape, kind)
    return ports


def compute(plan: Plan, names: tuple[str, ...], *inputs: Any) -> tuple[Any, ...]:
    """The function in the file, of JAX arrays with a leading batch axis."""
    assert plan.function is not None
    named = dict(zip(names, inputs, strict=True))
    observed = {key: named[key] for key in parts_of(plan.stack.observation_space)}
    joints = ()
    if plan.joints is not None:
        joints = named["joint_position"], named["joint_velocity"]
    memory = tuple(named[part.name] for part in plan.memory)
    n_own = len(plan.function.memory)
    own, memories = memory[:n_own], memory[n_own:]
    below: list[Any] = []
    for layer, remembered in reversed(list(zip(plan.stack.layers, memories, strict=True))):
        below.insert(0, observed[SINGLE])
        if layer.transform.observed:
            observed = {SINGLE: jnp.concatenate([observed[SINGLE], remembered], -1)}
    seen = {key: normalized(values, plan.by.get(key)) for key, values in observed.items()}
    action, own = plan.function.act(flat(plan.policy.observation_space, seen), joints, own)
    action = _in_units(action, plan.policy.action_space, plan.function.squashed)
    after = []
    for layer, obs, remembered in zip(plan.stack.layers, below, memories, strict=True):
        act, read = jax.vmap(partial(apply_layer, layer)), joints if layer.joints else ()
        action, next_memory = act(action, obs, remembered, *read)
        after.append(next_memory)
    if isinstance(plan.stack.action_space, spaces.Box):
        action = action.astype(jnp.float32)
    return (action, *own, *after)


def _in_units(action: Any, space: spaces.Space, squashed: bool) -> Any:
    action = action.reshape(-1, *space.shape)  # type: ignore[misc]
    if not isinstance(space, spaces.Box):
        return action
    low, high = space.low, space.high
    if squashed:
        action = low + 0.5 * (jnp.clip(action, -1.0, 1.0) + 1.0) * (high - low)
    limited = np.isfinite(low).any() or np.isfinite(high).any()
    return jnp.clip(action, low, high) if limited else action


def apply_layer(layer: Layer, action: Any, obs: Any, memory: Any, *joints: Any) -> tuple[Any, Any]:
    """Command and next memory of a layer for one action, of JAX or NumPy."""
    transform: Any = layer.transform
    if layer.joints is None:
        return transform.act(action, obs, memory, layer.below)
    action = action.clip(-1.0, 1.0)
    target, next_memory = transform.target(action, memory)
    command = transform.command(action, target, *joints)
    return command.clip(*layer.below.limits()), next_memory


def stack_of(env: gymnasium.Env, inside: bool) -> Stack:
    """
    The outer wrappers with a :class:`~sb3_hds.core.StatefulTransform` as layers, the others by
    name.

    :param inside: whether layers go into the file
    :raises ExportError: for a layer whose initial memory depends on the observation
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
            f"{type(env).__name__} initialises its memory from observations or earlier commands, "
            "but the memory of a file starts from constants. Export without wrappers, "
            "layers=False, and wrap the environment where the policy runs."
        )
    name = transform.name if place == 0 else f"{transform.name}_{place}"
    return Layer(name, transform, below, np.asarray(memory), env.commands, _joints(env))


def _joints(env: Any) -> Joints | None:
    found = env._joints if isinstance(env, CPGPrior) else None
    if found is None:
        return None
    velocity = tuple((found.n_positions + found.velocity).tolist())
    return Joints(tuple(found.position.tolist()), velocity)
