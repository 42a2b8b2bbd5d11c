r"""
MuJoCo's actuators without internal state: motors, servos and DC motors.

All actuators of a kind are computed as one array. With their gears as the rows of :math:`T`,
lengths are :math:`T q`, speeds :math:`T v`, and generalised forces :math:`T^T f`.

Source: MuJoCo documentation, *Computation*, Actuation model; *MuJoCo DC motor model*, Google
DeepMind 2026, sections 1.1, 1.2 and 2.5.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sb3_hds.core import Action, Force, MassMatrix, Params, Position, Velocity
from sb3_hds.core.types import Coordinates
from sb3_hds.twins.mujoco.mechanism import BALL, FREE, Drive, Mechanism
from sb3_hds.twins.mujoco.rigid_body import algebra

Each = Float[Array, " drives"]


class Moving(NamedTuple):
    """The motion of the mechanism; ``coordinates`` has rotation vectors for ball joints."""

    q: Position
    coordinates: Coordinates
    v: Velocity


class Pull(NamedTuple):
    """
    :param force: of each actuator, before its gear
    :param by_speed: derivative of the force by the actuator's speed; 0 at a limit of the force
    :param gear: shape ``(drives, dof)``
    """

    force: Each
    by_speed: Each
    gear: Float[Array, "drives dof"]


class Actuation:
    """All actuators of a mechanism."""

    def __init__(self, mechanism: Mechanism) -> None:
        first = np.cumsum([0, *(len(drive.inputs) for drive in mechanism.drives)])
        numbered = list(zip(first.tolist(), mechanism.drives, strict=False))
        kinds = (("affine", _Servos), ("pid", _Servos), ("dcmotor", _Motors))
        found = ((made, [x for x in numbered if x[1].kind == kind]) for kind, made in kinds)
        self.kinds = [made(mechanism, drives) for made, drives in found if drives]
        limits = [
            link.force_limit or (-math.inf, math.inf) for link in mechanism.links for _ in link.dofs
        ]
        self.limits = np.array(limits) if np.isfinite(limits).any() else None

    def force(self, moving: Moving, command: Action, p: Params) -> Force:
        """:return: generalised force of all actuators"""
        total = jnp.zeros_like(moving.v)
        for pull in self._pulls(moving, command, p):
            total = total + pull.force @ pull.gear
        if self.limits is None:
            return total
        return jnp.clip(total, *self.limits.T.astype(total.dtype))

    def slope(self, moving: Moving, command: Action, p: Params) -> MassMatrix:
        """:return: derivative of the force by the velocity, for an implicit integrator"""
        total = jnp.zeros((moving.v.shape[0],) * 2, moving.v.dtype)
        for pull in self._pulls(moving, command, p):
            total = total + (pull.gear.T * pull.by_speed) @ pull.gear
        return total

    def _pulls(self, moving: Moving, command: Action, p: Params) -> list[Pull]:
        return [kind.pull(moving, command, p) for kind in self.kinds]


class _Drives:
    """
    Actuators of one kind.

    :param drives: after the index of their first command
    """

    def __init__(self, mechanism: Mechanism, drives: Sequence[tuple[int, Drive]]) -> None:
        self.drives = [drive for _, drive in drives]
        self.links = [mechanism.links[drive.link] for drive in self.drives]
        self.n = len(drives)
        self.gear = np.zeros((self.n, mechanism.n_v))
        for row, link, drive in zip(self.gear, self.links, self.drives, strict=True):
            row[list(link.dofs)] = drive.gear
        self.floating = np.array([link.kind == FREE for link in self.links])
        self.limits = np.array(
            [drive.force_limit or (-math.inf, math.inf) for drive in self.drives]
        ).T
        #: by name of the input: row of the drive, index among all commands, and limits
        self.inputs: dict[str, list[tuple[int, int, tuple[float, float]]]] = {}
        for row, (first, drive) in enumerate(drives):
            for j, (name, limits) in enumerate(zip(drive.inputs, drive.ranges, strict=True)):
                place = (row, first + j, limits or (-math.inf, math.inf))
                self.inputs.setdefault(name, []).append(place)

    def given(self, name: str, command: Action) -> Each:
        """:return: an input of each drive; zero for drives without it"""
        if name not in self.inputs:
            return jnp.zeros(self.n, command.dtype)
        rows, index, limits = zip(*self.inputs[name], strict=True)
        u = jnp.clip(command[np.array(index)], *np.array(limits, command.dtype).T)
        return u if len(rows) == self.n else jnp.zeros(self.n, u.dtype).at[np.array(rows)].set(u)

    def geared(self, moving: Moving) -> tuple[Any, Each, Each]:
        """:return: gears, lengths and speeds"""
        gear: Any = self.gear.astype(moving.v.dtype)
        for i, (link, drive) in enumerate(zip(self.links, self.drives, strict=True)):
            if drive.outer and link.quaternion:
                turning = np.array(link.dofs[-3:])
                rows = algebra.rotation(tuple(moving.q[link.quaternion]))
                axis = jnp.stack(
                    [jnp.sum(jnp.stack(x) * gear[i, turning]) for x in zip(*rows, strict=True)]
                )
                gear = jnp.asarray(gear).at[i, turning].set(axis)
        length = jnp.where(self.floating, 0.0, gear @ moving.coordinates)
        return gear, length, gear @ moving.v

    def of(self, p: Params, name: str, otherwise: Any, like: Array) -> Each:
        """:return: a parameter of each drive; its entry in ``otherwise`` if it has none"""
        return jnp.stack(
            [
                jnp.asarray(p.get(f"{drive.name}_{name}", number), like.dtype)
                for drive, number in zip(self.drives, otherwise, strict=True)
            ]
        )

    def limited(self, force: Each, by_speed: Each) -> tuple[Each, Each]:
        low, high = self.limits.astype(force.dtype)
        if not np.isfinite(self.limits).any():
            return force, by_speed
        held = (force <= low) | (force >= high)
        return jnp.clip(force, low, high), jnp.where(held, 0.0, by_speed)


class _Servos(_Drives):
    """A gain times the command, and a bias; both affine in length and speed."""

    def __init__(self, mechanism: Mechanism, drives: Sequence[tuple[int, Drive]]) -> None:
        super().__init__(mechanism, drives)
        self.gain, self.bias = (
            np.array([getattr(drive, name) for drive in self.drives]).T for name in ("gain", "bias")
        )
        # At a ball joint, targets that differ by full turns are the same.
        pairs = zip(self.links, self.drives, strict=True)
        turning = [link.kind == BALL and drive.role == "position" for link, drive in pairs]
        sizes = [math.hypot(*drive.gear) for drive in self.drives]
        self.period = np.where(turning, 2.0 * math.pi * np.array(sizes), 0.0)

    def pull(self, moving: Moving, command: Action, p: Params) -> Pull:
        gear, length, speed = self.geared(moving)
        (g0, g1, g2), (b0, b1, b2) = (x.astype(length.dtype) for x in (self.gain, self.bias))
        g0, b1, b2 = g0 + 0.0 * length, b1 + 0.0 * length, b2 + 0.0 * length
        roles = [drive.role for drive in self.drives]
        if "motor" in roles:
            g0 = self.of(p, "gain", g0, length)
        if "position" in roles:
            b1, g0 = (
                sign * self.of(p, "kp", sign * x, length) for sign, x in ((-1.0, b1), (1.0, g0))
            )
        if {"position", "velocity"} & set(roles):
            b2 = -self.of(p, "kv", -b2, length)
        if "velocity" in roles:
            g0 = jnp.where(np.array([role == "velocity" for role in roles]), -b2, g0)
        bias = b0 + b1 * length + b2 * speed
        if self.drives[0].kind == "pid":
            pos, vel, ff = (self.given(name, command) for name in ("pos", "vel", "ff"))
            force = bias - b1 * self._nearest(pos, length) - b2 * vel + ff
            return Pull(*self.limited(force, b2), gear)
        u = self._nearest(self.given("", command), length)
        force = (g0 + g1 * length + g2 * speed) * u + bias
        return Pull(*self.limited(force, g2 * u + b2), gear)

    def _nearest(self, target: Each, length: Each) -> Each:
        """The equivalent target nearest to the length."""
        if not self.period.any():
            return target
        period = np.where(self.period > 0.0, self.period, 1.0).astype(length.dtype)
        nearest = target - period * jnp.round((target - length) / period)
        return jnp.where(self.period > 0.0, nearest, target)


class _Motors(_Drives):
    r"""Torque :math:`K (V - K \omega) / R`, and the controller that sets the voltage, if any."""

    def __init__(self, mechanism: Mechanism, drives: Sequence[tuple[int, Drive]]) -> None:
        super().__init__(mechanism, drives)
        names = dict(self.drives[0].motor)
        self.motor = {name: np.array([dict(d.motor)[name] for d in self.drives]) for name in names}
        self.driven = np.array([bool({"pos", "vel", "ff"} & set(d.inputs)) for d in self.drives])

    def pull(self, moving: Moving, command: Action, p: Params) -> Pull:
        gear, length, speed = self.geared(moving)
        motor = {name: x.astype(length.dtype) for name, x in self.motor.items()}
        constant = self.of(p, "motorconst", motor["constant"], length)
        resistance = self.of(p, "resistance", motor["resistance"], length)
        voltage, by_speed = self.given("voltage", command), -constant
        if self.driven.any():
            pos, vel, ff = (self.given(name, command) for name in ("pos", "vel", "ff"))
            torque = motor["kp"] * (pos - length) + motor["kd"] * (vel - speed) + ff
            per_torque = resistance / jnp.where(self.driven, constant, 1.0)
            wanted = per_torque * torque + constant * speed
            supply = np.where(motor["supply"] > 0.0, motor["supply"], np.inf).astype(length.dtype)
            own = jnp.clip(wanted, -supply, supply)
            voltage = voltage + jnp.where(self.driven, own, 0.0)
            damped = constant - motor["kd"] * per_torque
            by_speed = by_speed + jnp.where(self.driven, damped, 0.0)
        gain = constant / resistance
        force = gain * (voltage - constant * speed)
        force, by_speed = self.limited(force, gain * by_speed)
        if motor["cogging"].any():
            phase = motor["poles"] * length + motor["phase"]
            force = force + motor["cogging"] * jnp.sin(phase)
        return Pull(force, by_speed, gear)
