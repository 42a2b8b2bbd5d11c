"""
Is a log written in the model's conventions? Zeros, directions, units and the order of columns are
checked before any cause is looked for: a wrong convention resembles several causes at once.
"""

import itertools
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from sb3_hds.core import AnalyticTwin, Twin
from sb3_hds.core.twin import plant_of
from sb3_hds.effects import ConstantForce, CoulombFriction, ViscousFriction
from sb3_hds.sysid.equation.assembly import assemble, normal_problem
from sb3_hds.sysid.equation.regression import squares
from sb3_hds.sysid.estimation.hypotheses import Hypotheses
from sb3_hds.sysid.motion.motion import JointMotion, Motion

# Effects that nearly every machine has, whatever the conventions of its log.
_ALWAYS = (ViscousFriction, CoulombFriction, ConstantForce)
# Rows of the test, at most; all changes are ranked on fewer, and only the likeliest are tested.
_ROWS, _FEW_ROWS, _LIKELIEST = 3000, 1000, 4
# A change is accepted if it lowers the residual by this factor, and -2 log likelihood by this much.
_SMALLER, _WORTH = 2.0, 30.0
# Residuals below this multiple of the noise need no other convention.
_FINE = 2.0


class Convention(NamedTuple):
    """
    :param key: kind and place: ``"direction.hinge"``
    :param words: sentences on what differs, and on what to write into the map of columns
    :param before: residual of the equation of motion with the log as it is, in units of the noise
    :param after: the same with the convention changed
    """

    key: str
    words: str
    before: float
    after: float


class _Change(NamedTuple):
    """
    Another convention in which a log may be written.

    :param words: sentences on what differs, and on what to write into the map of columns
    :param q: what the positions become
    :param slopes: what velocities and accelerations become
    :param actions: what the commands become
    :param scale: of each joint's units, or of all
    """

    name: str
    places: tuple[str, ...]
    words: str
    q: Callable[[np.ndarray], np.ndarray] = np.asarray
    slopes: Callable[[np.ndarray], np.ndarray] = np.asarray
    actions: Callable[[np.ndarray], np.ndarray] = np.asarray
    scale: np.ndarray | float = 1.0


def other_convention(twin: Twin, motion: Motion, nuisances: Sequence[str]) -> Convention | None:
    """
    :param twin: nominal model
    :param motion: as measured
    :param nuisances: parameters that are refitted
    :return: the change of convention under which the residual of the equation of motion, with
        friction and an offset at every joint, is far smaller; None if there is none, or if the log
        fits as it is
    """
    if not isinstance(plant_of(twin), AnalyticTwin) or not motion.moves.any():
        return None
    motion = _fewer(motion)
    coarse = motion.twin(twin)
    speeds = tuple(motion.speed)
    hypotheses = Hypotheses.about(coarse, _ALWAYS, nuisances, only=_keys(coarse), speeds=speeds)
    weight, now = _residual(hypotheses, motion)
    if np.all(now < _FINE):
        return None
    changes = list(_changes(twin))
    if (few := _fewer(motion, _FEW_ROWS)) is not motion:
        likely = _by_gain(hypotheses, few, changes, *_residual(hypotheses, few))[:_LIKELIEST]
        changes = [change for _, change, _ in likely]
    ranked = _by_gain(hypotheses, motion, changes, weight, now)
    if not ranked:
        return None
    gain, change, then = ranked[0]
    before, after = (float(np.sqrt(np.mean(np.maximum(x, 1.0) ** 2))) for x in (now, then))
    if gain < _WORTH or before < _SMALLER * after:
        return None
    return Convention(".".join((change.name, *change.places)), change.words, before, after)


def _by_gain(
    hypotheses: Hypotheses,
    motion: Motion,
    changes: Sequence[_Change],
    weight: np.ndarray,
    now: np.ndarray,
) -> list[tuple[float, _Change, np.ndarray]]:
    """
    :param weight: independent rows of each joint
    :param now: residual of each joint with the log as it is, in units of the noise
    :return: gain in -2 log likelihood, the change, and the residuals under it, best first
    """
    found = []
    for change in changes:
        _, then = _residual(hypotheses, _changed(motion, change))
        if np.isfinite(then).all():
            ratio = np.maximum(now, 1.0) / np.maximum(then, 1.0)
            found.append((float(weight @ (2.0 * np.log(ratio))), change, then))
    return sorted(found, key=lambda one: -one[0])


def residual_beside_friction(twin: Twin, motion: Motion) -> tuple[np.ndarray, np.ndarray]:
    """
    :return: independent rows of each joint, and the residual of its equation of motion with
        friction and an offset, in units of the noise
    """
    motion = _fewer(motion)
    known = Hypotheses.about(
        motion.twin(twin), _ALWAYS, (), only=_keys(twin), speeds=tuple(motion.speed)
    )
    return _residual(known, motion)


def _keys(twin: Twin) -> set[str]:
    return {f"{kind.name}.{joint.name}" for kind in _ALWAYS for joint in twin.joints}


def _residual(hypotheses: Hypotheses, motion: Motion) -> tuple[np.ndarray, np.ndarray]:
    """:return: independent rows of each joint, and its residual in units of the noise"""
    made = assemble(hypotheses, motion, quick=True)
    p = normal_problem(hypotheses, made)
    keys = list(range(len(p.items)))
    found = p.solve(keys)
    rss = squares(found.weights, p.grams.by_joint)
    floor = np.where(p.grams.floor > 0.0, p.grams.floor, 1.0)
    return p.grams.n_effective, np.sqrt(rss / p.grams.n_effective) / floor


def _changes(twin: Twin) -> Iterator[_Change]:
    joints, actuators = twin.joints, twin.actuators
    dof, n_act = len(joints), len(actuators)
    rotary = np.array([joint.unit == "rad" for joint in joints])
    for j in np.flatnonzero(rotary):
        name = joints[j].name
        words = (
            f"{name} is counted from a zero that is half a turn from the model's: write its column "
            "with offset: 3.14159265, or give the model that zero."
        )
        yield _Change("zero", (name,), words, q=partial(np.add, np.pi * np.eye(dof)[j]))
    for j, joint in enumerate(joints):
        turned = partial(np.multiply, 1.0 - 2.0 * np.eye(dof)[j])
        words = f"{joint.name} is counted the other way round: write its columns with scale: -1."
        yield _Change("direction", (joint.name,), words, q=turned, slopes=turned)
    for i, actuator in enumerate(actuators):
        turned = partial(np.multiply, 1.0 - 2.0 * np.eye(n_act)[i])
        words = f"The command {actuator.name} has the wrong sign: write its column with scale: -1."
        yield _Change("command", (actuator.name,), words, actions=turned)
    if n_act > 1:
        words = "All commands have the wrong sign: write their columns with scale: -1."
        yield _Change("command", (), words, actions=np.negative)
    if rotary.any():
        size = np.where(rotary, np.pi / 180.0, 1.0)
        smaller = partial(np.multiply, size)
        words = "Angles are in degrees: write their columns with unit: deg."
        yield _Change("degrees", (), words, q=smaller, slopes=smaller, scale=size)
    for i, j in itertools.combinations(range(dof), 2):
        if joints[i].unit == joints[j].unit:
            one, other = joints[i].name, joints[j].name
            words = f"The columns of {one} and {other} are exchanged: exchange them in the map."
            swap = _swap(dof, i, j)
            yield _Change("order", (one, other), words, q=swap, slopes=swap)
    for i, j in itertools.combinations(range(n_act), 2):
        one, other = actuators[i].name, actuators[j].name
        words = f"The commands {one} and {other} are exchanged: exchange their columns in the map."
        yield _Change("order", (one, other), words, actions=_swap(n_act, i, j))


def _swap(n: int, i: int, j: int) -> Callable[[np.ndarray], np.ndarray]:
    order = np.arange(n)
    order[[i, j]] = j, i
    return lambda x: x[:, order]


def _changed(motion: Motion, change: _Change) -> Motion:
    recordings = tuple(
        JointMotion(
            change.q(r.q),
            change.slopes(r.v),
            change.slopes(r.a),
            change.slopes(r.measured_v),
            change.actions(r.actions),
        )
        for r in motion.recordings
    )
    places = np.arange(len(motion.noise_q))
    if change.name == "order":
        places = change.slopes(places[None])[0]
    return motion._replace(
        recordings=recordings,
        noise_q=(motion.noise_q * change.scale)[places],
        noise_v=(motion.noise_v * change.scale)[places],
        error_v=(motion.error_v * change.scale)[places],
        period=motion.period[places],
        blurred=motion.blurred[places],
    )


def _fewer(motion: Motion, most: int = _ROWS) -> Motion:
    """The beginning of each recording, about ``most`` rows in all."""
    n = sum(len(r.actions) for r in motion.recordings)
    if n <= most:
        return motion
    kept = []
    for r in motion.recordings:
        rows = max(int(len(r.actions) * most / n), min(len(r.actions), 50))
        q, v, a, measured_v = (x[: rows + 1] for x in r[:4])
        kept.append(JointMotion(q, v, a, measured_v, r.actions[:rows]))
    return motion._replace(recordings=tuple(kept))
