"""
Effects: named physical extensions of a twin.

An effect sits at one of three places of the signal path: between command and plant
(``ActionEffect``), in the equation of motion (``ForceEffect``), or between plant and measurement
(``SensorEffect``). Action and force effects are evaluated at every internal sub-step, and may carry
memory from one to the next.
"""

import abc
import copy
from collections.abc import Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, TypeVar

import jax
import jax.numpy as jnp

from sb3_hds.core.declarations import Parameter
from sb3_hds.core.numerics.linear import solve_spd
from sb3_hds.core.types import (
    Action,
    Coordinates,
    Force,
    MassMatrix,
    Memory,
    Params,
    Scalar,
    Velocity,
)
from sb3_hds.errors import EffectError

if TYPE_CHECKING:
    from sb3_hds.core.twin import Twin


# Not `typing.Self`: the checks that the tests install on annotations cannot read it.
_Effect = TypeVar("_Effect", bound="Effect")


class Moment(NamedTuple):
    """
    The mechanical system at one evaluation of ``M a + load = actuator + effects``.

    :param q: position of each joint, shape ``(dof,)``
    :param v: generalised velocity, shape ``(dof,)``
    :param actuator: generalised force of the actuators, shape ``(dof,)``
    :param load: generalised force of gravity and inertia (``bias``), shape ``(dof,)``; zero where
        no effect uses it
    :param mass_matrix: shape ``(dof, dof)``
    :param h: length of the sub-step [s]
    """

    q: Coordinates
    v: Velocity
    actuator: Force
    load: Force
    mass_matrix: MassMatrix
    h: float


class JointMoment(NamedTuple):
    """
    The entries of a :class:`Moment` for one joint. All are scalars.

    :param q: position [rad] or [m]
    :param v: velocity [rad/s] or [m/s]
    :param actuator: force of the actuators on this joint [N m] or [N]
    :param load: force of gravity and inertia at this joint [N m] or [N]
    :param inertia: effective inertia, ``1 / (M^-1)_jj`` [kg m2] or [kg]; treated as constant in
        derivatives, because it only bounds the effect of one sub-step
    :param h: length of the sub-step [s]
    """

    q: Scalar
    v: Scalar
    actuator: Scalar
    load: Scalar
    inertia: Scalar
    h: float


class Ranges(NamedTuple):
    """
    The range that data of one joint or actuator cover, for grids of parameters.

    :param excursion: largest excursion of the joint [rad] or [m]
    :param speed: root mean square of its velocity [rad/s] or [m/s]
    :param command: root mean square of the command, in its unit
    :param largest: largest command
    :param dt: sampling interval [s]
    :param period: of the motion [s]
    :param turn: a full turn of a hinge [rad]; infinity for a slider
    """

    excursion: float
    speed: float
    command: float
    largest: float
    dt: float
    period: float
    turn: float


class Effect(abc.ABC):
    """
    A physical effect of real hardware that the twin lacks. It vanishes at its null parameters.

    :param where: index or name of the joint, actuator or channel that it acts on
    :param values: values of its parameters by name; default: their nulls
    :raises EffectError: for an unknown parameter
    :raises ParameterError: for a value out of bounds
    """

    name: ClassVar[str]
    #: ``"joint"``, ``"actuator"`` or ``"channel"``
    slot: ClassVar[str]
    #: units are those of a rotary joint; ``"command unit"`` and ``"channel unit"`` stand for the
    #: unit of the actuator or channel, and a scale in command units is a share of the largest
    #: command
    parameters: ClassVar[Mapping[str, Parameter]]
    #: one sentence for reports
    explanation: ClassVar[str]
    #: where the equation comes from
    source: ClassVar[str]
    #: aliased causes (data cannot distinguish them from this one) -> the condition for it; a cause
    #: is an effect, or a parameter of the twin: ``"parameter.mass"``
    equivalents: ClassVar[Mapping[str, str]] = {}
    #: parameters that must ascend in this order; otherwise a diagnosis does not report the effect
    ascending: ClassVar[tuple[str, ...]] = ()
    #: the only parameter of an effect that is nonlinear in it: equation errors are interpolated
    #: between its values in ``grid``
    interpolated: ClassVar[str] = ""
    #: a parameter that follows from the slopes at two of its values: the rest position of a spring,
    #: the phase of a wave
    blended: ClassVar[str] = ""
    #: time after which the initial value of its memory no longer matters [periods of the motion]
    forgets: ClassVar[float] = 0.4
    #: arguments of the constructor besides ``where`` and the parameters: attributes that are saved,
    #: and part of the key of a compiled program
    options: ClassVar[tuple[str, ...]] = ()
    #: learned arrays by name: pytrees that are passed along with the parameters
    tensors: Mapping[str, Any] = MappingProxyType({})

    def __init__(self, where: int | str = 0, **values: float) -> None:
        self.where = where
        self.values: dict[str, float] = {
            name: parameter.null for name, parameter in self.parameters.items()
        }
        self._set(values)

    def with_values(self: _Effect, **values: float) -> _Effect:
        """:return: a copy with new values, which compares equal: it shares compiled programs"""
        changed = copy.copy(self)
        changed.values = dict(self.values)
        changed._set(values)
        return changed

    def with_tensors(self: _Effect, **tensors: Any) -> _Effect:
        """:return: a copy with new arrays of the same shapes, which compares equal"""
        changed = copy.copy(self)
        changed.tensors = {**self.tensors, **tensors}
        return changed

    def fitted_to(self: _Effect, twin: "Twin") -> _Effect:
        """:return: the effect, set up for the twin that it is attached to"""
        return self

    def starts(self, excursion: float, speed: float) -> tuple[Mapping[str, float], ...]:
        """
        :param excursion: excursion of the joint in the data [rad] or [m], a turn at most
        :param speed: its speed there [rad/s] or [m/s]
        :return: initial values of a search by name, for parameters with a zero gradient at the null
            and many local optima; empty where one start suffices
        """
        return ()

    def grid(self, ranges: Ranges) -> tuple[Mapping[str, float], ...]:
        """
        :param ranges: the range of the data
        :return: values by name between which equation errors are interpolated
            (``interpolated``), or at which their slopes by the other parameters are taken; empty
            where the slopes at the null suffice
        """
        return self.starts(ranges.excursion, 2.0 * ranges.speed)

    def blend(
        self, sizes: tuple[float, float], settings: tuple[Mapping[str, float], Mapping[str, float]]
    ) -> dict[str, float]:
        """
        :param sizes: of the effect's first parameter in two settings that differ in ``blended``
        :param settings: values by name
        :return: values of the single effect that equals the sum of both
        """
        raise NotImplementedError(f"{self.name} is no combination of two settings.")

    def uncertainty_penalty(
        self, twin: "Twin", state: Any, action: Action, base: Params, own: Params
    ) -> Scalar:
        """
        :param twin: the twin that the effect is attached to
        :param base: parameters of that twin
        :param own: the effect's own parameters, without prefix
        :return: what planning subtracts from the reward where the effect is uncertain
        """
        return jnp.zeros(())

    def at(self: _Effect, where: int | str) -> _Effect:
        """:return: the same effect at another joint, actuator or channel"""
        moved = copy.copy(self)
        moved.where = where
        return moved

    def _set(self, values: Mapping[str, Any]) -> None:
        for name, value in values.items():
            if name not in self.parameters:
                raise EffectError(
                    f"Effect '{self.name}' has no parameter '{name}'. "
                    f"Its parameters are: {', '.join(self.parameters) or 'none'}."
                )
            self.values[name] = self.parameters[name].check(f"{self.name}.{name}", value)

    def to_spec(self) -> dict[str, Any]:
        """:return: plain data that describe the effect"""
        own = {name: getattr(self, name) for name in self.options}
        plain = {n: list(value) if isinstance(value, tuple) else value for n, value in own.items()}
        spec = {"effect": self.name, "where": self.where, "parameters": dict(self.values)}
        return spec | ({"options": plain} if plain else {})

    def structure(self) -> tuple[Any, ...]:
        """The key of the compiled program: everything but the values of parameters."""
        return (type(self), self.where, *(getattr(self, name) for name in self.options))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Effect) and self.structure() == other.structure()

    def __hash__(self) -> int:
        return hash(self.structure())

    def __repr__(self) -> str:
        values = "".join(f", {name}={value:g}" for name, value in self.values.items())
        return f"{type(self).__name__}({self.where!r}{values})"


class ForceEffect(Effect):
    """Adds a generalised force to the equation of motion."""

    slot: ClassVar[str] = "joint"
    #: whether it is evaluated once per sub-step, in the middle, instead of at every stage of the
    #: integrator; its memory then advances from there, too, so that force and memory agree
    held: ClassVar[bool] = False
    #: whether it depends on the load, or on derivatives of the mass matrix. If no evaluated effect
    #: does, the load is zero and the mass matrix has no derivative: both are expensive for robots
    #: with many joints
    uses_load: ClassVar[bool] = True

    def memory(self, twin: "Twin") -> Memory:
        """:return: the memory at the start of an episode; a pytree of float arrays"""
        return ()

    @abc.abstractmethod
    def force(self, moment: Moment, index: int, memory: Memory, params: Params) -> Force:
        """
        :param moment: the system at this evaluation of its equation of motion
        :param index: index of the joint that the effect acts on
        :param memory: as it was at the start of the sub-step
        :param params: the effect's own parameters, without prefix
        :return: generalised force on all joints, shape ``(dof,)``
        """

    def advance(self, moment: Moment, index: int, memory: Memory, params: Params) -> Memory:
        """
        :param moment: the system at the end of a sub-step; in its middle if the effect is held
        :return: the memory after that sub-step
        """
        return memory


class JointEffect(ForceEffect):
    """A force effect that depends on one joint and acts on that joint alone."""

    @abc.abstractmethod
    def torque(self, joint: JointMoment, memory: Memory, params: Params) -> Scalar:
        """:return: force on this joint [N m] or [N]"""

    def force(self, moment: Moment, index: int, memory: Memory, params: Params) -> Force:
        torque = self.torque(at_joint(moment, index), memory, params)
        return jnp.zeros_like(moment.v).at[index].set(torque)


class ActionEffect(Effect):
    """Changes one command on its way to the plant."""

    slot: ClassVar[str] = "actuator"

    def memory(self, twin: "Twin") -> Memory:
        """:return: the memory at the start of an episode; a pytree of float arrays"""
        return ()

    @abc.abstractmethod
    def act(
        self, command: Scalar, memory: Memory, h: float, params: Params
    ) -> tuple[Scalar, Memory]:
        """
        :param command: of this actuator, in its unit
        :param memory: as it was at the start of the sub-step
        :param h: length of the sub-step [s]
        :param params: the effect's own parameters, without prefix
        :return: the command that reaches the plant during the sub-step, and the memory after it
        """


class SensorEffect(Effect):
    """
    Changes one measurement on its way out of the plant, once per control interval.

    Several effects at one channel act in sequence. Reported values may exceed the limits that the
    channel declares.
    """

    slot: ClassVar[str] = "channel"

    def memory(self, measured: Scalar, twin: "Twin") -> Memory:
        """:return: the memory at the start of an episode; a pytree of float arrays"""
        return ()

    @abc.abstractmethod
    def sense(self, measured: Scalar, memory: Memory, dt: float, params: Params) -> Scalar:
        """
        :param measured: the true value, in the unit of the channel
        :param memory: from ``memory`` or ``advance``, which were called with ``measured``, too
        :param dt: length of the control interval [s]
        :param params: the effect's own parameters, without prefix
        :return: the reported value
        """

    @abc.abstractmethod
    def invert(self, reported: Scalar, params: Params) -> Scalar:
        """:return: the best estimate of the true value from the first report of an episode"""

    def advance(self, measured: Scalar, memory: Memory, dt: float, params: Params) -> Memory:
        """:return: the memory after a control interval that ends with the value ``measured``"""
        return memory


def at_joint(moment: Moment, index: int) -> JointMoment:
    """:return: the entries for the joint ``index``"""
    unit = jnp.zeros_like(moment.v).at[index].set(1.0)
    matrix = jax.lax.stop_gradient(moment.mass_matrix)
    inertia = 1.0 / solve_spd(matrix, unit)[index]
    return JointMoment(
        moment.q[index],
        moment.v[index],
        moment.actuator[index],
        moment.load[index],
        inertia,
        moment.h,
    )
