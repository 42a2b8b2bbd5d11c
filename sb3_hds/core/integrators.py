"""One sub-step of ``dq/dt = v, dv/dt = a(q, v)``, as the environments that twins mirror do it."""

from collections.abc import Callable
from typing import TypeAlias

from sb3_hds.core.types import Position, Velocity

Acceleration: TypeAlias = Callable[[Position, Velocity], Velocity]
LimitVelocity: TypeAlias = Callable[[Velocity], Velocity]
Integrator: TypeAlias = Callable[
    [Acceleration, Position, Velocity, float, LimitVelocity], tuple[Position, Velocity]
]


def semi_implicit_euler(
    acceleration: Acceleration, q: Position, v: Velocity, h: float, limit: LimitVelocity
) -> tuple[Position, Velocity]:
    """Velocity first, then position with the new velocity. First order, symplectic."""
    v = limit(v + h * acceleration(q, v))
    return q + h * v, v


def explicit_euler(
    acceleration: Acceleration, q: Position, v: Velocity, h: float, limit: LimitVelocity
) -> tuple[Position, Velocity]:
    """Position with the old velocity. First order; gains energy in oscillations."""
    return q + h * v, limit(v + h * acceleration(q, v))


def rk4(
    acceleration: Acceleration, q: Position, v: Velocity, h: float, limit: LimitVelocity
) -> tuple[Position, Velocity]:
    """The classical Runge-Kutta method; in joint coordinates MuJoCo's ``RK4`` is the same."""
    a1 = acceleration(q, v)
    v2 = v + 0.5 * h * a1
    a2 = acceleration(q + 0.5 * h * v, v2)
    v3 = v + 0.5 * h * a2
    a3 = acceleration(q + 0.5 * h * v2, v3)
    v4 = v + h * a3
    a4 = acceleration(q + h * v3, v4)
    q_new = q + h / 6.0 * (v + 2.0 * v2 + 2.0 * v3 + v4)
    v_new = v + h / 6.0 * (a1 + 2.0 * a2 + 2.0 * a3 + a4)
    return q_new, limit(v_new)
