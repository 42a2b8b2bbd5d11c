"""The links and drives of a model, as plain data."""

import dataclasses
from collections.abc import Mapping
from typing import Any

HINGE, SLIDE, BALL, FREE = "hinge", "slide", "ball", "free"
#: numbers in a position and in a velocity
SIZES = {HINGE: (1, 1), SLIDE: (1, 1), BALL: (4, 3), FREE: (7, 6)}
#: of the degrees of freedom of a joint that has several
SUFFIXES = {
    HINGE: ("",),
    SLIDE: ("",),
    BALL: ("_rx", "_ry", "_rz"),
    FREE: ("_x", "_y", "_z", "_rx", "_ry", "_rz"),
}


@dataclasses.dataclass(frozen=True)
class Body:
    """
    The rigid body that one link carries.

    :param name: of the body in the model
    :param mass: [kg]
    :param centre: of mass, in the link's frame [m]
    :param inertia: about the centre of mass, in the link's axes [kg m2]: xx, yy, zz, xy, xz, yz
    :param origin: of the body's own frame, in the link's [m]
    :param rotation: of the body's own frame in the link's, rows
    :param gravcomp: mass whose weight the model compensates [kg], and its centre [m]
    """

    name: str
    mass: float
    centre: tuple[float, float, float]
    inertia: tuple[float, float, float, float, float, float]
    origin: tuple[float, float, float]
    rotation: tuple[tuple[float, ...], ...]
    gravcomp: tuple[float, float, float, float] | None = None


@dataclasses.dataclass(frozen=True)
class Link:
    """
    What one joint moves. Its frame has its origin at the joint's anchor, and its z axis along the
    axis of a hinge or slide; the frame of a ball or free joint is that of the body.

    :param joint: name of the joint
    :param kind: of the joint: hinge, slide, ball or free
    :param parent: index of the link that carries it; -1 for the world
    :param rotation: of its frame in the parent's where the joint is at its reference, rows
    :param origin: of its frame in the parent's [m]; likewise
    :param reference: position of a hinge or slide at which that holds
    :param q: index of its first number in a position
    :param v: index of its first number in a velocity
    :param body: what it carries, if that has a mass
    :param stiffness: coefficients of powers of its spring's excursion
    :param rest: position at which the spring is relaxed, as many numbers as a position has
    :param damping: coefficients of powers of the speed, for each degree of freedom
    :param armature: [kg m2] or [kg], for each degree of freedom
    :param friction: dry friction [N m] or [N], for each degree of freedom
    :param force_limit: of all actuators together, for a hinge or slide
    :param limit: range that the model lets the joint move in
    """

    joint: str
    kind: str
    parent: int
    rotation: tuple[tuple[float, ...], ...]
    origin: tuple[float, ...]
    reference: float
    q: int
    v: int
    body: Body | None
    stiffness: tuple[float, ...]
    rest: tuple[float, ...]
    damping: tuple[tuple[float, ...], ...]
    armature: tuple[float, ...]
    friction: tuple[float, ...]
    force_limit: tuple[float, float] | None = None
    limit: tuple[float, float] | None = None

    @property
    def n_q(self) -> int:
        """:return: how many numbers it has in a position"""
        return SIZES[self.kind][0]

    @property
    def in_q(self) -> slice:
        """:return: its numbers in a position"""
        return slice(self.q, self.q + self.n_q)

    @property
    def quaternion(self) -> slice | None:
        """:return: its quaternion in a position; None for a hinge or slide"""
        return slice(self.q + self.n_q - 4, self.q + self.n_q) if self.n_q >= 4 else None

    @property
    def straight(self) -> slice:
        """:return: its numbers in a position that are lengths or single angles"""
        return slice(self.q, self.quaternion.start) if self.quaternion else self.in_q

    @property
    def dofs(self) -> tuple[int, ...]:
        """:return: indices of its numbers in a velocity"""
        return tuple(range(self.v, self.v + SIZES[self.kind][1]))


@dataclasses.dataclass(frozen=True)
class Drive:
    """
    One actuator.

    :param name: of the actuator
    :param kind: ``"affine"``, ``"pid"`` or ``"dcmotor"``
    :param link: index of the link that it drives
    :param gear: one number for a hinge or slide, three for a ball, six for a free joint
    :param outer: whether the turning part of the gear is given in the parent's frame
    :param inputs: what its commands are, in order: ``""`` if it has one without a name
    :param ranges: of the commands; None where they are not limited
    :param gain: constant, and coefficients of length and speed
    :param bias: likewise
    :param force_limit: of the force before the gear
    :param motor: of a DC motor, by name
    """

    name: str
    kind: str
    link: int
    gear: tuple[float, ...]
    outer: bool
    inputs: tuple[str, ...]
    ranges: tuple[tuple[float, float] | None, ...]
    gain: tuple[float, float, float]
    bias: tuple[float, float, float]
    force_limit: tuple[float, float] | None = None
    motor: tuple[tuple[str, float], ...] = ()

    @property
    def role(self) -> str:
        """:return: ``"motor"``, ``"position"``, ``"velocity"``, ``"dcmotor"`` or ``"general"``"""
        constant, kp, kv = self.bias
        if self.kind == "dcmotor":
            return "dcmotor"
        if self.kind == "pid":
            return "position" if constant == 0.0 else "general"
        if self.gain[1:] != (0.0, 0.0) or constant != 0.0:
            return "general"
        if (kp, kv) == (0.0, 0.0):
            return "motor"
        if kp == -self.gain[0] and kp != 0.0:
            return "position"
        return "velocity" if kp == 0.0 and kv == -self.gain[0] else "general"

    @property
    def follows_speed(self) -> bool:
        """:return: whether its force depends on the speed of its joint"""
        return self.kind in ("pid", "dcmotor") or self.gain[2] != 0.0 or self.role != "motor"


@dataclasses.dataclass(frozen=True)
class Place:
    """
    A point that has a name: a site, or the origin of a body.

    :param link: index of the link that carries it; -1 for the world
    :param position: in the link's frame [m]
    :param rotation: of its own frame in the link's, rows
    """

    name: str
    link: int
    position: tuple[float, ...]
    rotation: tuple[tuple[float, ...], ...]


@dataclasses.dataclass(frozen=True)
class Shape:
    """
    A mesh as it is drawn: a convex body.

    :param link: index of the link that carries it; -1 for the world
    :param points: its corners, in the link's frame [m]
    """

    link: int
    points: tuple[tuple[float, ...], ...]


@dataclasses.dataclass(frozen=True)
class Mechanism:
    """
    All data of the equation of motion of a model.

    :param name: of the model
    :param gravity: [m/s2], in the world's frame
    :param timestep: of the model [s]
    :param integrator: ``"euler"``, ``"implicitfast"`` or ``"rk4"``
    :param implicit_damping: whether ``euler`` takes damping at the end of its step
    :param start: position in which an episode begins
    :param shapes: that are drawn
    """

    name: str
    links: tuple[Link, ...]
    drives: tuple[Drive, ...]
    places: tuple[Place, ...]
    gravity: tuple[float, float, float]
    timestep: float
    integrator: str
    implicit_damping: bool
    start: tuple[float, ...]
    shapes: tuple[Shape, ...] = ()

    @property
    def n_q(self) -> int:
        return sum(link.n_q for link in self.links)

    @property
    def n_v(self) -> int:
        return sum(len(link.dofs) for link in self.links)

    def to_spec(self) -> dict[str, Any]:
        """:return: plain data"""
        return dataclasses.asdict(self)

    @classmethod
    def from_spec(cls, spec: Mapping[str, Any]) -> "Mechanism":
        """The inverse of :meth:`to_spec`."""
        spec = {name: _frozen(value) for name, value in spec.items()}
        links = tuple(
            Link(**link | {"body": Body(**link["body"]) if link["body"] else None})
            for link in spec.pop("links")
        )
        drives = tuple(Drive(**drive) for drive in spec.pop("drives"))
        places = tuple(Place(**place) for place in spec.pop("places"))
        shapes = tuple(Shape(**shape) for shape in spec.pop("shapes", ()))
        return cls(links=links, drives=drives, places=places, shapes=shapes, **spec)


def _frozen(value: Any) -> Any:
    """Lists, as JSON has them, as tuples."""
    if isinstance(value, list | tuple):
        return tuple(_frozen(part) for part in value)
    if isinstance(value, Mapping):
        return {name: _frozen(part) for name, part in value.items()}
    return value
