"""The links and drives of a model, as plain data."""

import dataclasses
from collections.abc import Mapping
from typing import Any

HINGE, SLIDE, BALL, FREE = "hinge", "slide", "ball", "free"
#: numbers in a position and in a velocity
SIZES = {HINGE: (1, 1), SLIDE: (1, 1), BALL: (4, 3), FREE: (7, 6)}
#: suffixes of the names of a joint's degrees of freedom
SUFFIXES = {
    HINGE: ("",),
    SLIDE: ("",),
    BALL: ("_rx", "_ry", "_rz"),
    FREE: ("_x", "_y", "_z", "_rx", "_ry", "_rz"),
}


@dataclasses.dataclass(frozen=True)
class Body:
    """
    The rigid body of one link.

    :param name: of the body in the model
    :param mass: [kg]
    :param centre: of mass, in the link's frame [m]
    :param inertia: about the centre of mass, in the link's axes [kg m2]: xx, yy, zz, xy, xz, yz
    :param origin: of the body's own frame, in the link's frame [m]
    :param rotation: of the body's own frame, relative to the link's frame, by rows
    :param gravcomp: mass with compensated weight [kg], and its centre [m]
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
    A joint and the body that it moves. The frame has its origin at the joint's anchor, and its z
    axis along the axis of a hinge or slide; the frame of a ball or free joint is that of the body.

    :param joint: name of the joint
    :param kind: of the joint: hinge, slide, ball or free
    :param parent: index of the parent link; -1 for the world
    :param rotation: of its frame relative to the parent's, at the reference position, by rows
    :param origin: of its frame in the parent's, at the reference position [m]
    :param reference: reference position of a hinge or slide
    :param q: index of its first number in a position
    :param v: index of its first number in a velocity
    :param body: None if it has no mass
    :param stiffness: coefficients of powers of the spring's deflection
    :param rest: position at which the spring is relaxed, as many numbers as a position has
    :param damping: coefficients of powers of the speed, for each degree of freedom
    :param armature: [kg m2] or [kg], for each degree of freedom
    :param friction: dry friction [N m] or [N], for each degree of freedom
    :param force_limit: of all actuators together, for a hinge or slide
    :param limit: range of motion in the model
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
        """:return: number of its numbers in a position"""
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
    :param outer: whether the rotational part of the gear is in the parent's frame
    :param inputs: names of its commands; ``""`` for a single one without a name
    :param ranges: of the commands; None without limits
    :param gain: constant, and coefficients of length and speed
    :param bias: constant, and coefficients of length and speed
    :param force_limit: of the force before the gear
    :param motor: constants of a DC motor, by name
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
    A named point: a site, or the origin of a body.

    :param link: index of its link; -1 for the world
    :param position: in the link's frame [m]
    :param rotation: of its own frame, relative to the link's, by rows
    """

    name: str
    link: int
    position: tuple[float, ...]
    rotation: tuple[tuple[float, ...], ...]


@dataclasses.dataclass(frozen=True)
class Shape:
    """
    The convex hull of a mesh, for drawings.

    :param link: index of its link; -1 for the world
    :param points: its corners, in the link's frame [m]
    """

    link: int
    points: tuple[tuple[float, ...], ...]


@dataclasses.dataclass(frozen=True)
class Mechanism:
    """
    All data of a model's equation of motion.

    :param name: of the model
    :param gravity: [m/s2], in the world's frame
    :param timestep: of the model [s]
    :param integrator: ``"euler"``, ``"implicitfast"`` or ``"rk4"``
    :param implicit_damping: whether ``euler`` takes damping at the end of its step
    :param start: initial position of an episode
    :param shapes: for drawings
    :param locked: joints of the model that it lacks, because they stand still: the numbers of
        each in a position of the model
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
    locked: tuple[tuple[str, tuple[float, ...]], ...] = ()

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
    """Plain data with tuples instead of JSON's lists."""
    if isinstance(value, list | tuple):
        return tuple(_frozen(part) for part in value)
    if isinstance(value, Mapping):
        return {name: _frozen(part) for name, part in value.items()}
    return value
