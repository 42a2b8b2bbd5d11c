"""
The parameters of a mechanism: names, units, bounds, and their effect.

Names are those of joints and actuators with MJCF's words: ``elbow_damping``,
``elbow_frictionloss``, ``elbow_servo_kp``.
"""

import math
from collections.abc import Collection, Mapping
from typing import NamedTuple

import numpy as np

from sb3_hds.core import Parameter
from sb3_hds.errors import ParameterError, did_you_mean
from sb3_hds.twins.mujoco.mechanism import (
    FREE,
    SLIDE,
    SUFFIXES,
    Body,
    Drive,
    Link,
    Mechanism,
    Place,
)
from sb3_hds.twins.mujoco.rigid_body import algebra as alg
from sb3_hds.twins.mujoco.rigid_body import spatial
from sb3_hds.twins.mujoco.rigid_body.algebra import Number, Symmetric, Vector
from sb3_hds.twins.mujoco.rigid_body.dynamics import (
    Tree,
    configuration,
    inverse_dynamics,
    mass_matrix,
)

Values = Mapping[str, Number]

_AXES, _PLANES = "xyz", ("xy", "xz", "yz")
# Typical deviations, as shares of a joint's typical force and inertia, and of a parameter's value.
_OF_FORCE, _OF_FORCE_PER_SPEED, _OF_INERTIA, _OF_ITSELF = 0.05, 0.02, 0.1, 0.1
# Typical force of a drive, as a share of its largest force.
_OF_DRIVE = 0.1
# Typical payload, as a share of the moving mass, and its distance from its place [m].
_OF_MASS, _NEAR = 0.05, 0.05
_TILT = 0.02  # [rad]
_SHIFT, _STRETCH = 0.02, 0.1  # of a body's centre [m], and of its shape (logarithm)
_N_POSES = 64


def of_plant(
    mechanism: Mechanism, usual: "Typical", payload: Place | None, masses: Collection[str]
) -> dict[str, Parameter]:
    """
    :param payload: place of an unknown mass
    :param masses: names of bodies whose mass, centre and inertia are parameters
    :return: the parameters of the equation of motion
    """
    forces = usual.weight + _OF_DRIVE * usual.drive
    found = {name: Parameter(0.0, _TILT, "rad", -np.pi, np.pi) for name in tilts(mechanism)}
    for link in mechanism.links:
        found |= _of_link(link, usual.inertia, forces)
    moving = [link.body for link in mechanism.links if link.body]
    if payload is not None:
        scale = _OF_MASS * sum(body.mass for body in moving)
        found[f"{payload.name}_payload"] = Parameter(0.0, scale, "kg", 0.0)
        for axis in _AXES:
            found[f"{payload.name}_payload_{axis}"] = Parameter(0.0, _NEAR, "m")
    for i, link in enumerate(mechanism.links):
        if link.body is not None and link.body.name in masses:
            found |= _of_body(link.body, _reach(mechanism, i))
    return found


def of_drives(mechanism: Mechanism) -> dict[str, Parameter]:
    """:return: the parameters of the actuators"""
    found = {}
    for drive in mechanism.drives:
        found |= _of_drive(drive, mechanism.links[drive.link])
    return found


def native_effects(mechanism: Mechanism) -> dict[tuple[str, int], dict[str, str]]:
    """:return: effects that correspond to parameters, by name and index of their place"""
    found = {}
    for link in mechanism.links:
        if len(link.dofs) == 1:
            found["viscous_friction", link.v] = {"b": f"{link.joint}_damping"}
            found["coulomb_friction", link.v] = {"tau_c": f"{link.joint}_frictionloss"}
    command = 0
    for drive in mechanism.drives:
        if drive.role == "motor":
            found["torque_gain", command] = {"gain": f"{drive.name}_gain"}
        command += len(drive.inputs)
    return found


def _of_link(link: Link, inertias: np.ndarray, forces: np.ndarray) -> dict[str, Parameter]:
    """The parameters of a joint; for a floating base, only those that are not zero."""
    i = link.dofs[-1]
    force, inertia = float(forces[i]) or 1.0, float(inertias[i])
    damping = link.damping[0][0] if link.damping[0] else 0.0
    stiffness = link.stiffness[0] if link.stiffness else 0.0
    # Value, scale, and the units of rotary and sliding joints.
    declared = {
        "damping": (damping, _OF_FORCE_PER_SPEED * force, "N m s/rad", "N s/m"),
        "frictionloss": (link.friction[0], _OF_FORCE * force, "N m", "N"),
        "armature": (link.armature[0], _OF_INERTIA * inertia, "kg m2", "kg"),
        "stiffness": (stiffness, 0.0, "N m/rad", "N/m"),
    }
    found = {}
    for name, (value, scale, *units) in declared.items():
        if value or (scale > 0.0 and link.kind != FREE):
            scale, unit = max(scale, _OF_ITSELF * abs(value)), units[link.kind == SLIDE]
            found[f"{link.joint}_{name}"] = Parameter(value, scale, unit, min(value, 0.0))
    return found


def _of_drive(drive: Drive, link: Link) -> dict[str, Parameter]:
    force = "N" if link.kind == SLIDE else "N m"
    length, positive = ("m" if link.kind == SLIDE else "rad"), (0.0, math.inf)
    speed = f"{force} s/{length}"
    kp, kv = (-value for value in drive.bias[1:])
    motor = dict(drive.motor)
    found: dict[str, tuple[float, str, tuple[float, float]]] = {
        "motor": {"gain": (drive.gain[0], "1", (-math.inf, math.inf))},
        "position": {"kp": (kp, f"{force}/{length}", positive), "kv": (kv, speed, positive)},
        "velocity": {"kv": (kv, speed, positive)},
        "dcmotor": {
            "motorconst": (motor.get("constant", 0.0), "N m/A", positive),
            "resistance": (motor.get("resistance", 1.0), "ohm", (1e-9, math.inf)),
        },
        "general": {},
    }[drive.role]
    other = kp if drive.role == "position" else 1.0
    return {
        f"{drive.name}_{name}": Parameter(
            value, _OF_ITSELF * abs(value) or _OF_ITSELF * abs(other), unit, min(low, value), high
        )
        for name, (value, unit, (low, high)) in found.items()
    }


def named_bodies(mechanism: Mechanism, masses: bool | Collection[str]) -> tuple[str, ...]:
    """
    :param masses: names of bodies, True for all, or False for none
    :return: their names, in the order of the model
    :raises ParameterError: for the name of a body that does not move, or that there is not
    """
    every = tuple(link.body.name for link in mechanism.links if link.body)
    if isinstance(masses, bool):
        return every if masses else ()
    wanted = (masses,) if isinstance(masses, str) else tuple(masses)
    for name in wanted:
        if name not in every:
            raise ParameterError(
                f"masses names '{name}', which {mechanism.name} does not have or move."
                f"{did_you_mean(name, every)}"
            )
    return tuple(name for name in every if name in wanted)


def of_mass(body: str) -> tuple[str, ...]:
    """:return: names of the mass and the centre of mass of a body"""
    return f"{body}_mass", *(f"{body}_com_{axis}" for axis in _AXES)


def shape_of(body: str) -> tuple[str, ...]:
    """:return: names of the parameters of its inertia per unit of mass"""
    stretches = tuple(f"{body}_stretch_{axis}" for axis in _AXES)
    return *stretches, *(f"{body}_shear_{plane}" for plane in _PLANES)


def of_inertia(body: str) -> tuple[str, ...]:
    """:return: names of the mass, the centre of mass and the shape of a body"""
    return *of_mass(body), *shape_of(body)


def _reach(mechanism: Mechanism, i: int) -> float:
    """
    :return: how far the centre of mass of a link may be from where the model has it [m]: as far as
        the joints at its ends are, or twice its radius of gyration
    """
    body = mechanism.links[i].body
    assert body is not None
    ends = [np.zeros(3), *(np.array(x.origin) for x in mechanism.links if x.parent == i)]
    gyration = math.sqrt(max(sum(body.inertia[:3]), 0.0) / 2.0 / body.mass)
    return max(2.0 * gyration, *(float(np.linalg.norm(end - body.centre)) for end in ends))


def _of_body(body: Body, reach: float) -> dict[str, Parameter]:
    """:return: mass, centre and inertia; any values are physically consistent"""
    mass, *centre = of_mass(body.name)
    found = {mass: Parameter(body.mass, 0.1 * body.mass, "kg", 1e-3 * body.mass)}
    for name, value in zip(centre, centre_in_body(body), strict=True):
        found[name] = Parameter(value, _SHIFT, "m", value - reach, value + reach)
    for k, name in enumerate(shape_of(body.name)):
        most = 3.0 if k < len(_AXES) else 10.0
        found[name] = Parameter(0.0, _STRETCH, "1", -most, most)
    return found


# --- their effect


def tilts(mechanism: Mechanism) -> list[str]:
    """:return: names of rotations of gravity about the horizontal axes, for a tilted mount"""
    size = np.abs(mechanism.gravity)
    if not size.any():
        return []
    return [f"tilt_{_AXES[i]}" for i in range(3) if i != int(size.argmax())]


def gravity_of(mechanism: Mechanism, p: Values) -> Vector:
    """:return: gravity rotated about the world's axes, the later one first [m/s2]"""
    found: Vector = mechanism.gravity
    for name in reversed(tilts(mechanism)):
        i = _AXES.index(name[-1])
        j, k = (i + 1) % 3, (i + 2) % 3
        c, d = alg.cos(p[name]), alg.sin(p[name])
        turned = {
            i: found[i],
            j: alg.sub(alg.mul(c, found[j]), alg.mul(d, found[k])),
            k: alg.add(alg.mul(d, found[j]), alg.mul(c, found[k])),
        }
        found = turned[0], turned[1], turned[2]
    return found


def bodies_of(
    mechanism: Mechanism, payload: Place | None, masses: Collection[str], p: Values
) -> list[spatial.Body]:
    """:return: the body of each link that has one, payload included"""
    found = []
    for i, link in enumerate(mechanism.links):
        if link.body is None:
            continue
        own = (_with_values if link.body.name in masses else _nominal)(link.body, p)
        if payload is not None and payload.link == i:
            offset = [p[f"{payload.name}_payload_{axis}"] for axis in _AXES]
            place = alg.vadd(payload.position, alg.apply(payload.rotation, offset))
            own = _loaded(own, p[f"{payload.name}_payload"], place)
        found.append(own)
    return found


def compensated(mechanism: Mechanism) -> list[spatial.Body | None]:
    """:return: the mass with compensated weight, of each link that has a body"""
    found: list[spatial.Body | None] = []
    for link in mechanism.links:
        if link.body is not None:
            mass, *centre = link.body.gravcomp or (0.0, 0.0, 0.0, 0.0)
            point = spatial.Body(mass, (centre[0], centre[1], centre[2]), alg.NOTHING)
            found.append(point if link.body.gravcomp else None)
    return found


def _nominal(body: Body, p: Values) -> spatial.Body:
    return spatial.Body(body.mass, body.centre, _second_moments(body.inertia))


def _loaded(own: spatial.Body, mass: Number, place: Vector) -> spatial.Body:
    """A body with a point mass attached."""
    total = alg.add(own.mass, mass)
    share = alg.div(mass, total)
    offset = alg.vadd(place, alg.scale(-1.0, own.centre))
    added = alg.outer(alg.scale(alg.mul(own.mass, share), offset), alg.scale(0.5, offset))
    centre = alg.vadd(own.centre, alg.scale(share, offset))
    return spatial.Body(total, centre, alg.sadd(own.second_moments, added))


def _with_values(body: Body, p: Values) -> spatial.Body:
    r"""
    Log-Cholesky: the second moments of mass about the centre, per unit of mass, become
    :math:`U \Sigma U^T` with an upper triangular :math:`U` of positive diagonal.

    Source: Rucker and Wensing, *Smooth parameterization of rigid-body inertia*, IEEE RA-L 2022.
    """
    name, turn = body.name, body.rotation
    mass = p[f"{name}_mass"]
    centre = [p[f"{name}_com_{axis}"] for axis in _AXES]
    x, y, z = (alg.exp(p[f"{name}_stretch_{axis}"]) for axis in _AXES)
    xy, xz, yz = (p[f"{name}_shear_{plane}"] for plane in _PLANES)
    stretch = ((x, xy, xz), (0.0, y, yz), (0.0, 0.0, z))
    axes = np.array(turn)
    nominal = axes.T @ np.array(alg.full(_second_moments(body.inertia))) @ axes / body.mass
    own = tuple(float(nominal[i, j]) for i, j in alg.PLACES)
    shape = alg.congruent(alg.product(turn, stretch), own)  # type: ignore[arg-type]
    second = tuple(alg.mul(mass, entry) for entry in shape)
    place = alg.vadd(body.origin, alg.apply(turn, centre))
    return spatial.Body(mass, place, second)  # type: ignore[arg-type]


def _second_moments(inertia: Symmetric) -> Symmetric:
    """The second moments of mass of a body with these moments and products of inertia."""
    xx, yy, zz, xy, xz, yz = inertia
    half = 0.5 * (xx + yy + zz)
    return half - xx, half - yy, half - zz, -xy, -xz, -yz


def centre_in_body(body: Body) -> tuple[float, ...]:
    """:return: the centre of mass in the body's frame [m]"""
    offset = np.array(body.rotation).T @ (np.array(body.centre) - np.array(body.origin))
    return tuple(offset.tolist())


# --- typical values


class Typical(NamedTuple):
    """
    Typical values for each degree of freedom.

    :param inertia: smallest effective inertia over random positions [kg m2] or [kg]
    :param weight: largest force of gravity over random positions [N m] or [N]
    :param drive: largest force of the actuators, by their limits [N m] or [N]; 0 without limits
    """

    inertia: np.ndarray
    weight: np.ndarray
    drive: np.ndarray


def typical(mechanism: Mechanism) -> Typical:
    """:return: typical inertias and forces"""
    tree, q = Tree(mechanism.links), random_positions(mechanism, _N_POSES)
    at = configuration(tree, q, bodies_of(mechanism, None, (), {}), compensated(mechanism))
    weight = np.abs(inverse_dynamics(tree, at, np.zeros((_N_POSES, tree.n)), mechanism.gravity))
    armature = np.concatenate([link.armature for link in mechanism.links])
    matrix = np.broadcast_to(mass_matrix(tree, at), (_N_POSES, tree.n, tree.n))
    matrix = matrix + np.diag(armature)
    effective = 1.0 / np.diagonal(np.linalg.inv(matrix), axis1=1, axis2=2)
    force = np.zeros(tree.n)
    for drive in mechanism.drives:
        link = mechanism.links[drive.link]
        force[list(link.dofs)] += np.abs(drive.gear) * _largest(drive, link)
    return Typical(effective.min(0), weight.max(0), force)


def _largest(drive: Drive, link: Link) -> float:
    """Largest force of a drive, by its limits and those of its joint; 0 without limits."""
    limits = [drive.force_limit, link.force_limit]
    if drive.role == "motor" and drive.ranges[0] is not None:
        low, high = drive.ranges[0]
        limits.append((drive.gain[0] * low, drive.gain[0] * high))
    known = [max(map(abs, limit)) for limit in limits if limit is not None]
    return min(known, default=0.0)


def random_positions(mechanism: Mechanism, n: int) -> list[np.ndarray]:
    """:return: one array of ``n`` samples for each number of a position"""
    rng = np.random.default_rng(0)
    found: list[np.ndarray] = []
    for link in mechanism.links:
        if link.quaternion:
            turns = rng.normal(size=(4, n))
            found += [*rng.normal(size=(3, n))] * (link.kind == FREE)
            found += [*(turns / np.linalg.norm(turns, axis=0))]
        else:
            far = 0.5 if link.kind == SLIDE else math.pi
            found.append(rng.uniform(*(link.limit or (-far, far)), n))
    return found


def place_of(mechanism: Mechanism, name: str) -> Place:
    """:raises ParameterError: for an unknown site or body, or one that does not move"""
    found = {place.name: place for place in mechanism.places}
    if name not in found:
        raise ParameterError(
            f"{mechanism.name} has no site or body '{name}' for a payload."
            f"{did_you_mean(name, found)} It has: {', '.join(found) or 'none'}."
        )
    if found[name].link < 0:
        moving = [place.name for place in found.values() if place.link >= 0]
        raise ParameterError(
            f"A payload at '{name}' of {mechanism.name} does not move, so it cannot be identified. "
            f"Choose one of: {', '.join(moving) or 'none'}."
        )
    return found[name]


def dof_names(mechanism: Mechanism) -> list[tuple[str, str]]:
    """:return: name and unit of each degree of freedom"""
    found = []
    for link in mechanism.links:
        for suffix in SUFFIXES[link.kind]:
            straight = link.kind == SLIDE or (link.kind == FREE and "r" not in suffix)
            found.append((f"{link.joint}{suffix}", "m" if straight else "rad"))
    return found
