"""
Vectors and matrices of three rows, component by component, with constants folded.

A constant component is a float; any other is an array of JAX or NumPy with one entry for each link.
Products with zero and one disappear from the program, so a planar mechanism costs as much as its
planar formulas, and XLA compiles element-wise operations only.
"""

import math
from collections.abc import Iterable, Sequence
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

#: a float, or an array
Number: TypeAlias = Any
Vector: TypeAlias = tuple[Number, Number, Number]
#: rows
Matrix: TypeAlias = tuple[Vector, Vector, Vector]
#: a symmetric matrix: xx, yy, zz, xy, xz, yz
Symmetric: TypeAlias = tuple[Number, Number, Number, Number, Number, Number]

ZERO: Vector = (0.0, 0.0, 0.0)
NOTHING: Symmetric = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
#: row and column of the entries of a symmetric matrix
PLACES = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))


def mul(a: Number, b: Number) -> Number:
    if isinstance(a, float):
        a, b = b, a
    if isinstance(b, float):
        if b == 0.0:
            return 0.0
        if b in (1.0, -1.0):
            return a if b == 1.0 else neg(a)
    return lax.mul(*_typed(a, b)) if _alike(a, b) else a * b


def add(a: Number, b: Number) -> Number:
    if isinstance(a, float) and a == 0.0:
        return b
    if isinstance(b, float) and b == 0.0:
        return a
    return lax.add(*_typed(a, b)) if _alike(a, b) else a + b


def sub(a: Number, b: Number) -> Number:
    if isinstance(a, float) and a == 0.0:
        return neg(b)
    if isinstance(b, float) and b == 0.0:
        return a
    return lax.sub(*_typed(a, b)) if _alike(a, b) else a - b


def neg(a: Number) -> Number:
    if isinstance(a, jax.Array):
        return lax.neg(a)
    return 0.0 if isinstance(a, float) and a == 0.0 else -a


def div(a: Number, b: Number) -> Number:
    return 0.0 if isinstance(a, float) and a == 0.0 else a / b


def total(numbers: Iterable[Number]) -> Number:
    found: Number = 0.0
    for number in numbers:
        found = add(found, number)
    return found


def vadd(*vectors: Sequence[Number]) -> Vector:
    return tuple(total(parts) for parts in zip(*vectors, strict=True))  # type: ignore[return-value]


def scale(s: Number, a: Sequence[Number]) -> Vector:
    return tuple(mul(s, x) for x in a)  # type: ignore[return-value]


def dot(a: Iterable[Number], b: Iterable[Number]) -> Number:
    return total(mul(x, y) for x, y in zip(a, b, strict=True))


def cross(a: Sequence[Number], b: Sequence[Number]) -> Vector:
    return (
        sub(mul(a[1], b[2]), mul(a[2], b[1])),
        sub(mul(a[2], b[0]), mul(a[0], b[2])),
        sub(mul(a[0], b[1]), mul(a[1], b[0])),
    )


def apply(m: Sequence[Sequence[Number]], v: Sequence[Number]) -> Vector:
    return dot(m[0], v), dot(m[1], v), dot(m[2], v)


def transpose(m: Sequence[Sequence[Number]]) -> Matrix:
    return tuple(zip(*m, strict=True))  # type: ignore[return-value]


def product(a: Sequence[Sequence[Number]], b: Sequence[Sequence[Number]]) -> Matrix:
    return tuple(apply(transpose(b), row) for row in a)  # type: ignore[return-value]


def full(s: Symmetric) -> Matrix:
    xx, yy, zz, xy, xz, yz = s
    return (xx, xy, xz), (xy, yy, yz), (xz, yz, zz)


def congruent(r: Sequence[Sequence[Number]], s: Symmetric) -> Symmetric:
    """:return: ``r s r^T``"""
    half = product(r, full(s))
    return tuple(dot(half[i], r[j]) for i, j in PLACES)  # type: ignore[return-value]


def sadd(a: Symmetric, b: Symmetric) -> Symmetric:
    return tuple(map(add, a, b))  # type: ignore[return-value]


def outer(a: Sequence[Number], b: Sequence[Number]) -> Symmetric:
    """:return: ``a b^T + b a^T``"""
    return tuple(add(mul(a[i], b[j]), mul(b[i], a[j])) for i, j in PLACES)  # type: ignore[return-value]


def sin(x: Number) -> Number:
    return math.sin(x) if isinstance(x, float) else _library(x).sin(x)


def cos(x: Number) -> Number:
    return math.cos(x) if isinstance(x, float) else _library(x).cos(x)


def exp(x: Number) -> Number:
    return math.exp(x) if isinstance(x, float) else _library(x).exp(x)


def gathered(numbers: Sequence[Number], dtype: Any) -> Number:
    """
    :param numbers: of each link
    :return: all numbers along a new last axis, or one float if all are the same float
    """
    if all(isinstance(x, float) for x in numbers):
        same = all(x == numbers[0] for x in numbers)
        return float(numbers[0]) if same else np.asarray(numbers, dtype)
    library = jnp if any(isinstance(x, jax.Array) for x in numbers) else np
    like = next(x for x in numbers if not isinstance(x, float))
    return library.stack(
        [library.full(like.shape, x, dtype) if isinstance(x, float) else x for x in numbers], -1
    )


def rotation(q: Sequence[Number]) -> Matrix:
    """:return: rotation to the outer frame, from a quaternion of any length but zero"""
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


def _alike(a: Number, b: Number) -> bool:
    """Whether an operation of ``jax.lax`` applies, which is traced in a fraction of the time."""
    if not (isinstance(a, jax.Array) or isinstance(b, jax.Array)):
        return False
    return isinstance(a, float) or isinstance(b, float) or np.shape(a) == np.shape(b)


def _typed(a: Number, b: Number) -> tuple[Number, Number]:
    """Both numbers, with floats in the precision of the other one."""
    a = b.dtype.type(a) if isinstance(a, float) else a
    return a, a.dtype.type(b) if isinstance(b, float) else b


def _library(x: Number) -> Any:
    return jnp if isinstance(x, jax.Array) else np
