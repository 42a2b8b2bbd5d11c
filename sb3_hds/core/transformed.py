"""A twin whose observations or actions pass through a wrapper."""

import dataclasses
from collections.abc import Iterable, Mapping
from typing import Any

import jax
from jaxtyping import Array, Float, PRNGKeyArray

from sb3_hds.core.effect import Effect
from sb3_hds.core.effect_chain import NO_EFFECTS, EffectChain
from sb3_hds.core.transforms.barrier import Barrier
from sb3_hds.core.transforms.base import (
    ActionTransform,
    ObservationTransform,
    Signals,
    StatefulTransform,
)
from sb3_hds.core.transforms.cpg import Rhythm
from sb3_hds.core.transforms.filters import Continuity, Delay, LowPass, RateLimit, Scale
from sb3_hds.core.transforms.history import History
from sb3_hds.core.transforms.rescale import RescaleAction, RescaleObservation
from sb3_hds.core.twin import Layer, State, Twin
from sb3_hds.core.types import Action, Memory, Obs, Params, Scalar
from sb3_hds.errors import ParameterError

Transform = ObservationTransform | ActionTransform | StatefulTransform

# Arguments of ``TransformedTwin``, and the transforms that they take.
_KINDS = {
    "observation": ObservationTransform,
    "action": ActionTransform,
    "stateful": StatefulTransform,
}

#: the transforms that saved data can name
TRANSFORMS: tuple[type[Transform], ...] = (
    RescaleAction,
    RescaleObservation,
    RateLimit,
    LowPass,
    Delay,
    Scale,
    History,
    Barrier,
    Continuity,
    Rhythm,
)


class TransformedTwin(Layer):
    """
    A twin whose observations or actions pass through a wrapper. Parameters, states and rewards are
    those of the wrapped twin; a stateful wrapper adds its memory and its penalty.

    Effects belong to the plant: :meth:`extend` attaches them to the wrapped twin, where commands
    and measurements have their physical units.

    :param base: the wrapped twin
    :param observation: transform of observations; None: identity
    :param action: transform of actions; None: identity
    :param stateful: transform of both, with memory or access to the observation; excludes the
        other two
    :raises ParameterError: if a transform does not fit the twin, or comes with another one
    """

    def __init__(
        self,
        base: Twin,
        *,
        observation: ObservationTransform | None = None,
        action: ActionTransform | None = None,
        stateful: StatefulTransform | None = None,
    ) -> None:
        if stateful is not None and (observation is not None or action is not None):
            raise ParameterError(
                f"{type(stateful).__name__} cannot be combined with other transforms: put one "
                "TransformedTwin into another."
            )
        self.base, self.observation, self.action = base, observation, action
        self.stateful = stateful
        self._copy_declarations(base)
        if stateful is not None:
            self._below = Signals(base.actuators, base.channels)
            self._key = f"{stateful.name} at {_depth(base)}"
            self.channels = stateful.channels(self._below)
            self.actuators = stateful.actuators(self._below)
        if observation is not None:
            self.channels = observation.channels(base.channels)
        if action is not None:
            self.actuators = action.actuators(base.actuators)

    def extend(self, *effects: Effect) -> "TransformedTwin":
        return self._with_base(self._base_with_values().extend(*effects))

    def without(self, *keys: str) -> "TransformedTwin":
        return self._with_base(self._base_with_values().without(*keys))

    def at_interval(self, dt: float, substeps: int) -> "TransformedTwin":
        return self._with_base(self._base_with_values().at_interval(dt, substeps))

    def initial(self, key: PRNGKeyArray, params: Params) -> State:
        state = self.base.initial(key, params)
        if self.stateful is None:
            return state
        obs = self.base.observe(state, params)
        drawn = self.stateful.draw(jax.random.fold_in(key, 1), obs, self._below)
        return self._with_memory(state, drawn)

    def infer(self, obs: Obs, params: Params) -> State:
        if self.stateful is not None:
            inside, memory = self.stateful.infer(obs, self._below)
            return self._with_memory(self.base.infer(inside, params), memory)
        if self.observation is not None:
            obs = self.observation.invert(obs, self.base.channels)
        return self.base.infer(obs, params)

    def observe(self, state: State, params: Params) -> Obs:
        obs = self.base.observe(state, params)
        if self.stateful is not None:
            return self.stateful.observe(obs, state.memory[self._key])
        if self.observation is not None:
            obs = self.observation.observe(obs, self.base.channels)
        return obs

    def step(
        self, state: State, action: Action, params: Params, effects: EffectChain = NO_EFFECTS
    ) -> State:
        command, memory = self._act(state, action, params)
        if self.stateful is None:
            return self.base.step(state, command, params, effects)
        inside = {key: own for key, own in state.memory.items() if key != self._key}
        after = self.base.step(state._replace(memory=inside), command, params, effects)
        return self._with_memory(after, memory)

    def reward(self, state: State, action: Action, next_state: State, params: Params) -> Scalar:
        command = self.command(state, action, params)
        reward = self.base.reward(state, command, next_state, params)
        return reward - self._cost(state, action, params)

    def planning_reward(
        self, state: State, action: Action, next_state: State, params: Params
    ) -> Scalar:
        command = self.command(state, action, params)
        reward = self.base.planning_reward(state, command, next_state, params)
        return reward - self._cost(state, action, params)

    def to_spec(self) -> dict[str, Any]:
        spec = self._base_with_values().to_spec()
        layer = [transform_to_spec(part) for part in self._parts()]
        return spec | {"transforms": [*spec.get("transforms", ()), layer]}

    def structure(self) -> tuple[Any, ...]:
        return (type(self), self.base, self.observation, self.action, self.stateful)

    def __repr__(self) -> str:
        inside = ", ".join(map(repr, (self._base_with_values(), *self._parts())))
        return f"{type(self).__name__}({inside})"

    def command(self, state: State, action: Action, params: Params) -> Float[Array, " inner"]:
        """:return: the command of the wrapped twin"""
        return self._act(state, action, params)[0]

    def _act(
        self, state: State, action: Action, params: Params
    ) -> tuple[Float[Array, " inner"], Memory]:
        if self.stateful is not None:
            obs = self.base.observe(state, params)
            return self.stateful.act(action, obs, state.memory[self._key], self._below)
        if self.action is not None:
            action = self.action.apply(action, self.base.actuators)
        return action, ()

    def _cost(self, state: State, action: Action, params: Params) -> Scalar | float:
        if self.stateful is None:
            return 0.0
        obs = self.base.observe(state, params)
        return self.stateful.cost(action, obs, state.memory[self._key], self._below)

    def _with_memory(self, state: State, memory: Memory) -> State:
        return state._replace(memory=state.memory | {self._key: memory})

    def _parts(self) -> list[Transform]:
        parts = (self.observation, self.action, self.stateful)
        return [part for part in parts if part is not None]

    def _with_base(self, base: Twin) -> "TransformedTwin":
        return TransformedTwin(
            base, observation=self.observation, action=self.action, stateful=self.stateful
        )


def transform_to_spec(transform: Transform) -> dict[str, Any]:
    """:return: plain data from which :func:`transform_from_spec` makes an equal transform"""
    fields = {f.name: getattr(transform, f.name) for f in dataclasses.fields(transform)}
    return {"transform": transform.name} | fields


def transform_from_spec(spec: Mapping[str, Any]) -> Transform:
    """
    :param spec: what :func:`transform_to_spec` returned
    :raises ParameterError: for the name of another transform
    """
    by_name = {transform.name: transform for transform in TRANSFORMS}
    if spec["transform"] not in by_name:
        raise ParameterError(
            f"A twin was saved with the unknown transform '{spec['transform']}'. Known transforms: "
            f"{', '.join(by_name)}."
        )
    fields = {name: value for name, value in spec.items() if name != "transform"}
    return by_name[spec["transform"]](**fields)


def seen_through(base: Twin, layers: Iterable[Iterable[Mapping[str, Any]]]) -> Twin:
    """
    Rebuild the saved wrappers around a twin.

    :param base: the innermost twin
    :param layers: ``to_spec()["transforms"]``, the innermost wrapper first
    :raises ParameterError: for another transform, or one that does not fit the twin
    """
    for layer in layers:
        parts = [transform_from_spec(part) for part in layer]
        placed: Any = {
            name: p for p in parts for name, kind in _KINDS.items() if isinstance(p, kind)
        }
        base = TransformedTwin(base, **placed)
    return base


def _depth(base: Twin) -> int:
    """Number of wrappers around the plant, which makes the keys of memories unique."""
    return 1 + _depth(base.base) if isinstance(base, TransformedTwin) else 0
