"""
Integrators of ``dq/dt = v, dv/dt = a(q, v)`` over one sub-step, as in the mirrored environments.

An integrator takes the acceleration, ``q``, ``v``, the step size and a function that limits
velocities. Twins with quaternions also pass ``displace``, which moves a position by a velocity
times a time.
"""

import operator
from collections.abc import Callable
from typing import TypeAlias

import jax
import jax.numpy as jnp

from sb3_hds.core.types import Position, Velocity

Acceleration: TypeAlias = Callable[[Position, Velocity], Velocity]
LimitVelocity: TypeAlias = Callable[[Velocity], Velocity]
Displace: TypeAlias = Callable[[Position, Velocity], Position]
Integrator: TypeAlias = Callable[..., tuple[Position, Velocity]]


def semi_implicit_euler(
    acceleration: Acceleration,
    q: Position,
    v: Velocity,
    h: float,
    limit: LimitVelocity,
    displace: Displace = operator.add,
) -> tuple[Position, Velocity]:
    """Velocity first, then position with the new velocity. First order, symplectic."""
    v = limit(v + h * acceleration(q, v))
    return displace(q, h * v), v


def explicit_euler(
    acceleration: Acceleration,
    q: Position,
    v: Velocity,
    h: float,
    limit: LimitVelocity,
    displace: Displace = operator.add,
) -> tuple[Position, Velocity]:
    """Position with the old velocity. First order; gains energy in oscillations."""
    return displace(q, h * v), limit(v + h * acceleration(q, v))


def rk4(
    acceleration: Acceleration,
    q: Position,
    v: Velocity,
    h: float,
    limit: LimitVelocity,
    displace: Displace = operator.add,
) -> tuple[Position, Velocity]:
    """
    The classical Runge-Kutta method; MuJoCo's ``RK4`` is the same.

    The four stages are a loop: unrolled, they take four times as long to compile.
    """
    ahead = jnp.array([0.0, 0.5, 0.5, 1.0], v.dtype) * h
    weights = jnp.array([1.0, 2.0, 2.0, 1.0], v.dtype) * (h / 6.0)

    def stage(carry, at):
        q_dot, v_dot, displacement, v_new = carry
        delay, weight = at
        v_stage = v + delay * v_dot
        a = acceleration(displace(q, delay * q_dot), v_stage)
        return (v_stage, a, displacement + weight * v_stage, v_new + weight * a), None

    zero = jnp.zeros_like(v)
    (_, _, displacement, v_new), _ = jax.lax.scan(stage, (zero, zero, zero, v), (ahead, weights))
    return displace(q, displacement), limit(v_new)
