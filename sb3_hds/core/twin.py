"""The interface of all differentiable simulators."""

import abc
import copy
import math
from collections.abc import Collection, Iterator, Mapping
from numbers import Integral, Real
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple, TypeVar

import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PRNGKeyArray

from sb3_hds.core.declarations import Actuator, Channel, Joint, Parameter
from sb3_hds.core.effect import Effect
from sb3_hds.core.effect_chain import NO_EFFECTS, EffectChain
from sb3_hds.core.types import (
    Action,
    Coordinates,
    Flag,
    Memory,
    Obs,
    Params,
    Position,
    Scalar,
    Tangent,
    Velocity,
)
from sb3_hds.errors import EffectError, ParameterError, TwinError, did_you_mean

# Not `typing.Self`: the checks that the tests install on annotations cannot read it.
_Twin = TypeVar("_Twin", bound="Twin")


class State(NamedTuple):
    """
    The state of a simulation: with action and parameters, it determines the next step.

    :param q: generalised position [rad] or [m], shape ``(dof,)``; longer where quaternions are
        among its numbers
    :param v: generalised velocity [rad/s] or [m/s], shape ``(dof,)``
    :param memory: memories of the attached effects, by full name of the effect
    """

    q: Position
    v: Velocity
    memory: dict[str, Memory]


class Twin(abc.ABC):
    """
    A differentiable simulator of one system.

    Its methods are pure and unbatched (callers ``vmap``), and safe under ``jit``, ``vmap``,
    ``scan`` and forward-mode differentiation. Values of parameters are always passed in ``params``;
    a method never reads them from ``self``. Twins that differ only in them are therefore equal and
    share one compiled program.

    A subclass declares its signals and parameters as class attributes and implements the abstract
    methods. Mechanical systems with a mass matrix are shorter as an ``AnalyticTwin``.

    :param dt: control interval [s]; default: the class attribute
    :param substeps: internal steps per control interval; default: the class attribute
    :param settings: values of parameters and of the class's options, by name
    :raises ParameterError: for an unknown name, a value out of bounds, or an impossible step
    :raises TwinError: for a class without a name, or whose parameters are no ``Parameter``
    """

    name: str
    env_id: str | None = None
    dt: float
    substeps: int = 1
    joints: tuple[Joint, ...]
    actuators: tuple[Actuator, ...]
    channels: tuple[Channel, ...]
    parameters: Mapping[str, Parameter]
    max_episode_steps: int | None = None
    #: ``"reverse"``; ``"forward"``: only forward mode; ``"differences"``: a column costs a step
    differentiability: str = "reverse"
    #: False if the reward is flat almost everywhere: then override ``planning_reward``
    reward_has_gradient: bool = True
    #: (effect name, index of its place) -> {its parameter: the twin's parameter that it adds to, or
    #: multiplies if the effect's null is one}
    native_effects: Mapping[tuple[str, int], Mapping[str, str]] = {}
    #: parameters that are known exactly: a diagnosis does not suspect them, and a calibration
    #: estimates them only on request
    known_parameters: frozenset[str] = frozenset()
    #: structural choices with their defaults, set by keyword: ``{"goal": "stop"}``
    options: ClassVar[Mapping[str, Any]] = {}
    #: admissible values of options that take only a few: ``{"goal": ("stop", "hold")}``
    choices: ClassVar[Mapping[str, Collection[Any]]] = {}
    #: learned arrays of attached effects, by full name: pytrees that are passed in ``params``
    tensors: Mapping[str, Any] = MappingProxyType({})

    def __init__(
        self, *, dt: float | None = None, substeps: int | None = None, **settings: Any
    ) -> None:
        self._check_declared()
        dt = getattr(self, "dt", None) if dt is None else dt
        substeps = self.substeps if substeps is None else substeps
        whole = isinstance(substeps, Integral) and substeps >= 1
        if not (whole and isinstance(dt, Real) and 0.0 < dt < math.inf):
            raise ParameterError(
                f"{self.name} needs a finite dt > 0 s and at least one sub-step, got dt={dt!r}, "
                f"substeps={substeps!r}."
            )
        self.dt, self.substeps = float(dt), int(substeps)
        for option, default in self.options.items():
            setattr(self, option, settings.pop(option, default))
        for option, allowed in self.choices.items():
            if (value := getattr(self, option)) not in tuple(allowed):
                raise ParameterError(
                    f"{option} of {self.name} must be one of {', '.join(map(repr, allowed))}, got "
                    f"{value!r}."
                )
        self.values: dict[str, float] = {
            name: parameter.null for name, parameter in self.parameters.items()
        }
        self._set(settings)

    @property
    def params(self) -> Params:
        """The current values of all parameters, as every method takes them in ``params``."""
        return {**self.values, **self.tensors}

    def with_parameters(self: _Twin, **values: float) -> _Twin:
        """
        :param values: new values by full name, in the units of ``parameters``
        :return: a copy with these values, which compares equal: it shares compiled programs
        :raises ParameterError: for an unknown name or a value out of bounds
        """
        changed = copy.copy(self)
        changed.values = dict(self.values)
        changed._set(values)
        return changed

    def with_tensors(self: _Twin, tensors: Mapping[str, Any]) -> _Twin:
        """
        :param tensors: new arrays by full name, of the same shapes
        :return: a copy with these arrays, which compares equal
        :raises ParameterError: for an unknown name
        """
        unknown = set(tensors) - set(self.tensors)
        if unknown:
            raise ParameterError(
                f"{self.name} has no tensors named {', '.join(sorted(unknown))}. "
                f"It has: {', '.join(self.tensors) or 'none'}."
            )
        changed = copy.copy(self)
        changed.tensors = {**self.tensors, **tensors}
        return changed

    def at_interval(self, dt: float, substeps: int) -> "Twin":
        """
        :param dt: another control interval [s]
        :param substeps: internal steps per control interval
        :return: the same system, with the same values
        """
        changed = copy.copy(self)
        changed.dt, changed.substeps = float(dt), int(substeps)
        return changed

    def freed(self, names: Collection[str] | None = None) -> "Twin":
        """:return: the same system, with constants such as masses as parameters: these, or all"""
        return self

    def extend(self, *effects: Effect) -> "Twin":
        """:return: this twin with ``effects`` attached, in the order of the signal path"""
        from sb3_hds.core.extended import ExtendedTwin

        return ExtendedTwin(self, *effects)

    def without(self, *keys: str) -> "Twin":
        """
        :param keys: of attached effects, for example ``"viscous_friction.hinge"``
        :return: this twin without them
        :raises EffectError: if one is not attached
        """
        if keys:
            raise EffectError(f"{self.name} has no effect {', '.join(keys)} attached.")
        return self

    @classmethod
    def from_env(cls: type[_Twin], env: Any) -> _Twin:
        """
        Read the parameters that an environment was made with.

        :param env: an environment, wrapped or not; its ``unwrapped`` is read
        :return: a twin whose ``values`` are those of the environment
        """
        return cls()

    def typical_forces(self) -> tuple[float, ...]:
        """
        :return: the largest force of actuators and gravity on each joint at rest [N m] or [N], as a
            scale for effects; 0 if unknown
        """
        return (0.0,) * len(self.joints)

    @abc.abstractmethod
    def initial(self, key: PRNGKeyArray, params: Params) -> State:
        """Draw the state at the start of an episode."""

    @abc.abstractmethod
    def infer(self, obs: Obs, params: Params) -> State:
        """
        The state that corresponds to an observation: the inverse of :meth:`observe`.

        Unobserved parts are set to zero; the subclass documents which ones.
        """

    @abc.abstractmethod
    def observe(self, state: State, params: Params) -> Obs:
        """The observation, in the order of ``channels``."""

    @abc.abstractmethod
    def step(
        self, state: State, action: Action, params: Params, effects: EffectChain = NO_EFFECTS
    ) -> State:
        """
        Advance by one control interval ``dt``.

        :param action: in the units of the action space; clipped to it as the environment does
        :param effects: attached effects, evaluated at every sub-step
        """

    def reward(self, state: State, action: Action, next_state: State, params: Params) -> Scalar:
        """The reward of the environment for this step; zero without a task."""
        return jnp.zeros(())

    def planning_reward(
        self, state: State, action: Action, next_state: State, params: Params
    ) -> Scalar:
        """
        The objective of planning: the reward, or a smooth surrogate if that has no gradient.

        It counts up to and including the terminating step. If survival is the goal, it must be
        positive: otherwise planning learns to terminate early.
        """
        return self.reward(state, action, next_state, params)

    def terminated(self, state: State, params: Params) -> Flag:
        """Whether the state terminates the task; time limits do not count."""
        return jnp.zeros((), bool)

    def coordinates(self, q: Position) -> Coordinates:
        """:return: the position of each joint, for effects and reports; override for quaternions"""
        return q

    def difference(self, state: State, reference: State) -> Tangent:
        """
        :return: tangent vector from ``reference`` to ``state``: one number per joint for positions,
            likewise for velocities, then the memory; override for quaternions
        """
        return ravel_pytree(state)[0] - ravel_pytree(reference)[0]

    def retract(self, state: State, tangent: Tangent) -> State:
        """:return: ``state`` moved along ``tangent``; the inverse of :meth:`difference`"""
        flat, unravel = ravel_pytree(state)
        return unravel(flat + tangent)

    def sketch(self, state: State, params: Params) -> Float[Array, "points 2"]:
        """A line drawing for rendering [m]; by default a bar per joint, as high as its position."""
        base = jnp.arange(state.q.shape[0], dtype=state.q.dtype)
        zero = jnp.zeros_like(base)
        return jnp.stack(
            [jnp.stack([base, base, base], 1), jnp.stack([zero, state.q, zero], 1)], -1
        ).reshape(-1, 2)

    def to_spec(self) -> dict[str, Any]:
        """:return: plain data from which ``twins.from_spec`` makes this twin with these values"""
        options = {name: getattr(self, name) for name in self.options}
        return {
            "twin": self.name,
            "options": options | {"dt": self.dt, "substeps": self.substeps},
            "parameters": dict(self.values),
        }

    def same_values(self, other: "Twin") -> bool:
        """:return: whether both are equal, which ignores values, and have the same values, too"""
        return self == other and self.values == other.values

    def structure(self) -> tuple[Any, ...]:
        """The key of the compiled program: everything but the values of parameters."""
        return (type(self), self.dt, self.substeps, *(getattr(self, name) for name in self.options))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Twin) and self.structure() == other.structure()

    def __hash__(self) -> int:
        return hash(self.structure())

    def __repr__(self) -> str:
        values = ", ".join(f"{name}={value:g}" for name, value in self.values.items())
        return f"{type(self).__name__}({values})"

    def _check_declared(self) -> None:
        """Check the declarations that parameter values depend on."""
        kind = type(self).__name__
        if not isinstance(getattr(self, "name", None), str):
            raise TwinError(f"{kind} has no name. Write it into the class: name = 'MyTwin'.")
        declared = getattr(self, "parameters", None)
        entries = declared.values() if isinstance(declared, Mapping) else [declared]
        if not all(isinstance(entry, Parameter) for entry in entries):
            raise TwinError(
                f"{kind} must declare parameters as a dictionary of Parameter by name, {{}} where "
                f"there are none, got {declared!r}."
            )

    def _set(self, values: Mapping[str, Any]) -> None:
        for name, value in values.items():
            if name not in self.parameters:
                known = ", ".join(self.parameters) or "none"
                choices = f"; its options are: {', '.join(self.options)}" if self.options else ""
                meant = did_you_mean(name, (*self.parameters, *self.options, "dt", "substeps"))
                raise ParameterError(
                    f"{self.name} has no parameter '{name}'.{meant} Its parameters are: "
                    f"{known}{choices}."
                )
            self.values[name] = self.parameters[name].check(name, value)


class Layer(Twin):
    """
    Abstract: a twin around another one. By default it forwards to the inner twin, with the state
    and the parameters that :meth:`inner_state` and :meth:`inner_params` return.
    """

    base: Twin

    def inner_state(self, state: State) -> State:
        """:return: the state as the inner twin has it"""
        return state

    def inner_params(self, state: State, params: Params) -> Params:
        """:return: the parameters of the inner twin"""
        return params

    def typical_forces(self) -> tuple[float, ...]:
        return self.base.typical_forces()

    def coordinates(self, q: Position) -> Coordinates:
        return self.base.coordinates(q)

    def difference(self, state: State, reference: State) -> Tangent:
        return self.base.difference(state, reference)

    def retract(self, state: State, tangent: Tangent) -> State:
        return self.base.retract(state, tangent)

    def reward(self, state: State, action: Action, next_state: State, params: Params) -> Scalar:
        own = self.inner_params(state, params)
        return self.base.reward(self.inner_state(state), action, self.inner_state(next_state), own)

    def planning_reward(
        self, state: State, action: Action, next_state: State, params: Params
    ) -> Scalar:
        own = self.inner_params(state, params)
        return self.base.planning_reward(
            self.inner_state(state), action, self.inner_state(next_state), own
        )

    def terminated(self, state: State, params: Params) -> Flag:
        return self.base.terminated(self.inner_state(state), self.inner_params(state, params))

    def sketch(self, state: State, params: Params) -> Float[Array, "points 2"]:
        return self.base.sketch(self.inner_state(state), self.inner_params(state, params))

    def _copy_declarations(self, base: Twin) -> None:
        """Copy what this layer shares with the twin inside it."""
        self.name, self.env_id = base.name, base.env_id
        self.dt, self.substeps = base.dt, base.substeps
        self.joints, self.actuators, self.channels = base.joints, base.actuators, base.channels
        self.max_episode_steps = base.max_episode_steps
        self.differentiability = base.differentiability
        self.reward_has_gradient = base.reward_has_gradient
        self.parameters, self.values = base.parameters, dict(base.values)
        self.known_parameters, self.native_effects = base.known_parameters, base.native_effects
        self.tensors = dict(base.tensors)

    def _base_with_values(self) -> Twin:
        """The inner twin with the values and tensors that this layer has for it now."""
        values = {name: self.values[name] for name in self.base.parameters}
        tensors = {name: self.tensors[name] for name in self.base.tensors}
        return self.base.with_parameters(**values).with_tensors(tensors)


def layers_of(twin: Twin) -> Iterator[Twin]:
    """:return: the twin, the twin inside it, and so on down to the plant"""
    layer: Any = twin
    while layer is not None:
        yield layer
        layer = getattr(layer, "base", None)


def plant_of(twin: Twin) -> Twin:
    """:return: the innermost twin, without effects and wrappers"""
    *_, plant = layers_of(twin)
    return plant
