r"""
Rigid-body dynamics of a tree, and its derivatives, with all degrees of freedom side by side.

Everything is told in the axes of the world, about a point that does not move at that instant: so a
sum over what a joint carries, or over what carries it, is a product with a matrix of ones and
zeros, and only orientations are computed joint by joint.

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

_UNIT = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


class Motion(NamedTuple):
    """A velocity or an acceleration: of rotation, and of what is at the common point."""

    turn: Vector
    move: Vector


class Wrench(NamedTuple):
    """A force or a momentum, about the common point."""

    torque: Vector
    force: Vector


class Inertia(NamedTuple):
    """
    Of one body in its link's frame, or of many about the common point.

    :param mass: [kg]
    :param moment: mass times its place [kg m]
    :param spread: second moments of mass [kg m2]
    """

    mass: Number
    moment: Vector
    spread: Symmetric


class Frames(NamedTuple):
    """
    :param axes: the motion that a unit of speed makes, one entry for each degree of freedom
    :param inertia: of each body
    :param held: of the mass whose weight is compensated, without its spread; None: none
    """

    axes: Motion
    inertia: Inertia
    held: Inertia | None


class Tree:
    """
    Which link carries which.

    A free joint is three slides along the world's axes and a ball.

    :param links: parents before children
    """

    def __init__(self, links: Sequence[Link], dtype: Any = float) -> None:
        self.links, self.dtype = links, dtype
        self.n = sum(len(link.dofs) for link in links)
        self.bodies = [i for i, link in enumerate(links) if link.body]
        same, self.before = np.eye(self.n), np.zeros((self.n, self.n))
        carrying: list[list[int]] = []
        for link in links:
            above = list(carrying[link.parent]) if link.parent >= 0 else []
            for i in link.dofs:
                ball = link.kind == BALL or (link.kind == FREE and i >= link.v + 3)
                if ball:
                    first = link.dofs[-3]
                    same[i, first : first + 3] = 1.0
                    self.before[i, above + list(range(link.v, first))] = 1.0
                else:
                    self.before[i, above + list(range(link.v, i))] = 1.0
            carrying.append(above + list(link.dofs))
        #: rows: a degree of freedom; columns: those that move what it moves, its own joint among
        #: them
        self.before = self.before.astype(dtype)
        self.upto = self.before + same.astype(dtype)
        #: rows: a body; columns: what moves it
        self.carried = self.upto[[links[i].dofs[-1] for i in self.bodies]]
        self.curved = any(link.kind in (BALL, FREE) for link in links)


def frames(
    tree: Tree,
    q: Sequence[Number],
    inertias: Sequence[Inertia],
    held: Sequence[Inertia | None],
) -> Frames:
    """
    :param q: numbers of the position
    :param inertias: of each body in its link's frame, about its centre, the place of which is told
        instead of its moment
    :param held: likewise, of masses whose weight is compensated
    """
    turned: list[Matrix] = []
    places: list[Vector] = []
    adrift: list[bool] = []  # what carries it only slides: where it is does not matter
    axes: list[Motion] = []
    for link in tree.links:
        above, place, loose = _UNIT, alg.ZERO, True
        if link.parent >= 0:
            above, loose = turned[link.parent], adrift[link.parent]
            if not loose:
                place = alg.vadd(places[link.parent], alg.apply(above, link.origin))
        if link.kind == FREE:
            axes += [Motion(alg.ZERO, unit) for unit in _UNIT]
        else:
            above = alg.product(above, link.rotation)
        x, y, z = columns = alg.transpose(above)
        if link.kind == SLIDE:
            axes.append(Motion(alg.ZERO, z))
            if not loose:
                way = alg.sub(q[link.q], link.reference)
                place = alg.vadd(place, alg.scale(way, z))
        elif link.kind == HINGE:
            axes.append(_about(z, place))
            angle = alg.sub(q[link.q], link.reference)
            c, d = alg.cos(angle), alg.sin(angle)
            columns = (
                alg.vadd(alg.scale(c, x), alg.scale(d, y)),
                alg.vadd(alg.scale(c, y), alg.scale(alg.neg(d), x)),
                z,
            )
        else:
            start = link.q + (3 if link.kind == FREE else 0)
            columns = alg.transpose(alg.product(above, alg.rotation(q[start : start + 4])))
            axes += [_about(axis, place) for axis in columns]
        turned.append(alg.transpose(columns))
        places.append(place)
        adrift.append(loose and link.kind == SLIDE)
    rotation = _gathered([turned[i] for i in tree.bodies], tree.dtype)
    place = _gathered([places[i] for i in tree.bodies], tree.dtype)
    compensated = None
    if any(held):
        nothing = Inertia(0.0, alg.ZERO, (0.0,) * 6)
        own = _gathered([each or nothing for each in held], tree.dtype)
        centre = alg.vadd(place, alg.apply(rotation, own.moment))
        compensated = own._replace(moment=alg.scale(own.mass, centre))
    own = _about_the_point(_gathered(inertias, tree.dtype), rotation, place)
    return Frames(_gathered(axes, tree.dtype), own, compensated)


def mass_matrix(tree: Tree, at: Frames) -> Number:
    """:return: without armature, shape ``(n, n)``"""
    momentum = _momentum(_summed(at.inertia, tree.carried), at.axes)
    above = _pairs(at.axes, momentum, tree.n)
    return tree.upto.T * above + tree.before * above.swapaxes(-1, -2)


def inverse_dynamics(
    tree: Tree, at: Frames, v: Number, gravity: Vector, a: Number | None = None
) -> Number:
    """
    :param v: velocity, shape ``(n,)``
    :param gravity: acceleration of what falls, in the world's frame [m/s2]
    :param a: acceleration, shape ``(n,)``; None: none
    :return: the force under which that happens, shape ``(n,)``
    """
    flow = _flow(tree, at, v, gravity, a)
    needed = alg.dot(_flat(at.axes), _flat(_summed(flow.force, tree.carried)))
    return needed + 0.0 * v


def slopes(
    tree: Tree, at: Frames, v: Number, gravity: Vector, a: Number
) -> tuple[Number, Number]:
    """
    :return: of the force that is needed, by position and by velocity, shape ``(n, n)``: rows are
        forces, columns degrees of freedom, a ball's and a free joint's as in a velocity
    """
    flow, axes = _flow(tree, at, v, gravity, a), at.axes
    carried = tree.carried
    inertia, force = _summed(at.inertia, carried), _summed(flow.force, carried)
    bend = _summed(_bends(at.inertia, flow.speed), carried)
    # How each axis changes, with what carries it and with what it moves; and once more.
    spin = _motion_cross(flow.before, axes)
    both = _sum(spin, flow.spin)
    curl = _sum(_motion_cross(flow.gain, axes), _motion_cross(flow.before, spin))
    momentum, bent = _momentum(inertia, axes), _bent(bend, axes)
    by_q = _sum(_momentum(inertia, curl), _bending(bend, spin), _force_cross(axes, force))
    by_v = _sum(_momentum(inertia, both), _bending(bend, axes))
    n = tree.n
    q_below = _pairs((momentum, bent), (curl, spin.turn), n)
    v_below = _pairs((momentum, bent), (both, axes.turn), n)
    if at.held is not None:
        held = _summed(at.held, carried)
        lift = _motion_cross(_repeated(Motion(alg.ZERO, gravity), n), axes)
        by_q = _sum(by_q, _momentum(held, lift))
        q_below = q_below + _pairs(_momentum(held, axes), lift, n)
    over, under = tree.before.T, tree.upto
    return (
        over * _pairs(axes, by_q, n) + under * q_below,
        over * _pairs(axes, by_v, n) + under * v_below,
    )


class _Flow(NamedTuple):
    """
    How everything moves.

    :param before: velocity of what carries each joint
    :param gain: acceleration of what carries each joint
    :param spin: how fast the axes change
    :param speed: velocity of each body
    :param force: that each body needs
    """

    before: Motion
    gain: Motion
    spin: Motion
    speed: Motion
    force: Wrench


def _flow(tree: Tree, at: Frames, v: Number, gravity: Vector, a: Number | None) -> _Flow:
    ways = _times(v, at.axes)
    before = _summed(ways, tree.before.T)
    spin = _motion_cross(_summed(ways, tree.upto.T) if tree.curved else before, at.axes)
    gains = _times(v, spin)
    if a is not None:
        gains = _sum(gains, _times(a, at.axes))
    rising = Motion(alg.ZERO, alg.scale(-1.0, gravity))
    speed = _summed(ways, tree.carried.T)
    gain = _sum(_summed(gains, tree.carried.T), _repeated(rising, len(tree.bodies)))
    turning = _force_cross(speed, _momentum(at.inertia, speed))
    force = _sum(_momentum(at.inertia, gain), turning)
    if at.held is not None:
        falling = _repeated(Motion(alg.ZERO, gravity), len(tree.bodies))
        force = _sum(force, _momentum(at.held, falling))
    gain_before = _sum(_summed(gains, tree.before.T), _repeated(rising, tree.n))
    return _Flow(before, gain_before, spin, speed, force)


# --- spatial algebra


def _about(axis: Vector, place: Vector) -> Motion:
    return Motion(axis, alg.cross(place, axis))


def _motion_cross(a: Motion, b: Motion) -> Motion:
    return Motion(
        alg.cross(a.turn, b.turn), alg.vadd(alg.cross(a.turn, b.move), alg.cross(a.move, b.turn))
    )


def _force_cross(a: Motion, b: Wrench) -> Wrench:
    return Wrench(
        alg.vadd(alg.cross(a.turn, b.torque), alg.cross(a.move, b.force)),
        alg.cross(a.turn, b.force),
    )


def _momentum(inertia: Inertia, motion: Motion) -> Wrench:
    trace = alg.total(inertia.spread[:3])
    spread = alg.apply(alg.full(inertia.spread), motion.turn)
    own = alg.vadd(alg.scale(trace, motion.turn), alg.scale(-1.0, spread))
    return Wrench(
        alg.vadd(own, alg.cross(inertia.moment, motion.move)),
        alg.vadd(alg.scale(inertia.mass, motion.move), alg.cross(motion.turn, inertia.moment)),
    )


class _Bend(NamedTuple):
    r"""
    The slope of a body's force by its velocity, beside what its rotation makes: of a motion
    :math:`(\alpha, \beta)`, :math:`2 (\alpha \times l, -D \alpha)` as force and torque.
    """

    matrix: Matrix
    momentum: Vector


def _bends(inertia: Inertia, speed: Motion) -> _Bend:
    w, u, h = speed.turn, speed.move, inertia.moment
    columns = [alg.cross(w, column) for column in alg.full(inertia.spread)]
    least = alg.neg(alg.dot(h, u))
    rows = tuple(
        tuple(
            alg.total((columns[j][i], alg.mul(u[i], h[j]), least if i == j else 0.0))
            for j in range(3)
        )
        for i in range(3)
    )
    return _Bend(rows, _momentum(inertia, speed).force)  # type: ignore[arg-type]


def _bending(bend: _Bend, motion: Motion) -> Wrench:
    torque = alg.scale(-2.0, alg.apply(bend.matrix, motion.turn))
    return Wrench(torque, alg.scale(2.0, alg.cross(motion.turn, bend.momentum)))


def _bent(bend: _Bend, motion: Motion) -> Vector:
    """The transpose of that, of which no more than three numbers are not zero."""
    back = alg.apply(alg.transpose(bend.matrix), motion.turn)
    return alg.scale(2.0, alg.vadd(alg.cross(bend.momentum, motion.move), alg.scale(-1.0, back)))


def _about_the_point(own: Inertia, rotation: Matrix, place: Vector) -> Inertia:
    """Of bodies in their links' frames; ``moment`` is the place of their centre there."""
    centre = alg.vadd(place, alg.apply(rotation, own.moment))
    weighed = alg.scale(own.mass, centre)
    far = alg.outer(weighed, alg.scale(0.5, centre))
    spread = tuple(map(alg.add, alg.congruent(rotation, own.spread), far))
    return Inertia(own.mass, weighed, spread)  # type: ignore[arg-type]


# --- numbers of all joints or bodies side by side


def _flat(tree: Any) -> list[Number]:
    return [x for part in tree for x in (_flat(part) if isinstance(part, tuple) else [part])]


def _like(tree: Any, numbers: list[Number]) -> Any:
    """The same tuples of tuples, with other numbers."""
    parts = [
        _like(part, numbers) if isinstance(part, tuple) else numbers.pop(0) for part in tree
    ]
    return type(tree)(*parts) if hasattr(tree, "_fields") else tuple(parts)


def _sum(*trees: Any) -> Any:
    return _like(trees[0], [alg.total(parts) for parts in zip(*map(_flat, trees), strict=True)])


def _times(factor: Number, tree: Any) -> Any:
    return _like(tree, [alg.mul(factor, x) for x in _flat(tree)])


def _gathered(trees: Sequence[Any], dtype: Any) -> Any:
    """Of each joint or body the same tuples: one of them, along a new last axis."""
    columns = zip(*map(_flat, trees), strict=True)
    return _like(trees[0], [alg.gathered(column, dtype) for column in columns])


def _repeated(tree: Any, n: int) -> Any:
    """Numbers that all joints or bodies share, side by side."""
    numbers = [x if isinstance(x, float) else jnp.broadcast_to(x, (n,)) for x in _flat(tree)]
    return _like(tree, numbers)


def _summed(tree: Any, matrix: np.ndarray) -> Any:
    """Every number times a matrix of ones and zeros, along the last axis."""
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


def _pairs(a: Any, b: Any, n: int) -> Number:
    """Entry ``(i, j)``: the product of number i of one with number j of the other."""
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
