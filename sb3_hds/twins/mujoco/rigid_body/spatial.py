"""
Spatial vectors: motions, forces and inertias of all joints or bodies at once.

Numbers are arrays whose last axis is the joint or the body, or floats if all are equal.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sb3_hds.twins.mujoco.rigid_body import algebra as alg
from sb3_hds.twins.mujoco.rigid_body.algebra import Matrix, Number, Symmetric, Vector


class Motion(NamedTuple):
    """A spatial velocity or acceleration."""

    angular: Vector
    linear: Vector


class Wrench(NamedTuple):
    """A spatial force or momentum."""

    torque: Vector
    force: Vector


class Inertia(NamedTuple):
    """
    :param mass: [kg]
    :param first_moment: mass times the centre of mass [kg m]
    :param second_moments: of mass, about the origin [kg m2]
    """

    mass: Number
    first_moment: Vector
    second_moments: Symmetric


class Body(NamedTuple):
    """
    A rigid body in the frame of its link.

    :param mass: [kg]
    :param centre: of mass [m]
    :param second_moments: of mass, about the centre [kg m2]
    """

    mass: Number
    centre: Vector
    second_moments: Symmetric


def rotation_about(axis: Vector, origin: Vector) -> Motion:
    """:return: the motion of a body that rotates at 1 rad/s about an axis through ``origin``"""
    return Motion(axis, alg.cross(origin, axis))


def cross(a: Motion, b: Motion) -> Motion:
    """:return: the cross product of two motions"""
    mixed = alg.vadd(alg.cross(a.angular, b.linear), alg.cross(a.linear, b.angular))
    return Motion(alg.cross(a.angular, b.angular), mixed)


def cross_force(a: Motion, b: Wrench) -> Wrench:
    """:return: the cross product of a motion and a force"""
    torque = alg.vadd(alg.cross(a.angular, b.torque), alg.cross(a.linear, b.force))
    return Wrench(torque, alg.cross(a.angular, b.force))


def momentum_of(inertia: Inertia, motion: Motion) -> Wrench:
    """:return: the momentum of a moving inertia; for an acceleration, the force"""
    angular, h = motion.angular, inertia.first_moment
    trace = alg.total(inertia.second_moments[:3])
    second = alg.apply(alg.full(inertia.second_moments), angular)
    own = alg.vadd(alg.scale(trace, angular), alg.scale(-1.0, second))
    return Wrench(
        alg.vadd(own, alg.cross(h, motion.linear)),
        alg.vadd(alg.scale(inertia.mass, motion.linear), alg.cross(angular, h)),
    )


class Coriolis(NamedTuple):
    r"""
    :math:`B` of a body with linear momentum :math:`l`: a motion :math:`(\alpha, \beta)` becomes the
    torque :math:`-2 D \alpha` and the force :math:`2 \alpha \times l`.
    """

    matrix: Matrix
    momentum: Vector


def coriolis_of(inertia: Inertia, velocity: Motion) -> Coriolis:
    r""":math:`D = [\omega] \Sigma + u h^T - (h \cdot u) 1`"""
    w, u, h = velocity.angular, velocity.linear, inertia.first_moment
    columns = [alg.cross(w, column) for column in alg.full(inertia.second_moments)]
    diagonal = alg.neg(alg.dot(h, u))

    def entry(i: int, j: int) -> Number:
        own = alg.add(columns[j][i], alg.mul(u[i], h[j]))
        return alg.add(own, diagonal) if i == j else own

    x, y, z = ((entry(i, 0), entry(i, 1), entry(i, 2)) for i in range(3))
    return Coriolis((x, y, z), momentum_of(inertia, velocity).force)


def coriolis_wrench(coriolis: Coriolis, motion: Motion) -> Wrench:
    torque = alg.scale(-2.0, alg.apply(coriolis.matrix, motion.angular))
    return Wrench(torque, alg.scale(2.0, alg.cross(motion.angular, coriolis.momentum)))


def coriolis_transposed(coriolis: Coriolis, motion: Motion) -> Vector:
    """The first three numbers of the transpose; the others are zero."""
    back = alg.apply(alg.transpose(coriolis.matrix), motion.angular)
    force = alg.cross(coriolis.momentum, motion.linear)
    return alg.scale(2.0, alg.vadd(force, alg.scale(-1.0, back)))


def placed(body: Body, rotation: Matrix, origin: Vector) -> Inertia:
    """:return: inertia about the common point, in the axes of the world"""
    centre = alg.vadd(origin, alg.apply(rotation, body.centre))
    first = alg.scale(body.mass, centre)
    own = alg.congruent(rotation, body.second_moments)
    return Inertia(body.mass, first, alg.sadd(own, alg.outer(first, alg.scale(0.5, centre))))


def numbers_of(tree: Any) -> list[Number]:
    """:return: the numbers of tuples of tuples, in order"""
    return [x for part in tree for x in (numbers_of(part) if isinstance(part, tuple) else [part])]


def rebuilt(tree: Any, numbers: list[Number]) -> Any:
    """:return: the same tuples of tuples with other numbers"""
    parts = [rebuilt(part, numbers) if isinstance(part, tuple) else numbers.pop(0) for part in tree]
    return type(tree)(*parts) if hasattr(tree, "_fields") else tuple(parts)


def plus(a: Any, b: Any) -> Any:
    """:return: the sum, number by number"""
    return rebuilt(a, [alg.add(x, y) for x, y in zip(numbers_of(a), numbers_of(b), strict=True)])


def times(factor: Number, tree: Any) -> Any:
    """:return: each number times the factor"""
    return rebuilt(tree, [alg.mul(factor, x) for x in numbers_of(tree)])


def side_by_side(trees: Sequence[Any], dtype: Any) -> Any:
    """:return: the tuples of all joints or bodies as one tuple of arrays"""
    columns = zip(*map(numbers_of, trees), strict=True)
    return rebuilt(trees[0], [alg.gathered(column, dtype) for column in columns])


def repeated(tree: Any, n: int) -> Any:
    """:return: arrays of ``n`` equal entries"""
    numbers = [x if isinstance(x, float) else jnp.broadcast_to(x, (n,)) for x in numbers_of(tree)]
    return rebuilt(tree, numbers)


def sum_over(matrix: np.ndarray, tree: Any) -> Any:
    """:return: each number, as a vector along its last axis, times a matrix"""
    numbers = numbers_of(tree)
    live = [i for i, x in enumerate(numbers) if not isinstance(x, float)]
    numbers = [x if i in live or x == 0.0 else x * matrix.sum(0) for i, x in enumerate(numbers)]
    if live:
        parts = [numbers[i] for i in live]
        library = jnp if any(isinstance(x, jax.Array) for x in parts) else np
        found = library.stack(library.broadcast_arrays(*parts), -2) @ matrix
        for place, i in enumerate(live):
            numbers[i] = found[..., place, :]
    return rebuilt(tree, numbers)


def scalar_products(a: Any, b: Any, n: int) -> Number:
    """:return: entry ``(i, j)``: the scalar product of joint i of ``a`` and joint j of ``b``"""
    found: Number = 0.0
    for x, y in zip(numbers_of(a), numbers_of(b), strict=True):
        rows = x if isinstance(x, float) else x[..., :, None]
        columns = y if isinstance(y, float) else y[..., None, :]
        found = alg.add(found, alg.mul(rows, columns))
    shape = np.shape(found)
    if shape[-2:] == (n, n):
        return found
    library = jnp if isinstance(found, jax.Array) else np
    return library.broadcast_to(found, (*shape[:-2], n, n))
