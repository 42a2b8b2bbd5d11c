"""Orientations as quaternions ``(w, x, y, z)``, and rotations as rotation vectors."""

import jax.numpy as jnp
from jaxtyping import Array, Float

# Squared angle [rad^2] below which two terms of the series of sine and cosine suffice.
_SMALL = 1e-8

Quaternion = Float[Array, "4"]
Turn = Float[Array, "3"]  # in the body's frame [rad]


def turned(q: Quaternion, turn: Turn) -> Quaternion:
    """:return: the orientation after a rotation, of length one"""
    squared = jnp.sum(turn**2)
    near = squared < _SMALL
    angle = jnp.sqrt(jnp.where(near, 1.0, squared))
    w = jnp.where(near, 1.0 - squared / 8.0, jnp.cos(0.5 * angle))
    vector = turn * jnp.where(near, 0.5 - squared / 48.0, jnp.sin(0.5 * angle) / angle)
    return _product(normalized(q), jnp.concatenate([w[None], vector]))


def turn_between(q: Quaternion, reference: Quaternion) -> Turn:
    """:return: the rotation from ``reference`` to ``q``, by pi at most"""
    relative = _product(reference * jnp.array([1.0, -1.0, -1.0, -1.0], q.dtype), normalized(q))
    relative = normalized(jnp.where(relative[0] < 0.0, -relative, relative))
    w, vector = relative[0], relative[1:]
    squared = jnp.sum(vector**2)
    near = squared < _SMALL
    sine = jnp.sqrt(jnp.where(near, 1.0, squared))
    return vector * jnp.where(near, 2.0 + squared / 3.0, 2.0 * jnp.arctan2(sine, w) / sine)


def turning(q: Quaternion, change: Quaternion) -> Turn:
    """:return: the rotation by a small change of a quaternion of any length"""
    relative = _product(q * jnp.array([1.0, -1.0, -1.0, -1.0], q.dtype), change)
    return 2.0 * relative[1:] / jnp.sum(q**2)


def normalized(q: Quaternion) -> Quaternion:
    return q / jnp.sqrt(jnp.sum(q**2))


def _product(a: Quaternion, b: Quaternion) -> Quaternion:
    """The Hamilton product."""
    (aw, ax, ay, az), (bw, bx, by, bz) = a, b
    return jnp.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ]
    )
