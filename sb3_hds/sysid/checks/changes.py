"""Other conventions in which a log may be written, or a machine be mounted."""

import itertools
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import NamedTuple

import numpy as np

from sb3_hds.core import Twin
from sb3_hds.sysid.equation.regression import Equation
from sb3_hds.sysid.motion.motion import JointMotion, Motion

# Torques are in other units if they are off by this factor; by less, a gain is.
_OTHER_UNITS = 3.0
# Share of a torque that the load must explain beside friction, for its unit to be known from it.
_TOLD_BY_LOAD = 0.5
# Friction is compared where a joint is faster than this share of its top speed.
_MOVING = 0.05
# Lags and delays of commands, in intervals.
_LAGS = tuple(2**k for k in range(7))
_DELAYS = (*range(1, 8), 9, 11, 13, 15, 18, 22, 26, 31, 37, 45, 54, 64, 77, 92, 110, 130)
# Longest delay, in shares of the shortest recording.
_MOST_LATE = 0.5
# A joint may move beyond its model's limits by this factor; without limits, by a few turns [rad].
_BEYOND, _TURNS = 1.5, 4.0 * np.pi
# Gear ratios that are tried: up to 500, a twentieth apart, and then closer.
_RATIOS = 2.0 * 1.05 ** np.arange(114)
_CLOSER = 1.0 + np.array([0.02, 0.01, 0.005, 0.0025])


class Change(NamedTuple):
    """
    Another convention in which a log may be written.

    :param name: of its kind
    :param places: joints or actuators
    :param words: sentences on what differs, and on what to write into the map of columns
    :param q: what the positions become
    :param slopes: what velocities and accelerations become
    :param actions: what the commands become
    :param scale: of each joint's units, or of all
    :param values: parameters of the model that become others
    """

    name: str
    places: tuple[str, ...]
    words: str
    q: Callable[[np.ndarray], np.ndarray] = np.asarray
    slopes: Callable[[np.ndarray], np.ndarray] = np.asarray
    actions: Callable[[np.ndarray], np.ndarray] = np.asarray
    scale: np.ndarray | float = 1.0
    values: Mapping[str, float] = {}

    @property
    def key(self) -> str:
        return ".".join((self.name, *self.places))

    def motion(self, motion: Motion) -> Motion:
        """:return: the motion as it is in this convention"""
        recordings = tuple(
            JointMotion(
                self.q(r.q),
                self.slopes(r.v),
                self.slopes(r.a),
                self.slopes(r.measured_v),
                self.actions(r.actions),
            )
            for r in motion.recordings
        )
        places = np.arange(len(motion.noise_q))
        if self.name == "order":
            places = self.slopes(places[None])[0]
        return motion._replace(
            recordings=recordings,
            noise_q=(motion.noise_q * self.scale)[places],
            noise_v=(motion.noise_v * self.scale)[places],
            error_v=(motion.error_v * self.scale)[places],
            period=motion.period[places],
            blurred=motion.blurred[places],
        )


def changes_of_columns(twin: Twin) -> Iterator[Change]:
    """:return: other zeros, directions, units and orders of a log's columns"""
    joints, actuators = twin.joints, twin.actuators
    dof, n_act = len(joints), len(actuators)
    rotary = np.array([joint.unit == "rad" for joint in joints])
    for j in np.flatnonzero(rotary):
        name = joints[j].name
        words = (
            f"{name} is counted from a zero that is half a turn from the model's: write its column "
            "with offset: 3.14159265, or give the model that zero."
        )
        yield Change("zero", (name,), words, q=partial(np.add, np.pi * np.eye(dof)[j]))
    pairs = itertools.combinations(range(dof), 2)
    for places in [*((j,) for j in range(dof)), *pairs]:
        turned = partial(np.multiply, 1.0 - 2.0 * np.eye(dof)[[*places]].sum(0))
        names = tuple(joints[j].name for j in places)
        are = "is" if len(names) == 1 else "are"
        words = (
            f"{' and '.join(names)} {are} counted the other way round: write "
            f"{'its' if are == 'is' else 'their'} columns with scale: -1."
        )
        yield Change("direction", names, words, q=turned, slopes=turned)
    for i, actuator in enumerate(actuators):
        turned = partial(np.multiply, 1.0 - 2.0 * np.eye(n_act)[i])
        words = f"The command {actuator.name} has the wrong sign: write its column with scale: -1."
        yield Change("command", (actuator.name,), words, actions=turned)
    if n_act > 1:
        words = "All commands have the wrong sign: write their columns with scale: -1."
        yield Change("command", (), words, actions=np.negative)
    if rotary.any():
        size = np.where(rotary, np.pi / 180.0, 1.0)
        smaller = partial(np.multiply, size)
        words = "Angles are in degrees: write their columns with unit: deg."
        yield Change("degrees", (), words, q=smaller, slopes=smaller, scale=size)
    for i, j in itertools.combinations(range(dof), 2):
        if joints[i].unit == joints[j].unit:
            one, other = joints[i].name, joints[j].name
            words = f"The columns of {one} and {other} are exchanged: exchange them in the map."
            swap = _swap(dof, i, j)
            yield Change("order", (one, other), words, q=swap, slopes=swap)
    for i, j in itertools.combinations(range(n_act), 2):
        one, other = actuators[i].name, actuators[j].name
        words = f"The commands {one} and {other} are exchanged: exchange their columns in the map."
        yield Change("order", (one, other), words, actions=_swap(n_act, i, j))


def other_mountings(twin: Twin) -> Iterator[Change]:
    """:return: gravity along the other axes of the model, where it has parameters ``tilt_*``"""
    names = [
        name
        for name in ("tilt_x", "tilt_y")
        if name in twin.parameters and twin.parameters[name].upper >= np.pi
    ]
    quarter = 0.5 * np.pi
    turned = itertools.product(names, (quarter, -quarter))
    for name, angle in [("", 0.0), *turned, *((name, 2.0 * quarter) for name in names[:1])]:
        values = {other: angle if other == name else 0.0 for other in names}
        if all(abs(twin.values[other] - x) < 0.5 * quarter for other, x in values.items()):
            continue
        written = " ".join(f"{other}:{x:.4f}" for other, x in values.items())
        words = (
            "Gravity acts in another direction than in the model, as on a machine that is mounted "
            f"on a wall or a ceiling: turn it by tilt_x and tilt_y (--set {written})."
        )
        yield Change("mounting", (name,) if name else (), words, values=values)


def other_units_of_torques(twin: Twin, made: Equation) -> Change | None:
    """
    :param made: the equation of motion of a twin whose commands may be torques
    :return: currents, or torques on the motor's side of a gear, instead of torques at the joints:
        their scale follows from the load that the model has; None if they are within a factor of 3
    """
    forces, actions = made.terms.actuator, made.rows.actions
    acting = np.linalg.lstsq(actions, forces, rcond=None)[0]
    known = np.abs(acting) > 1e-6 * (np.abs(acting).max(initial=0.0) + 1e-300)
    scale, untold = np.ones(len(twin.actuators)), []
    for i, actuator in enumerate(twin.actuators):
        at = np.flatnonzero(known[i])
        if actuator.unit not in ("N m", "N") or len(at) != 1 or known[:, at[0]].sum() != 1:
            continue
        found = _scale_of(forces[:, at[0]], made.load[:, at[0]], made.rows.v[:, at[0]])
        if found is None:
            untold.append(actuator.name)
        else:
            scale[i] = found
    other = [i for i, x in enumerate(scale) if x > _OTHER_UNITS or 0.0 < x < 1.0 / _OTHER_UNITS]
    if not other:
        return None
    kept = np.ones(len(scale))
    kept[other] = [float(f"{scale[i]:.3g}") for i in other]
    names = [twin.actuators[i].name for i in other]
    words = (
        f"The commands of {', '.join(names)} are not in {twin.actuators[other[0]].unit}: by the "
        f"loads of the model, their units are worth {', '.join(f'{kept[i]:g}' for i in other)}, "
        "like those of currents, or of torques on the motor's side of a gear. Write their columns "
        "with the torque constant times the gear ratio as scale (these numbers, if you do not know "
        "it). Masses in other units would look the same."
    )
    if untold:
        words += f" Of {', '.join(untold)} the data cannot tell: friction takes most of the torque."
    return Change("torque", tuple(names), words, actions=partial(np.multiply, kept))


def _scale_of(force: np.ndarray, load: np.ndarray, v: np.ndarray) -> float | None:
    """
    :param force: of the actuator, as the model has it
    :param load: inertia, gravity and the like, as the model has them
    :return: by what the force is to be multiplied; None if the load does not tell
    """
    moving = np.abs(v) > _MOVING * np.abs(v).max(initial=0.0)
    if moving.sum() < 10:
        return None
    friction = np.stack([v, np.sign(v), np.ones_like(v)], 1)[moving]
    rests = [
        x[moving] - friction @ np.linalg.lstsq(friction, x[moving], rcond=None)[0]
        for x in (force, load)
    ]
    own, by_load = rests
    if not own.any() or not by_load.any():
        return None
    share = float(own @ by_load) / float(by_load @ by_load)
    explained = share * float(own @ by_load) / float(own @ own)
    return 1.0 / share if explained > _TOLD_BY_LOAD else None


def late_commands(motion: Motion) -> Iterator[Change]:
    """
    :return: commands that act late, by a lag or a delay. They are no conventions, but may turn
        commands by half a period, as a wrong sign does.
    """
    for n in _LAGS:
        yield Change("lag", (), "", actions=partial(_lagging, n))
    shortest = min(len(r.actions) for r in motion.recordings)
    for n in (n for n in _DELAYS if n < _MOST_LATE * shortest):
        later, earlier = partial(_part, slice(n, None)), partial(_part, slice(None, -n))
        yield Change("delay", (), "", q=later, slopes=later, actions=earlier)


def _lagging(n: int, commands: np.ndarray) -> np.ndarray:
    from scipy.signal import lfilter

    return np.asarray(lfilter([1.0 / (n + 1.0)], [1.0, -n / (n + 1.0)], commands, axis=0))


def _part(rows: slice, x: np.ndarray) -> np.ndarray:
    return x[rows]


def beyond_limits(twin: Twin, motion: Motion) -> list[int]:
    """:return: joints that move much farther than the limits of the model's allow"""
    ranges = [_BEYOND * (joint.high - joint.low) for joint in twin.joints]
    return [j for j, most in enumerate(ranges) if _reach(motion, j) > most]


def _reach(motion: Motion, j: int) -> float:
    return float(max(np.ptp(r.q[:, j]) for r in motion.recordings))


def other_gears(
    twin: Twin, motion: Motion, residual: Callable[[Change], float]
) -> Iterator[Change]:
    """
    :param residual: measure of what is left of the equation of motion under a change
    :return: positions on the motor's side of a gear, at each joint that moves too far, and at all
        of them with one ratio
    """
    unlimited = [
        j
        for j, joint in enumerate(twin.joints)
        if joint.unit == "rad" and not np.isfinite(joint.high - joint.low)
    ]
    far = beyond_limits(twin, motion) + [j for j in unlimited if _reach(motion, j) > _TURNS]
    for places in [[j] for j in far] + ([far] if len(far) > 1 else []):
        found = min((_geared(twin, places, ratio) for ratio in _RATIOS), key=residual)
        for step in _CLOSER:
            ratio = float(1.0 / np.min(found.scale))
            near = [found, *(_geared(twin, places, x) for x in (ratio * step, ratio / step))]
            found = min(near, key=residual)
        yield found


def _geared(twin: Twin, places: list[int], ratio: float) -> Change:
    scale = np.ones(len(twin.joints))
    scale[places] = 1.0 / ratio
    names = tuple(twin.joints[j].name for j in places)
    about = float(f"{ratio:.2g}")
    words = (
        f"The motion of {', '.join(names)} is larger than the model allows, and fits if positions "
        f"and velocities are divided by about {about:g}: they are probably those of the motor, "
        "on the other side of a gear. Write their columns with 1 / gear ratio as scale."
    )
    divided = partial(np.multiply, scale)
    return Change("gear", names, words, q=divided, slopes=divided, scale=scale)


def _swap(n: int, i: int, j: int) -> Callable[[np.ndarray], np.ndarray]:
    order = np.arange(n)
    order[[i, j]] = j, i
    return lambda x: x[:, order]
