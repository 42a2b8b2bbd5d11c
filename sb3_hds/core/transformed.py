"""A twin seen through a wrapper is again a twin."""

from collections.abc import Iterable, Mapping
from typing import Any

from jaxtyping import Array, Float, PRNGKeyArray

from sb3_hds.core.effect import NO_EFFECTS, Effect, EffectChain
from sb3_hds.core.transform import (
    TRANSFORMS,
    ActionTransform,
    ObservationTransform,
    Transform,
    transform_from_spec,
    transform_to_spec,
)
from sb3_hds.core.twin import State, Twin
from sb3_hds.core.types import Action, Flag, Obs, Params, Scalar, Tangent


class TransformedTwin(Twin):
    """
    A twin whose observations or actions pass through a wrapper. States, parameters and rewards are
    those of the twin below.

    Effects belong to the plant: :meth:`extend` attaches them to the twin below the wrapper, where
    commands and measurements have their physical units.

    :param base: the twin below
    :param observation: what happens to observations; None leaves them
    :param action: what happens to actions; None leaves them
    :raises ParameterError: if a transform does not fit the twin below
    """

    def __init__(
        self,
        base: Twin,
        *,
        observation: ObservationTransform | None = None,
        action: ActionTransform | None = None,
    ) -> None:
        self.base, self.observation, self.action = base, observation, action
        self._mirror(base)
        if observation is not None:
            self.channels = observation.channels(base.channels)
        if action is not None:
            self.actuators = action.actuators(base.actuators)

    def extend(self, *effects: Effect) -> "TransformedTwin":
        base = self._base_with_values().extend(*effects)
        return TransformedTwin(base, observation=self.observation, action=self.action)

    def without(self, *keys: str) -> "TransformedTwin":
        base = self._base_with_values().without(*keys)
        return TransformedTwin(base, observation=self.observation, action=self.action)

    def at_interval(self, dt: float, substeps: int) -> "TransformedTwin":
        base = self._base_with_values().at_interval(dt, substeps)
        return TransformedTwin(base, observation=self.observation, action=self.action)

    def initial(self, key: PRNGKeyArray, params: Params) -> State:
        return self.base.initial(key, params)

    def infer(self, obs: Obs, params: Params) -> State:
        if self.observation is not None:
            obs = self.observation.invert(obs, self.base.channels)
        return self.base.infer(obs, params)

    def observe(self, state: State, params: Params) -> Obs:
        obs = self.base.observe(state, params)
        if self.observation is not None:
            obs = self.observation.observe(obs, self.base.channels)
        return obs

    def step(
        self, state: State, action: Action, params: Params, effects: EffectChain = NO_EFFECTS
    ) -> State:
        return self.base.step(state, self.command(action), params, effects)

    def reward(self, state: State, action: Action, next_state: State, params: Params) -> Scalar:
        return self.base.reward(state, self.command(action), next_state, params)

    def planning_reward(
        self, state: State, action: Action, next_state: State, params: Params
    ) -> Scalar:
        return self.base.planning_reward(state, self.command(action), next_state, params)

    def terminated(self, state: State, params: Params) -> Flag:
        return self.base.terminated(state, params)

    def difference(self, state: State, reference: State) -> Tangent:
        return self.base.difference(state, reference)

    def retract(self, state: State, tangent: Tangent) -> State:
        return self.base.retract(state, tangent)

    def sketch(self, state: State, params: Params) -> Float[Array, "points 2"]:
        return self.base.sketch(state, params)

    def to_spec(self) -> dict[str, Any]:
        spec = self._base_with_values().to_spec()
        parts = (part for part in (self.observation, self.action) if part is not None)
        layer = [transform_to_spec(part) for part in parts]
        return spec | {"transforms": [*spec.get("transforms", ()), layer]}

    def structure(self) -> tuple[Any, ...]:
        return (type(self), self.base, self.observation, self.action)

    def __repr__(self) -> str:
        parts = (self._base_with_values(), self.observation, self.action)
        inside = ", ".join(repr(part) for part in parts if part is not None)
        return f"{type(self).__name__}({inside})"

    def command(self, action: Action) -> Action:
        """:return: what the twin below is told"""
        return action if self.action is None else self.action.apply(action, self.base.actuators)

    def _base_with_values(self) -> Twin:
        return self.base.with_parameters(**self.values).with_tensors(self.tensors)


def seen_through(
    base: Twin,
    layers: Iterable[Iterable[Mapping[str, Any]]],
    known: Iterable[type[Transform]] = TRANSFORMS,
) -> Twin:
    """
    Put a twin behind saved wrappers again.

    :param base: the twin below all of them
    :param layers: ``to_spec()["transforms"]``, the wrapper next to ``base`` first
    :param known: the classes among which transforms are found by name
    :raises ParameterError: if a transform is not among them, or does not fit the twin below
    """
    for layer in layers:
        observation, action = None, None
        for transform in (transform_from_spec(part, known) for part in layer):
            if isinstance(transform, ObservationTransform):
                observation = transform
            else:
                action = transform
        base = TransformedTwin(base, observation=observation, action=action)
    return base
