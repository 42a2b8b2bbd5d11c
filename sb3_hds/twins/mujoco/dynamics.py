"""
Rigid-body dynamics of a tree of links, written out in scalars.

Recursive Newton-Euler for inverse dynamics, composite rigid bodies for the mass matrix, and a
factorisation that keeps the tree's zeros. All quantities of a link are in its own frame.

Source: Featherstone, *Rigid Body Dynamics Algorithms*, Springer 2008, sections 5.3, 6.2 and 6.5.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from sb3_hds.twins.mujoco import scalars as s
from sb3_hds.twins.mujoco.mechanism import BALL, FREE, HINGE, SLIDE, Link
from sb3_hds.twins.mujoco.scalars import Matrix, Number, Symmetric, Vector

#: lower triangle of a symmetric matrix by row and column; what is missing is zero
Triangle = dict[tuple[int, int], Number]

_AXIS: Vector = (0.0, 0.0, 1.0)


class Pose(NamedTuple):
    """Where a link's frame is in its parent's."""

    rotation: Matrix
    origin: Vector


class Inertia(NamedTuple):
    """
    :param mass: [kg]
    :param moment: mass times the centre of mass [kg m]
    :param about: the origin of the link [kg m2]
    :param held: likewise of ``moment``, of the mass whose weight is compensated; None: none
    """

    mass: Number
    moment: Vector
    about: Symmetric
    held: tuple[Number, Vector] | None = None


def poses(links: Sequence[Link], q: Any) -> list[Pose]:
    """:param q: position, indexed like a vector: an array, or a list of numbers"""
    found = []
    for link in links:
        turn, origin = link.rotation, link.origin
        if link.kind == FREE:
            rotation = s.rotation(tuple(q[link.q + 3 + i] for i in range(4)))
            found.append(Pose(rotation, tuple(q[link.q + i] for i in range(3))))
        elif link.kind == BALL:
            own = s.rotation(tuple(q[link.q + i] for i in range(4)))
            found.append(Pose(s.product(turn, own), origin))
        elif link.kind == SLIDE:
            way = s.sub(q[link.q], link.reference)
            found.append(Pose(turn, s.vadd(origin, s.scale(way, s.transpose(turn)[2]))))
        else:
            angle = s.sub(q[link.q], link.reference)
            c, d = s.cos(angle), s.sin(angle)
            rows = tuple(
                (s.add(s.mul(x, c), s.mul(y, d)), s.sub(s.mul(y, c), s.mul(x, d)), z)
                for x, y, z in turn
            )
            found.append(Pose(rows, origin))
    return found


def inverse_dynamics(
    links: Sequence[Link],
    pose: Sequence[Pose],
    inertia: Sequence[Inertia],
    v: Any,
    gravity: Vector,
    a: Any = None,
) -> list[Number]:
    """
    :param v: velocity, indexed like a vector
    :param gravity: acceleration of what falls, in the world's frame [m/s2]
    :param a: acceleration; None: none
    :return: the force under which that happens, by degree of freedom
    """
    turning, spinning, moving = [], [], []  # velocity, acceleration; acceleration of the origin
    falling: list[Vector] = []  # gravity in the link's frame
    force: list[Vector] = []
    torque: list[Vector] = []
    held = any(each.held for each in inertia)
    for link, (rotation, origin), own in zip(links, pose, inertia, strict=True):
        inwards = s.transpose(rotation)
        if link.parent < 0:
            w, dw, dv, g = s.ZERO, s.ZERO, s.scale(-1.0, gravity), gravity
        else:
            w, dw, dv = turning[link.parent], spinning[link.parent], moving[link.parent]
            g = falling[link.parent] if held else s.ZERO
            dv = s.vadd(dv, s.vadd(s.cross(dw, origin), s.cross(w, s.cross(w, origin))))
        speed = tuple(v[i] for i in link.dofs)
        gain = None if a is None else tuple(a[i] for i in link.dofs)
        if link.kind == FREE:
            dv = dv if gain is None else s.vadd(dv, gain[:3])
            w, dw = speed[3:], s.ZERO if gain is None else gain[3:]
            dv = s.apply(inwards, dv)
        else:
            w, dw, dv = s.apply(inwards, w), s.apply(inwards, dw), s.apply(inwards, dv)
            along = speed if link.kind == BALL else (0.0, 0.0, speed[0])
            more = s.ZERO if gain is None else gain if link.kind == BALL else (0.0, 0.0, gain[0])
            if link.kind == SLIDE:
                dv = s.vadd(dv, s.vadd(s.scale(2.0, s.cross(w, along)), more))
            else:
                dw = s.vadd(s.vadd(dw, s.cross(w, along)), more)
                w = s.vadd(w, along)
        turning.append(w)
        spinning.append(dw)
        moving.append(dv)
        f = s.vadd(s.scale(own.mass, dv), s.cross(dw, own.moment))
        f = s.vadd(f, s.cross(w, s.cross(w, own.moment)))
        about = s.full(own.about)
        t = s.vadd(s.apply(about, dw), s.cross(w, s.apply(about, w)))
        t = s.vadd(t, s.cross(own.moment, dv))
        if held:
            falling.append(s.apply(inwards, g))
            mass, moment = own.held or (0.0, s.ZERO)
            f = s.vadd(f, s.scale(mass, falling[-1]))
            t = s.vadd(t, s.cross(moment, falling[-1]))
        force.append(f)
        torque.append(t)
    found: list[Number] = [0.0] * sum(len(link.dofs) for link in links)
    for j in reversed(range(len(links))):
        link, (rotation, origin) = links[j], pose[j]
        needed = _along(link, rotation, force[j], torque[j])
        for i, component in zip(link.dofs, needed, strict=True):
            found[i] = component
        if link.parent >= 0:
            f, t = _outwards(rotation, origin, force[j], torque[j])
            force[link.parent] = s.vadd(force[link.parent], f)
            torque[link.parent] = s.vadd(torque[link.parent], t)
    return found


def mass_matrix(
    links: Sequence[Link], pose: Sequence[Pose], inertia: Sequence[Inertia]
) -> Triangle:
    """:return: without armature"""
    whole = [Inertia(*each[:3]) for each in inertia]
    found: Triangle = {}
    for j in reversed(range(len(links))):
        link, (rotation, origin) = links[j], pose[j]
        mass, moment, about = whole[j][:3]
        for place, (turn, way) in zip(link.dofs, _motions(link, rotation), strict=True):
            f = s.vadd(s.scale(mass, way), s.cross(turn, moment))
            t = s.vadd(s.apply(s.full(about), turn), s.cross(moment, way))
            _fill(found, place, link, rotation, f, t)
            k = j
            while links[k].parent >= 0:
                f, t = _outwards(*pose[k], f, t)
                k = links[k].parent
                _fill(found, place, links[k], pose[k].rotation, f, t)
        if link.parent >= 0:
            whole[link.parent] = _joined(whole[link.parent], rotation, origin, whole[j])
    return found


def factor(matrix: Mapping[tuple[int, int], Number], n: int) -> Triangle:
    """
    :param matrix: symmetric positive definite
    :return: ``L`` below the diagonal and ``D`` on it, of ``L^T D L``: from the tips to the root no
        zero is filled
    """
    rest = dict(matrix)
    for k in reversed(range(n)):
        above = [i for i in range(k) if (k, i) in rest]
        for place, i in reversed(list(enumerate(above))):
            share = s.div(rest[k, i], rest[k, k])
            for j in above[: place + 1]:
                rest[i, j] = s.sub(rest.get((i, j), 0.0), s.mul(share, rest[k, j]))
            rest[k, i] = share
    return rest


def solve(factors: Mapping[tuple[int, int], Number], right: Sequence[Number]) -> list[Number]:
    """:return: ``x`` of ``L^T D L x = right``"""
    x, n = list(right), len(right)
    for k in reversed(range(n)):
        for i in range(k):
            if (k, i) in factors:
                x[i] = s.sub(x[i], s.mul(factors[k, i], x[k]))
        x[k] = s.div(x[k], factors[k, k])
    for k in range(n):
        for i in range(k):
            if (k, i) in factors:
                x[k] = s.sub(x[k], s.mul(factors[k, i], x[i]))
    return x


def _motions(link: Link, rotation: Matrix) -> list[tuple[Vector, Vector]]:
    """Of each degree of freedom: how a unit of it turns the link and moves its origin."""
    axes = s.UNIT
    if link.kind == HINGE:
        return [(_AXIS, s.ZERO)]
    if link.kind == SLIDE:
        return [(s.ZERO, _AXIS)]
    turns = [(axis, s.ZERO) for axis in axes]
    return turns if link.kind == BALL else [(s.ZERO, row) for row in rotation] + turns


def _along(link: Link, rotation: Matrix, f: Vector, t: Vector) -> tuple[Number, ...]:
    """What a force and a torque at the link's origin do along its degrees of freedom."""
    if link.kind == HINGE:
        return (t[2],)
    if link.kind == SLIDE:
        return (f[2],)
    return t if link.kind == BALL else (*s.apply(rotation, f), *t)


def _fill(
    found: Triangle, place: int, link: Link, rotation: Matrix, f: Vector, t: Vector
) -> None:
    for i, component in zip(link.dofs, _along(link, rotation, f, t), strict=True):
        if i <= place:
            found[place, i] = component


def _outwards(rotation: Matrix, origin: Vector, f: Vector, t: Vector) -> tuple[Vector, Vector]:
    """The same force and torque at the parent's origin, in its frame."""
    f = s.apply(rotation, f)
    return f, s.vadd(s.apply(rotation, t), s.cross(origin, f))


def _joined(parent: Inertia, rotation: Matrix, origin: Vector, child: Inertia) -> Inertia:
    """The inertia of a link and of what it carries, as one body."""
    mass, moment, about = child[:3]
    moment, about = s.apply(rotation, moment), s.congruent(rotation, about)
    x, y, z = origin
    weighed = s.scale(mass, origin)

    def spread(a: int, b: int) -> Number:
        far = s.add(s.mul(origin[a], weighed[b]), s.mul(origin[a], moment[b]))
        return s.add(far, s.mul(moment[a], origin[b]))

    xx, yy, zz = spread(0, 0), spread(1, 1), spread(2, 2)
    xy, xz, yz = (s.neg(spread(a, b)) for a, b in ((0, 1), (0, 2), (1, 2)))
    shift = (s.add(yy, zz), s.add(xx, zz), s.add(xx, yy), xy, xz, yz)
    return Inertia(
        s.add(parent.mass, mass),
        s.vadd(parent.moment, s.vadd(moment, weighed)),
        s.sadd(parent.about, s.sadd(about, shift)),
    )
