"""A twin with effects attached."""

import dataclasses
import inspect
import math
from collections import Counter
from collections.abc import Collection
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray

from sb3_hds.core.declarations import Parameter
from sb3_hds.core.effect import ActionEffect, Effect, ForceEffect, SensorEffect
from sb3_hds.core.effect_chain import NO_EFFECTS, Attached, Chosen, EffectChain
from sb3_hds.core.transformed import TransformedTwin
from sb3_hds.core.twin import Layer, State, Twin
from sb3_hds.core.types import Action, Obs, Params, Scalar
from sb3_hds.errors import EffectError


class ExtendedTwin(Layer):
    """
    A twin plus effects. Parameters of an effect are named ``effect.place.parameter``, for example
    ``"viscous_friction.hinge.b"``.

    Where the base twin has a parameter for the same effect (``native_effects``), that parameter is
    changed instead: the effect's value is added, or multiplied if the effect's null is one.
    Extending an extended twin flattens.

    :param base: the twin to extend
    :param effects: effects to attach, in the order of the signal path
    :raises EffectError: for an effect that is attached twice at one place, or at an unknown place
    """

    def __init__(self, base: Twin, *effects: Effect) -> None:
        if isinstance(base, TransformedTwin):
            raise EffectError(
                "Effects must be attached to the plant, not to a TransformedTwin around it. Use "
                "twin.extend(*effects), which does that."
            )
        if isinstance(base, ExtendedTwin):
            base, effects = base._base_with_values(), (*base.effects_with_values(), *effects)
        if effects and "effects" not in inspect.signature(base.step).parameters:
            raise EffectError(
                f"{base.name} cannot be extended: its step takes no effects. Write "
                "step(self, state, action, params, effects=NO_EFFECTS), and use them there."
            )
        self.base = base
        self.attached = tuple(_attach(effect, base) for effect in effects)
        self.effects = tuple(a.effect for a in self.attached)
        counts = Counter(a.key for a in self.attached)
        if repeated := [key for key, count in counts.items() if count > 1]:
            raise EffectError(
                f"An effect can be attached once at each place; {', '.join(repeated)} was given "
                "more than once."
            )
        self._copy_declarations(base)
        for a in self.attached:
            for name, parameter in a.effect.parameters.items():
                full_name = f"{a.key}.{name}"
                self.parameters = {**self.parameters, full_name: _in_units_of(parameter, base, a)}
                self.values[full_name] = a.effect.values[name]
            own = {f"{a.key}.{name}": tree for name, tree in a.effect.tensors.items()}
            self.tensors = {**self.tensors, **own}
        self._native = tuple(
            a for a in self.attached if (a.effect.name, a.index) in base.native_effects
        )
        self._simulated = tuple(a for a in self.attached if a not in self._native)
        self._sensors = tuple(
            (a, a.effect) for a in self._simulated if isinstance(a.effect, SensorEffect)
        )

    def without(self, *keys: str) -> Twin:
        own = {a.key: _with_values(a, self.params) for a in self.attached}
        if unknown := [key for key in keys if key not in own]:
            raise EffectError(
                f"{self.name} has no effect {', '.join(unknown)} attached. It has: "
                f"{', '.join(own)}."
            )
        kept = [effect for key, effect in own.items() if key not in keys]
        base = self._base_with_values()
        return ExtendedTwin(base, *kept) if kept else base

    def at_interval(self, dt: float, substeps: int) -> "ExtendedTwin":
        base = self._base_with_values().at_interval(dt, substeps)
        return ExtendedTwin(base, *self.effects_with_values())

    def freed(self, names: Collection[str] | None = None) -> "ExtendedTwin":
        return ExtendedTwin(self._base_with_values().freed(names), *self.effects_with_values())

    def initial(self, key: PRNGKeyArray, params: Params) -> State:
        return self._with_memory(self.base.initial(key, self.base_params(params)), params)

    def infer(self, obs: Obs, params: Params) -> State:
        for a, sensor in reversed(self._sensors):
            obs = obs.at[a.index].set(sensor.invert(obs[a.index], a.own(params)))
        return self._with_memory(self.base.infer(obs, self.base_params(params)), params)

    def observe(self, state: State, params: Params) -> Obs:
        obs = self.base.observe(state, self.base_params(params))
        for a, sensor in self._sensors:
            reported = sensor.sense(obs[a.index], state.memory[a.key], self.dt, a.own(params))
            obs = obs.at[a.index].set(reported)
        return obs

    def step(
        self, state: State, action: Action, params: Params, effects: EffectChain = NO_EFFECTS
    ) -> State:
        effects = effects + EffectChain(self._simulated, params)
        state = self.base.step(state, action, self.base_params(params), effects)
        if not self._sensors:
            return state
        obs, memory = self.base.observe(state, self.base_params(params)), dict(state.memory)
        for a, sensor in self._sensors:
            own = a.own(params)
            memory[a.key] = sensor.advance(obs[a.index], memory[a.key], self.dt, own)
            reported = sensor.sense(obs[a.index], memory[a.key], self.dt, own)
            obs = obs.at[a.index].set(reported)
        return state._replace(memory=memory)

    def planning_reward(
        self, state: State, action: Action, next_state: State, params: Params
    ) -> Scalar:
        base = self.base_params(params)
        reward = self.base.planning_reward(state, action, next_state, base)
        for a in self._simulated:
            own = a.own(params)
            reward -= a.effect.uncertainty_penalty(self.base, state, action, base, own)
        return reward

    def inner_params(self, state: State, params: Params) -> Params:
        return self.base_params(params)

    def choose(self, keys: Collection[str]) -> Chosen:
        """
        :param keys: of effects, such as ``"viscous_friction.hinge"``
        :return: a choice of these force effects, for ``EffectChain((), {}, chosen)`` as an argument
            of ``step``
        """
        return Chosen.of(self._simulated, keys)

    def effects_with_values(self) -> tuple[Effect, ...]:
        """:return: the effects with the current values of the extended twin"""
        return tuple(_with_values(a, self.params) for a in self.attached)

    def to_spec(self) -> dict[str, Any]:
        effects = [effect.to_spec() for effect in self.effects_with_values()]
        return self._base_with_values().to_spec() | {"effects": effects}

    def structure(self) -> tuple[Any, ...]:
        return (type(self), self.base, tuple(a.key for a in self.attached), self.effects)

    def __repr__(self) -> str:
        parts = (self._base_with_values(), *self.effects_with_values())
        return f"{type(self).__name__}({', '.join(map(repr, parts))})"

    def base_params(self, params: Params) -> Params:
        """:return: parameters of the base twin, changed by the native effects"""
        own = {name: params[name] for name in self.base.parameters}
        for a in self._native:
            for name, target in self.base.native_effects[a.effect.name, a.index].items():
                added = a.effect.parameters[name]
                own[target] = with_native(own[target], params[f"{a.key}.{name}"], added)
        return own

    def _with_memory(self, state: State, params: Params) -> State:
        """Initialise the memory of every effect, in the dtype that ``scan`` needs throughout."""
        memory, dtype = {}, state.q.dtype
        for a in self._simulated:
            if isinstance(a.effect, ForceEffect | ActionEffect):
                memory[a.key] = a.effect.memory(self.base)
        obs = self.base.observe(state, self.base_params(params))
        for a, sensor in self._sensors:
            memory[a.key] = sensor.memory(obs[a.index], self.base)
            reported = sensor.sense(obs[a.index], memory[a.key], self.dt, a.own(params))
            obs = obs.at[a.index].set(reported)
        memory = jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), memory)
        return state._replace(memory=state.memory | memory)


def with_native(own: Any, value: Any, parameter: Parameter) -> Any:
    """
    :param own: value of the twin's parameter
    :param value: of the corresponding parameter of an effect
    :param parameter: that parameter
    :return: the sum of both values; their product if the null of the effect is one
    """
    return own * value if parameter.null == 1.0 else own + value


def _with_values(attached: Attached, params: Params) -> Effect:
    """The effect with its values and tensors from ``params``."""
    own, effect = attached.own(params), attached.effect
    tensors = {name: own.pop(name) for name in effect.tensors}
    return effect.with_values(**own).with_tensors(**tensors)


def _attach(effect: Effect, twin: Twin) -> Attached:
    """Resolve the joint, actuator or channel that an effect names."""
    places = {"joint": twin.joints, "actuator": twin.actuators, "channel": twin.channels}[
        effect.slot
    ]
    names = [place.name for place in places]
    index = names.index(effect.where) if effect.where in names else effect.where
    if not isinstance(index, int) or not 0 <= index < len(names):
        raise EffectError(
            f"Effect '{effect.name}' names {effect.slot} {effect.where!r}, but {twin.name} has: "
            f"{', '.join(f'{i} ({name})' for i, name in enumerate(names))}."
        )
    placed = effect.at(names[index]).fitted_to(twin)
    return Attached(f"{effect.name}.{names[index]}", placed, index)


def _in_units_of(parameter: Parameter, twin: Twin, attached: Attached) -> Parameter:
    """
    Convert units and scales, which effects declare for a rotary joint or a generic channel: scales
    of forces are relative to the typical force at the joint, those of commands to the largest one.
    """
    slot, index = attached.effect.slot, attached.index
    if slot == "joint":
        if parameter.unit == "N m":
            typical = twin.typical_forces()[index]
            parameter = dataclasses.replace(parameter, scale=parameter.scale * (typical or 1.0))
        return parameter.prismatic() if twin.joints[index].unit == "m" else parameter
    if parameter.unit == "channel unit":
        return dataclasses.replace(parameter, unit=twin.channels[index].unit)
    if parameter.unit == "command unit":
        actuator = twin.actuators[index]
        largest = max(abs(actuator.low), abs(actuator.high))
        scale = parameter.scale * (largest if 0.0 < largest < math.inf else 1.0)
        return dataclasses.replace(parameter, unit=actuator.unit, scale=scale)
    return parameter
