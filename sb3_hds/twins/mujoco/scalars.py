"""
Vectors and matrices of three rows written out as scalars, with constants folded.

A number is a Python float where it is known when a program is traced, and otherwise a scalar of JAX
(or an array of NumPy, one entry per sample). Products with zero and one disappear from the program,
so that a planar arm costs what its planar formulas cost; a batch is left to XLA, which then sees
element-wise operations only.
"""

import math
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

#: a float, a scalar of JAX, or an array of NumPy
Number: TypeAlias = Any
Vector: TypeAlias = tuple[Number, Number, Number]
#: rows
Matrix: TypeAlias = tuple[Vector, Vector, Vector]
#: a symmetric matrix: xx, yy, zz, xy, xz, yz
Symmetric: TypeAlias = tuple[Number, Number, Number, Number, Number, Number]
#: w, x, y, z; of length one
Quaternion: TypeAlias = tuple[Number, Number, Number, Number]

ZERO: Vector = (0.0, 0.0, 0.0)
#: row and column of the entries of a symmetric matrix
PLACES = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
UNIT: Matrix = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))

# Squared angle [rad^2] below which the series of sine and cosine are exact to 1e-16.
_SMALL = 1e-8


def mul(a: Number, b: Number) -> Number:
    if isinstance(a, float):
        a, b = b, a
    if isinstance(b, float):
        if b == 0.0:
            return 0.0
        if b == 1.0:
            return a
        if b == -1.0:
            return neg(a)
    return lax.mul(a, b) if _traced(a, b) else a * b


def add(a: Number, b: Number) -> Number:
    if isinstance(a, float):
        a, b = b, a
    if isinstance(b, float) and b == 0.0:
        return a
    return lax.add(a, b) if _traced(a, b) else a + b


def sub(a: Number, b: Number) -> Number:
    if isinstance(b, float) and b == 0.0:
        return a
    if isinstance(a, float) and a == 0.0:
        return neg(b)
    return lax.sub(a, b) if _traced(a, b) else a - b


def neg(a: Number) -> Number:
    return 0.0 if isinstance(a, float) and a == 0.0 else lax.neg(a) if _traced(a) else -a


def div(a: Number, b: Number) -> Number:
    if isinstance(a, float) and a == 0.0:
        return 0.0
    return lax.div(a, b) if _traced(a, b) else a / b


def total(numbers: Any) -> Number:
    found: Number = 0.0
    for number in numbers:
        found = add(found, number)
    return found


def vadd(a: Vector, b: Vector) -> Vector:
    return add(a[0], b[0]), add(a[1], b[1]), add(a[2], b[2])


def vsub(a: Vector, b: Vector) -> Vector:
    return sub(a[0], b[0]), sub(a[1], b[1]), sub(a[2], b[2])


def scale(s: Number, a: Vector) -> Vector:
    return mul(s, a[0]), mul(s, a[1]), mul(s, a[2])


def dot(a: Any, b: Any) -> Number:
    return total(mul(x, y) for x, y in zip(a, b, strict=True))


def cross(a: Vector, b: Vector) -> Vector:
    return (
        sub(mul(a[1], b[2]), mul(a[2], b[1])),
        sub(mul(a[2], b[0]), mul(a[0], b[2])),
        sub(mul(a[0], b[1]), mul(a[1], b[0])),
    )


def apply(m: Matrix, v: Vector) -> Vector:
    return dot(m[0], v), dot(m[1], v), dot(m[2], v)


def transpose(m: Matrix) -> Matrix:
    return (m[0][0], m[1][0], m[2][0]), (m[0][1], m[1][1], m[2][1]), (m[0][2], m[1][2], m[2][2])


def product(a: Matrix, b: Matrix) -> Matrix:
    columns = transpose(b)
    return tuple(tuple(dot(row, column) for column in columns) for row in a)  # type: ignore[return-value]


def full(s: Symmetric) -> Matrix:
    xx, yy, zz, xy, xz, yz = s
    return (xx, xy, xz), (xy, yy, yz), (xz, yz, zz)


def congruent(r: Matrix, s: Symmetric) -> Symmetric:
    """:return: ``r s r^T``"""
    half = product(r, full(s))
    return tuple(dot(half[i], r[j]) for i, j in PLACES)  # type: ignore[return-value]


def sadd(a: Symmetric, b: Symmetric) -> Symmetric:
    return tuple(add(x, y) for x, y in zip(a, b, strict=True))  # type: ignore[return-value]


def sin(x: Number) -> Number:
    return lax.sin(x) if _traced(x) else math.sin(x) if isinstance(x, float) else np.sin(x)


def cos(x: Number) -> Number:
    return lax.cos(x) if _traced(x) else math.cos(x) if isinstance(x, float) else np.cos(x)


def exp(x: Number) -> Number:
    return lax.exp(x) if _traced(x) else math.exp(x) if isinstance(x, float) else np.exp(x)


def rotation(q: Quaternion) -> Matrix:
    """:return: of a quaternion of any length but zero: what turns a vector into the outer frame"""
    w, x, y, z = q
    s = div(2.0, dot(q, q))
    xx, yy, zz = (mul(s, mul(a, a)) for a in (x, y, z))
    xy, xz, yz = mul(s, mul(x, y)), mul(s, mul(x, z)), mul(s, mul(y, z))
    wx, wy, wz = (mul(s, mul(w, a)) for a in (x, y, z))
    return (
        (sub(sub(1.0, yy), zz), sub(xy, wz), add(xz, wy)),
        (add(xy, wz), sub(sub(1.0, xx), zz), sub(yz, wx)),
        (sub(xz, wy), add(yz, wx), sub(sub(1.0, xx), yy)),
    )


def turned(q: Any, turn: Any) -> Any:
    """
    :param q: quaternion, shape ``(4,)``
    :param turn: rotation vector in the body's frame [rad], shape ``(3,)``
    :return: the quaternion after that turn, of length one
    """
    q = q / jnp.sqrt(jnp.sum(q**2))
    squared = jnp.sum(turn**2)
    near = squared < _SMALL
    angle = jnp.sqrt(jnp.where(near, 1.0, squared))
    half = jnp.where(near, 0.5 - squared / 48.0, jnp.sin(0.5 * angle) / angle)
    w, vector = jnp.where(near, 1.0 - squared / 8.0, jnp.cos(0.5 * angle)), half * turn
    return _hamilton(q, jnp.concatenate([w[None], vector]))


def turn_between(q: Any, reference: Any) -> Any:
    """:return: the rotation vector [rad] that turns one quaternion into the other, in its frame"""
    conjugate = reference * jnp.array([1.0, -1.0, -1.0, -1.0], reference.dtype)
    difference = _hamilton(conjugate, q)
    difference = jnp.where(difference[0] < 0.0, -difference, difference)
    w, vector = difference[0], difference[1:]
    squared = jnp.sum(vector**2) / (w**2 + jnp.sum(vector**2))
    near = squared < _SMALL
    sine = jnp.sqrt(jnp.where(near, 0.5, jnp.sum(vector**2)))
    length = jnp.sqrt(w**2 + jnp.sum(vector**2))
    factor = jnp.where(
        near, (2.0 + squared / 3.0) / length, 2.0 * jnp.arctan2(sine, w) / sine
    )
    return factor * vector


def _hamilton(a: Any, b: Any) -> Any:
    (aw, ax, ay, az), (bw, bx, by, bz) = a, b
    return jnp.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ]
    )


def _traced(*numbers: Number) -> bool:
    """Whether XLA is to compute; the functions of ``lax`` are traced in half the time."""
    return any(isinstance(x, jax.Array) for x in numbers)
