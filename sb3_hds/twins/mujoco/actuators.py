"""
Commands to forces, as MuJoCo's actuators have it: motors, servos and DC motors without memory.

Source: MuJoCo documentation, *Computation*, Actuation model; *MuJoCo DC motor model*, Google
DeepMind 2026, sections 1.1, 1.2 and 2.5.
"""

import math
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

from sb3_hds.core import Action, Params, Position, Velocity
from sb3_hds.twins.mujoco import scalars as s
from sb3_hds.twins.mujoco.mechanism import BALL, FREE, Drive, Link, Mechanism

_ALIGNED = (1.0, 0.0, 0.0, 0.0)


class Pull(NamedTuple):
    """
    What one actuator does.

    :param force: before the gear
    :param by_speed: its slope by the actuator's own speed; 0 where a limit holds the force
    :param gear: by degree of freedom of the link that it drives, shape ``(n,)``
    """

    force: Array
    by_speed: Array
    gear: Array


def pulls(
    mechanism: Mechanism, q: Position, v: Velocity, command: Action, p: Params
) -> list[Pull]:
    """:return: of each actuator"""
    found, first = [], 0
    for drive in mechanism.drives:
        link = mechanism.links[drive.link]
        given = command[first : first + len(drive.inputs)]
        first += len(drive.inputs)
        gear, length, speed = _transmission(drive, link, q, v)
        inputs = {
            name: u if limits is None else jnp.clip(u, *limits)
            for name, u, limits in zip(drive.inputs, given, drive.ranges, strict=True)
        }
        if drive.kind == "dcmotor":
            force, by_speed = _dc_motor(drive, inputs, length, speed, p)
        else:
            force, by_speed = _servo(drive, link, inputs, length, speed, p)
        if drive.force_limit is not None:
            low, high = drive.force_limit
            by_speed = jnp.where((force <= low) | (force >= high), 0.0, by_speed)
            force = jnp.clip(force, low, high)
        motor = dict(drive.motor)
        if motor.get("cogging"):
            phase = motor["poles"] * length + motor["phase"]
            force = force + motor["cogging"] * jnp.sin(phase)
        found.append(Pull(force, by_speed, gear))
    return found


def forces(mechanism: Mechanism, pulled: list[Pull], like: Velocity) -> Array:
    """:return: generalised force of all actuators, shape ``(dof,)``"""
    found: list[Any] = [jnp.zeros_like(like[0])] * mechanism.n_v
    for drive, pull in zip(mechanism.drives, pulled, strict=True):
        for i, dof in enumerate(mechanism.links[drive.link].dofs):
            found[dof] = found[dof] + pull.gear[i] * pull.force
    for link in mechanism.links:
        if link.force_limit is not None:
            found[link.v] = jnp.clip(found[link.v], *link.force_limit)
    return jnp.stack(found)


def _transmission(
    drive: Drive, link: Link, q: Position, v: Velocity
) -> tuple[Array, Array, Array]:
    """Gear by degree of freedom, length and speed of an actuator."""
    gear = jnp.asarray(drive.gear, q.dtype)
    moving = v[link.v : link.v + len(drive.gear)]
    if link.kind not in (BALL, FREE):
        return gear, gear[0] * q[link.q], gear[0] * moving[0]
    start = link.q + (3 if link.kind == FREE else 0)
    turn = q[start : start + 4]
    if drive.outer:
        rows = jnp.stack([jnp.stack(row) for row in s.rotation(tuple(turn))])
        gear = jnp.concatenate([gear[:-3], rows.T @ gear[-3:]])
    speed = jnp.sum(gear * moving)
    if link.kind == FREE:
        return gear, jnp.zeros_like(speed), speed
    away = s.turn_between(turn, jnp.asarray(_ALIGNED, q.dtype))
    return gear, jnp.sum(gear * away), speed


def _servo(
    drive: Drive, link: Link, inputs: dict[str, Array], length: Array, speed: Array, p: Params
) -> tuple[Array, Array]:
    """A gain times the command, and a bias; both affine in length and speed."""
    (g0, g1, g2), (b0, b1, b2) = drive.gain, drive.bias
    given = {name.removeprefix(f"{drive.name}_"): p[name] for name in _own(drive)}
    if drive.role == "position":
        b1, b2 = -given["kp"], -given["kv"]
        g0 = given["kp"]
    elif drive.role == "velocity":
        b2, g0 = -given["kv"], given["kv"]
    elif drive.role == "motor":
        g0 = given["gain"]
    bias = b0 + b1 * length + b2 * speed
    if drive.kind == "pid":
        wanted = _nearest(drive, link, inputs.get("pos", jnp.zeros_like(length)), length)
        force = bias - b1 * wanted - b2 * inputs.get("vel", 0.0) + inputs.get("ff", 0.0)
        return force, b2 + 0.0 * speed
    u = inputs[""]
    if drive.role == "position":
        u = _nearest(drive, link, u, length)
    force = (g0 + g1 * length + g2 * speed) * u + bias
    return force, g2 * u + b2 + 0.0 * speed


def _nearest(drive: Drive, link: Link, wanted: Array, length: Array) -> Array:
    """At a ball joint, targets that are whole turns apart are the same."""
    if link.kind != BALL:
        return wanted
    period = 2.0 * math.pi * math.sqrt(sum(g**2 for g in drive.gear))
    return wanted - period * jnp.round((wanted - length) / period)


def _dc_motor(
    drive: Drive, inputs: dict[str, Array], length: Array, speed: Array, p: Params
) -> tuple[Array, Array]:
    r"""Torque :math:`K (V - K \omega) / R`, and the controller that sets the voltage."""
    motor = dict(drive.motor)
    constant, resistance = p[f"{drive.name}_motorconst"], p[f"{drive.name}_resistance"]
    voltage, by_speed = jnp.zeros_like(length), -constant + 0.0 * speed
    if {"pos", "vel", "ff"} & set(inputs):
        torque = motor["kp"] * (inputs.get("pos", 0.0) - length)
        torque = torque + motor["kd"] * (inputs.get("vel", 0.0) - speed) + inputs.get("ff", 0.0)
        voltage = resistance / constant * torque + constant * speed
        by_speed = by_speed - motor["kd"] * resistance / constant + constant
        if motor["supply"] > 0.0:
            voltage = jnp.clip(voltage, -motor["supply"], motor["supply"])
    voltage = voltage + inputs.get("voltage", 0.0)
    gain = constant / resistance
    return gain * (voltage - constant * speed), gain * by_speed


def _own(drive: Drive) -> list[str]:
    names = {"motor": ("gain",), "position": ("kp", "kv"), "velocity": ("kv",)}
    return [f"{drive.name}_{name}" for name in names.get(drive.role, ())]
