r"""
Rigid-body dynamics of a tree, and its derivatives, for all degrees of freedom side by side.

Spatial vectors are expressed in the axes of the world, about one point at rest. A sum over the
bodies that a joint moves, or over the joints that move a body, is then a product with a constant
matrix of zeros and ones, and only orientations are computed joint by joint: the program hardly
grows with the number of joints.

Source: Featherstone, *Rigid Body Dynamics Algorithms*, Springer 2008, chapters 2, 5 and 6; Singh,
Russell and Wensing, *Efficient analytical derivatives of rigid-body dynamics using spatial vector
algebra*, IEEE RA-L 7(2), 2022.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sb3_hds.twins.mujoco import algebra as alg
from sb3_hds.twins.mujoco.algebra import Matrix, Number, Symmetric, Vector
from sb3_hds.twins.mujoco.mechanism import BALL, FREE, HINGE, SLIDE, Link

_UNIT: Matrix = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


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


class Configuration(NamedTuple):
    """
    A position of the tree.

    :param axes: motion at unit speed of each degree of freedom
    :param inertia: of each body
    :param compensated: mass of each body whose weight something else carries; None: none
    """

    axes: Motion
    inertia: Inertia
    compensated: Inertia | None


class Tree:
    """
    Which joints move which bodies, as matrices of zeros and ones.

    A free joint counts as three slides and a ball.

    :param links: parents first
    :param dtype: of the matrices
    """

    #: row i: the degrees of freedom of the joints below that of i
    below: np.ndarray
    #: row i: those, and the ones of its own joint
    upto: np.ndarray
    #: row b: the degrees of freedom that move body b
    moving: np.ndarray

    def __init__(self, links: Sequence[Link], dtype: Any = float) -> None:
        self.links, self.dtype = links, dtype
        self.n = sum(len(link.dofs) for link in links)
        self.bodies = [i for i, link in enumerate(links) if link.body]
        self.has_balls = any(link.kind in (BALL, FREE) for link in links)
        self.below, own = np.zeros((self.n, self.n), dtype), np.eye(self.n, dtype=dtype)
        carriers: list[list[int]] = []
        for link in links:
            carrier = carriers[link.parent] if link.parent >= 0 else []
            for i in link.dofs:
                in_ball = link.kind == BALL or (link.kind == FREE and i >= link.v + 3)
                first = link.dofs[-3] if in_ball else i
                own[i, first : first + 3 if in_ball else i + 1] = 1.0
                self.below[i, [*carrier, *range(link.v, first)]] = 1.0
            carriers.append([*carrier, *link.dofs])
        self.upto = self.below + own
        self.moving = self.upto[[links[i].dofs[-1] for i in self.bodies]]


def configuration(
    tree: Tree, q: Sequence[Number], bodies: Sequence[Body], compensated: Sequence[Body | None]
) -> Configuration:
    """
    Forward kinematics.

    Where a tree is along the slides at its root does not matter, so it is left out: the common
    point moves along.

    :param q: numbers of the position
    :param bodies: in the order of ``tree.bodies``
    :param compensated: likewise, masses whose weight something else carries
    """
    rotations: list[Matrix] = []
    origins: list[Vector] = []
    sliding: list[bool] = []
    axes: list[Motion] = []
    for link in tree.links:
        rotation, origin, at_root = _UNIT, alg.ZERO, True
        if link.parent >= 0:
            rotation, origin = rotations[link.parent], origins[link.parent]
            at_root = sliding[link.parent]
        rotation, mounted = _mounted(link, rotation, origin)
        origin = alg.ZERO if at_root else mounted
        rotation, moved, own = _through_joint(link, rotation, origin, q)
        axes += own
        rotations.append(rotation)
        origins.append(alg.ZERO if at_root else moved)
        sliding.append(at_root and link.kind == SLIDE)
    rotation = _side_by_side([rotations[i] for i in tree.bodies], tree.dtype)
    origin = _side_by_side([origins[i] for i in tree.bodies], tree.dtype)
    inertia = _placed(_side_by_side(bodies, tree.dtype), rotation, origin)
    carried = None
    if any(compensated):
        none = Body(0.0, alg.ZERO, alg.NOTHING)
        every = _side_by_side([each or none for each in compensated], tree.dtype)
        carried = _placed(every, rotation, origin)
    return Configuration(_side_by_side(axes, tree.dtype), inertia, carried)


def frames_of(links: Sequence[Link], q: Sequence[Number]) -> list[tuple[Matrix, Vector]]:
    """:return: of each link, rotation and origin in the world [m]"""
    rotations: list[Matrix] = []
    origins: list[Vector] = []
    for link in links:
        rotation, origin = _UNIT, alg.ZERO
        if link.parent >= 0:
            rotation, origin = rotations[link.parent], origins[link.parent]
        rotation, origin, _ = _through_joint(link, *_mounted(link, rotation, origin), q)
        rotations.append(rotation)
        origins.append(origin)
    return list(zip(rotations, origins, strict=True))


def _mounted(link: Link, rotation: Matrix, origin: Vector) -> tuple[Matrix, Vector]:
    """The frame of a link where its joint is at its reference, from that of its parent."""
    place = alg.vadd(origin, alg.apply(rotation, link.origin))
    return alg.product(rotation, link.rotation), place


def _through_joint(
    link: Link, rotation: Matrix, origin: Vector, q: Sequence[Number]
) -> tuple[Matrix, Vector, list[Motion]]:
    """The frame of a link, and the motions that its joint allows."""
    x, y, z = alg.transpose(rotation)
    if link.kind == SLIDE:
        way = alg.sub(q[link.q], link.reference)
        return rotation, alg.vadd(origin, alg.scale(way, z)), [Motion(alg.ZERO, z)]
    if link.kind == HINGE:
        angle = alg.sub(q[link.q], link.reference)
        c, s = alg.cos(angle), alg.sin(angle)
        turned = (
            alg.vadd(alg.scale(c, x), alg.scale(s, y)),
            alg.vadd(alg.scale(c, y), alg.scale(alg.neg(s), x)),
            z,
        )
        return alg.transpose(turned), origin, [_rotation_about(z, origin)]
    last = link.q + link.n_q
    rotation = alg.product(rotation, alg.rotation(q[last - 4 : last]))
    axes = [_rotation_about(axis, origin) for axis in alg.transpose(rotation)]
    if link.kind == FREE:
        origin = alg.vadd(origin, q[link.q : link.q + 3])
        axes = [*(Motion(alg.ZERO, unit) for unit in _UNIT), *axes]
    return rotation, origin, axes


def mass_matrix(tree: Tree, at: Configuration) -> Number:
    """:return: without armature, shape ``(n, n)``"""
    momentum = _momentum(_sum_over(tree.moving, at.inertia), at.axes)
    entries = _outer(at.axes, momentum, tree.n)
    return tree.upto.T * entries + tree.below * entries.swapaxes(-1, -2)


def inverse_dynamics(
    tree: Tree, at: Configuration, v: Number, gravity: Vector, a: Number | None = None
) -> Number:
    """
    :param v: velocity, shape ``(n,)``
    :param gravity: [m/s2]
    :param a: acceleration, shape ``(n,)``; None: zero
    :return: generalised force, shape ``(n,)``
    """
    force = _sum_over(tree.moving, _forward(tree, at, v, gravity, a).force)
    return alg.dot(_flat(at.axes), _flat(force)) + 0.0 * v


def derivatives(
    tree: Tree, at: Configuration, v: Number, gravity: Vector, a: Number
) -> tuple[Number, Number]:
    r"""
    :return: of inverse dynamics, by position (in the tangent space) and by velocity, both of shape
        ``(n, n)``

    With the subtree's inertia :math:`I`, force :math:`F` and :math:`B = \partial F / \partial v`
    of a body that does not turn, and :math:`S` for axes, :math:`\dot\Psi = v_\lambda \times S`,
    :math:`\ddot\Psi = a_\lambda \times S + v_\lambda \times \dot\Psi`:

    .. math::
        \partial\tau_i / \partial q_j &= S_i \cdot (I \ddot\Psi_j + B \dot\Psi_j
            + [S_j \times^* F_j]_{i < j}) \\
        \partial\tau_i / \partial v_j &= S_i \cdot (I (\dot\Psi_j + \dot S_j) + B S_j)

    where :math:`I, B` are those of the later of the two joints.
    """
    motion, axes, n = _forward(tree, at, v, gravity, a), at.axes, tree.n
    inertia, force = _sum_over(tree.moving, at.inertia), _sum_over(tree.moving, motion.force)
    coriolis = _sum_over(tree.moving, _coriolis(at.inertia, motion.body_velocity))
    psi_dot = _cross(motion.velocity, axes)
    psi_ddot = _add(_cross(motion.acceleration, axes), _cross(motion.velocity, psi_dot))
    both = _add(psi_dot, motion.axis_rate)
    # Rows are those of the later joint here, ...
    momentum, transposed = _momentum(inertia, axes), _coriolis_transposed(coriolis, axes)
    later_q = _outer((momentum, transposed), (psi_ddot, psi_dot.angular), n)
    later_v = _outer((momentum, transposed), (both, axes.angular), n)
    # ... and columns here.
    by_q = _add(_momentum(inertia, psi_ddot), _coriolis_wrench(coriolis, psi_dot))
    by_q = _add(by_q, _cross_force(axes, force))
    by_v = _add(_momentum(inertia, both), _coriolis_wrench(coriolis, axes))
    if at.compensated is not None:
        carried = _sum_over(tree.moving, at.compensated)
        turned = _cross(_repeated(Motion(alg.ZERO, gravity), n), axes)
        by_q = _add(by_q, _momentum(carried, turned))
        later_q = later_q + _outer(_momentum(carried, axes), turned, n)
    earlier, later = tree.below.T, tree.upto
    return (
        earlier * _outer(axes, by_q, n) + later * later_q,
        earlier * _outer(axes, by_v, n) + later * later_v,
    )


class _Kinematics(NamedTuple):
    """
    :param velocity: of what each joint is mounted on
    :param acceleration: of what each joint is mounted on, minus gravity
    :param axis_rate: time derivative of each axis
    :param body_velocity: of each body
    :param force: that each body needs
    """

    velocity: Motion
    acceleration: Motion
    axis_rate: Motion
    body_velocity: Motion
    force: Wrench


def _forward(
    tree: Tree, at: Configuration, v: Number, gravity: Vector, a: Number | None
) -> _Kinematics:
    """The outward pass of the recursive Newton-Euler algorithm."""
    rates = _times(v, at.axes)
    velocity = _sum_over(tree.below.T, rates)
    own = _sum_over(tree.upto.T, rates) if tree.has_balls else velocity
    axis_rate = _cross(own, at.axes)
    gains = _times(v, axis_rate)
    if a is not None:
        gains = _add(gains, _times(a, at.axes))
    upwards = Motion(alg.ZERO, alg.scale(-1.0, gravity))
    mounted = _add(_sum_over(tree.below.T, gains), _repeated(upwards, tree.n))
    n_bodies = len(tree.bodies)
    speed = _sum_over(tree.moving.T, rates)
    gain = _add(_sum_over(tree.moving.T, gains), _repeated(upwards, n_bodies))
    gyroscopic = _cross_force(speed, _momentum(at.inertia, speed))
    force = _add(_momentum(at.inertia, gain), gyroscopic)
    if at.compensated is not None:
        downwards = _repeated(Motion(alg.ZERO, gravity), n_bodies)
        force = _add(force, _momentum(at.compensated, downwards))
    return _Kinematics(velocity, mounted, axis_rate, speed, force)


# --- spatial algebra


def _rotation_about(axis: Vector, origin: Vector) -> Motion:
    return Motion(axis, alg.cross(origin, axis))


def _cross(a: Motion, b: Motion) -> Motion:
    mixed = alg.vadd(alg.cross(a.angular, b.linear), alg.cross(a.linear, b.angular))
    return Motion(alg.cross(a.angular, b.angular), mixed)


def _cross_force(a: Motion, b: Wrench) -> Wrench:
    torque = alg.vadd(alg.cross(a.angular, b.torque), alg.cross(a.linear, b.force))
    return Wrench(torque, alg.cross(a.angular, b.force))


def _momentum(inertia: Inertia, motion: Motion) -> Wrench:
    angular, h = motion.angular, inertia.first_moment
    trace = alg.total(inertia.second_moments[:3])
    second = alg.apply(alg.full(inertia.second_moments), angular)
    own = alg.vadd(alg.scale(trace, angular), alg.scale(-1.0, second))
    return Wrench(
        alg.vadd(own, alg.cross(h, motion.linear)),
        alg.vadd(alg.scale(inertia.mass, motion.linear), alg.cross(angular, h)),
    )


class _Coriolis(NamedTuple):
    r"""
    :math:`B` of a body with linear momentum :math:`l`: a motion :math:`(\alpha, \beta)` becomes the
    torque :math:`-2 D \alpha` and the force :math:`2 \alpha \times l`.
    """

    matrix: Matrix
    momentum: Vector


def _coriolis(inertia: Inertia, velocity: Motion) -> _Coriolis:
    r""":math:`D = [\omega] \Sigma + u h^T - (h \cdot u) 1`"""
    w, u, h = velocity.angular, velocity.linear, inertia.first_moment
    columns = [alg.cross(w, column) for column in alg.full(inertia.second_moments)]
    diagonal = alg.neg(alg.dot(h, u))

    def entry(i: int, j: int) -> Number:
        own = alg.add(columns[j][i], alg.mul(u[i], h[j]))
        return alg.add(own, diagonal) if i == j else own

    x, y, z = ((entry(i, 0), entry(i, 1), entry(i, 2)) for i in range(3))
    return _Coriolis((x, y, z), _momentum(inertia, velocity).force)


def _coriolis_wrench(coriolis: _Coriolis, motion: Motion) -> Wrench:
    torque = alg.scale(-2.0, alg.apply(coriolis.matrix, motion.angular))
    return Wrench(torque, alg.scale(2.0, alg.cross(motion.angular, coriolis.momentum)))


def _coriolis_transposed(coriolis: _Coriolis, motion: Motion) -> Vector:
    """The transpose, of whose six numbers the last three are zero."""
    back = alg.apply(alg.transpose(coriolis.matrix), motion.angular)
    force = alg.cross(coriolis.momentum, motion.linear)
    return alg.scale(2.0, alg.vadd(force, alg.scale(-1.0, back)))


def _placed(body: Body, rotation: Matrix, origin: Vector) -> Inertia:
    """Inertia about the common point, in the axes of the world."""
    centre = alg.vadd(origin, alg.apply(rotation, body.centre))
    first = alg.scale(body.mass, centre)
    own = alg.congruent(rotation, body.second_moments)
    return Inertia(body.mass, first, alg.sadd(own, alg.outer(first, alg.scale(0.5, centre))))


# --- numbers of all joints or bodies side by side


def _flat(tree: Any) -> list[Number]:
    return [x for part in tree for x in (_flat(part) if isinstance(part, tuple) else [part])]


def _like(tree: Any, numbers: list[Number]) -> Any:
    """The same tuples of tuples with other numbers."""
    parts = [_like(part, numbers) if isinstance(part, tuple) else numbers.pop(0) for part in tree]
    return type(tree)(*parts) if hasattr(tree, "_fields") else tuple(parts)


def _add(a: Any, b: Any) -> Any:
    return _like(a, [alg.add(x, y) for x, y in zip(_flat(a), _flat(b), strict=True)])


def _times(factor: Number, tree: Any) -> Any:
    return _like(tree, [alg.mul(factor, x) for x in _flat(tree)])


def _side_by_side(trees: Sequence[Any], dtype: Any) -> Any:
    """Tuples of each joint or body as one tuple of arrays."""
    columns = zip(*map(_flat, trees), strict=True)
    return _like(trees[0], [alg.gathered(column, dtype) for column in columns])


def _repeated(tree: Any, n: int) -> Any:
    """What all joints or bodies have in common, side by side."""
    numbers = [x if isinstance(x, float) else jnp.broadcast_to(x, (n,)) for x in _flat(tree)]
    return _like(tree, numbers)


def _sum_over(matrix: np.ndarray, tree: Any) -> Any:
    """Numbers along the last axis times a matrix."""
    numbers = _flat(tree)
    live = [i for i, x in enumerate(numbers) if not isinstance(x, float)]
    numbers = [x if i in live or x == 0.0 else x * matrix.sum(0) for i, x in enumerate(numbers)]
    if live:
        parts = [numbers[i] for i in live]
        library = jnp if any(isinstance(x, jax.Array) for x in parts) else np
        found = library.stack(library.broadcast_arrays(*parts), -2) @ matrix
        for place, i in enumerate(live):
            numbers[i] = found[..., place, :]
    return _like(tree, numbers)


def _outer(a: Any, b: Any, n: int) -> Number:
    """Entry ``(i, j)``: the scalar product of number i of ``a`` and number j of ``b``."""
    found: Number = 0.0
    for x, y in zip(_flat(a), _flat(b), strict=True):
        rows = x if isinstance(x, float) else x[..., :, None]
        columns = y if isinstance(y, float) else y[..., None, :]
        found = alg.add(found, alg.mul(rows, columns))
    shape = np.shape(found)
    if shape[-2:] == (n, n):
        return found
    library = jnp if isinstance(found, jax.Array) else np
    return library.broadcast_to(found, (*shape[:-2], n, n))
