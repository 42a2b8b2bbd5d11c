r"""
Rigid-body dynamics of a tree, and its derivatives, for all degrees of freedom at once.

Spatial vectors are expressed in the axes of the world, about one fixed point. A sum over the bodies
that a joint moves, or over the joints that move a body, is then a product with a constant matrix of
zeros and ones, and only orientations are computed joint by joint: the program hardly grows with the
number of joints.

Source: Featherstone, *Rigid Body Dynamics Algorithms*, Springer 2008, chapters 2, 5 and 6; Singh,
Russell and Wensing, *Efficient analytical derivatives of rigid-body dynamics using spatial vector
algebra*, IEEE RA-L 7(2), 2022.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from sb3_hds.twins.mujoco.mechanism import BALL, FREE, HINGE, SLIDE, Link
from sb3_hds.twins.mujoco.rigid_body import algebra as alg
from sb3_hds.twins.mujoco.rigid_body.algebra import Matrix, Number, Vector
from sb3_hds.twins.mujoco.rigid_body.spatial import (
    Body,
    Inertia,
    Motion,
    Wrench,
    coriolis_of,
    coriolis_transposed,
    coriolis_wrench,
    cross,
    cross_force,
    momentum_of,
    numbers_of,
    placed,
    plus,
    repeated,
    rotation_about,
    scalar_products,
    side_by_side,
    sum_over,
    times,
)

_UNIT: Matrix = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


class Configuration(NamedTuple):
    """
    A position of the tree.

    :param axes: motion at unit speed of each degree of freedom
    :param inertia: of each body
    :param compensated: mass of each body with compensated weight; None: no compensation
    """

    axes: Motion
    inertia: Inertia
    compensated: Inertia | None


class Tree:
    """
    Which joints move which bodies, as matrices of zeros and ones. A free joint counts as three
    slides and a ball.

    :param links: parents first
    :param dtype: of the matrices
    """

    #: row i: degrees of freedom of the joints between the world and the joint of i
    below: np.ndarray
    #: row i: the same, and those of the joint of i
    upto: np.ndarray
    #: row b: the degrees of freedom that move body b
    moving: np.ndarray

    def __init__(self, links: Sequence[Link], dtype: Any = float) -> None:
        self.links, self.dtype = links, dtype
        self.n = sum(len(link.dofs) for link in links)
        self.bodies = [i for i, link in enumerate(links) if link.body]
        self.has_balls = any(link.quaternion for link in links)
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

    Displacements along slides at the root of the tree do not matter and are left out: the reference
    point moves along.

    :param q: numbers of the position
    :param bodies: in the order of ``tree.bodies``
    :param compensated: masses with compensated weight, in the order of ``tree.bodies``
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
    rotation = side_by_side([rotations[i] for i in tree.bodies], tree.dtype)
    origin = side_by_side([origins[i] for i in tree.bodies], tree.dtype)
    inertia = placed(side_by_side(bodies, tree.dtype), rotation, origin)
    carried = None
    if any(compensated):
        none = Body(0.0, alg.ZERO, alg.NOTHING)
        masses = side_by_side([each or none for each in compensated], tree.dtype)
        carried = placed(masses, rotation, origin)
    return Configuration(side_by_side(axes, tree.dtype), inertia, carried)


def frames_of(links: Sequence[Link], q: Sequence[Number]) -> list[tuple[Matrix, Vector]]:
    """:return: rotation and origin of each link in the world [m]"""
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
    """The frame of a link at the reference of its joint, from that of its parent."""
    place = alg.vadd(origin, alg.apply(rotation, link.origin))
    return alg.product(rotation, link.rotation), place


def _through_joint(
    link: Link, rotation: Matrix, origin: Vector, q: Sequence[Number]
) -> tuple[Matrix, Vector, list[Motion]]:
    """The frame of a link, and the motions that its joint allows."""
    x, y, z = alg.transpose(rotation)
    if link.kind == SLIDE:
        displacement = alg.sub(q[link.q], link.reference)
        return rotation, alg.vadd(origin, alg.scale(displacement, z)), [Motion(alg.ZERO, z)]
    if link.kind == HINGE:
        angle = alg.sub(q[link.q], link.reference)
        c, s = alg.cos(angle), alg.sin(angle)
        turned = (
            alg.vadd(alg.scale(c, x), alg.scale(s, y)),
            alg.vadd(alg.scale(c, y), alg.scale(alg.neg(s), x)),
            z,
        )
        return alg.transpose(turned), origin, [rotation_about(z, origin)]
    assert link.quaternion is not None
    rotation = alg.product(rotation, alg.rotation(q[link.quaternion]))
    axes = [rotation_about(axis, origin) for axis in alg.transpose(rotation)]
    if link.kind == FREE:
        origin = alg.vadd(origin, q[link.straight])
        axes = [*(Motion(alg.ZERO, unit) for unit in _UNIT), *axes]
    return rotation, origin, axes


def mass_matrix(tree: Tree, at: Configuration) -> Number:
    """:return: the mass matrix without armature, shape ``(n, n)``"""
    momentum = momentum_of(sum_over(tree.moving, at.inertia), at.axes)
    entries = scalar_products(at.axes, momentum, tree.n)
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
    force = sum_over(tree.moving, _forward(tree, at, v, gravity, a).force)
    return alg.dot(numbers_of(at.axes), numbers_of(force)) + 0.0 * v


def derivatives(
    tree: Tree, at: Configuration, v: Number, gravity: Vector, a: Number
) -> tuple[Number, Number]:
    r"""
    :return: derivatives of inverse dynamics by position (in the tangent space) and by velocity,
        both of shape ``(n, n)``

    With the subtree's inertia :math:`I`, force :math:`F` and :math:`B = \partial F / \partial v`
    of a body that does not turn, and :math:`S` for axes, :math:`\dot\Psi = v_\lambda \times S`,
    :math:`\ddot\Psi = a_\lambda \times S + v_\lambda \times \dot\Psi`:

    .. math::
        \partial\tau_i / \partial q_j &= S_i \cdot (I \ddot\Psi_j + B \dot\Psi_j
            + [S_j \times^* F_j]_{i < j}) \\
        \partial\tau_i / \partial v_j &= S_i \cdot (I (\dot\Psi_j + \dot S_j) + B S_j)

    with :math:`I, B` of the outer of the two joints.
    """
    motion, axes, n = _forward(tree, at, v, gravity, a), at.axes, tree.n
    inertia, force = sum_over(tree.moving, at.inertia), sum_over(tree.moving, motion.force)
    coriolis = sum_over(tree.moving, coriolis_of(at.inertia, motion.body_velocity))
    psi_dot = cross(motion.velocity, axes)
    psi_ddot = plus(cross(motion.acceleration, axes), cross(motion.velocity, psi_dot))
    both = plus(psi_dot, motion.axis_rate)
    # Rows belong to the outer joint here, ...
    momentum, transposed = momentum_of(inertia, axes), coriolis_transposed(coriolis, axes)
    later_q = scalar_products((momentum, transposed), (psi_ddot, psi_dot.angular), n)
    later_v = scalar_products((momentum, transposed), (both, axes.angular), n)
    # ... and columns here.
    by_q = plus(momentum_of(inertia, psi_ddot), coriolis_wrench(coriolis, psi_dot))
    by_q = plus(by_q, cross_force(axes, force))
    by_v = plus(momentum_of(inertia, both), coriolis_wrench(coriolis, axes))
    if at.compensated is not None:
        carried = sum_over(tree.moving, at.compensated)
        turned = cross(repeated(Motion(alg.ZERO, gravity), n), axes)
        by_q = plus(by_q, momentum_of(carried, turned))
        later_q = later_q + scalar_products(momentum_of(carried, axes), turned, n)
    earlier, later = tree.below.T, tree.upto
    return (
        earlier * scalar_products(axes, by_q, n) + later * later_q,
        earlier * scalar_products(axes, by_v, n) + later * later_v,
    )


class _Kinematics(NamedTuple):
    """
    :param velocity: of the parent of each joint
    :param acceleration: of the parent of each joint, minus gravity
    :param axis_rate: time derivative of each axis
    :param body_velocity: of each body
    :param force: required force on each body
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
    rates = times(v, at.axes)
    velocity = sum_over(tree.below.T, rates)
    own = sum_over(tree.upto.T, rates) if tree.has_balls else velocity
    axis_rate = cross(own, at.axes)
    gains = times(v, axis_rate)
    if a is not None:
        gains = plus(gains, times(a, at.axes))
    upwards = Motion(alg.ZERO, alg.scale(-1.0, gravity))
    mounted = plus(sum_over(tree.below.T, gains), repeated(upwards, tree.n))
    n_bodies = len(tree.bodies)
    speed = sum_over(tree.moving.T, rates)
    gain = plus(sum_over(tree.moving.T, gains), repeated(upwards, n_bodies))
    gyroscopic = cross_force(speed, momentum_of(at.inertia, speed))
    force = plus(momentum_of(at.inertia, gain), gyroscopic)
    if at.compensated is not None:
        downwards = repeated(Motion(alg.ZERO, gravity), n_bodies)
        force = plus(force, momentum_of(at.compensated, downwards))
    return _Kinematics(velocity, mounted, axis_rate, speed, force)
