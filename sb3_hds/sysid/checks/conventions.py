"""
Is a log written in the model's conventions? Zeros, directions, units, the order of columns and the
mounting are checked before any cause is looked for: a wrong convention resembles several causes at
once.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sb3_hds.core import AnalyticTwin, Twin
from sb3_hds.core.twin import plant_of
from sb3_hds.effects import ConstantForce, CoulombFriction, ViscousFriction
from sb3_hds.sysid.checks.changes import (
    Change,
    beyond_limits,
    changes_of_columns,
    late_commands,
    other_gears,
    other_mountings,
    other_units_of_torques,
)
from sb3_hds.sysid.equation.assembly import assemble, normal_problem, rows_of
from sb3_hds.sysid.equation.regression import Equation, squares
from sb3_hds.sysid.equation.terms import terms
from sb3_hds.sysid.estimation.hypotheses import Hypotheses
from sb3_hds.sysid.motion.motion import JointMotion, Motion

# Effects that nearly every machine has, whatever the conventions of its log.
_ALWAYS = (ViscousFriction, CoulombFriction, ConstantForce)
# Rows of the test, at most; all changes are ranked on fewer, and only the likeliest are tested.
_ROWS, _FEW_ROWS, _LIKELIEST = 3000, 1000, 4
# Of more changes than this, the likeliest by ordinary least squares are ranked.
_MANY = 12
# A change is accepted if it lowers the residuals of the joints that it concerns by this factor, in
# their geometric mean, and -2 log likelihood by this much.
_SMALLER, _WORTH = 2.0, 30.0
# It concerns a joint whose residual it changes by this factor.
_CONCERNED = 1.1
# Changes that look like commands that are late by half a period.
_REVERSING = ("direction", "command")
# Shares of a force that count as nothing.
_SAME = 1e-6
# At most so many changes are listed that would do as well, to within _WORTH.
_AS_GOOD = 2
# Residuals below this multiple of the noise need no other convention.
_FINE = 2.0


class Convention(NamedTuple):
    """
    :param key: kind and place: ``"direction.hinge"``; of several, with a ``"+"`` between
    :param words: sentences on what differs, on what to write into the map of columns, and on what
        the equation of motion then leaves
    """

    key: str
    words: str


class _Log(NamedTuple):
    """
    A log in some convention.

    :param known: the nominal model at the interval of the motion, with friction and offsets
    """

    known: Hypotheses
    motion: Motion

    @classmethod
    def of(cls, twin: Twin, motion: Motion, nuisances: Sequence[str] = ()) -> "_Log":
        """
        :param twin: nominal model at the interval of the motion
        :param nuisances: parameters that are refitted
        """
        keys = {f"{kind.name}.{joint.name}" for kind in _ALWAYS for joint in twin.joints}
        speeds = tuple(motion.speed)
        return cls(Hypotheses.about(twin, _ALWAYS, nuisances, only=keys, speeds=speeds), motion)

    @property
    def twin(self) -> Twin:
        return self.known.nominal

    def changed(self, change: Change) -> "_Log":
        twin = self.twin.with_parameters(**change.values)
        motion = change.motion(self.motion)
        if np.array_equal(motion.speed, self.motion.speed):
            return _Log(dataclasses.replace(self.known, nominal=twin), motion)
        nuisances = [self.known.names[i] for i in self.known.nuisances]
        return _Log.of(twin, motion, nuisances)

    def fewer(self) -> "_Log":
        return self._replace(motion=_fewer(self.motion, _FEW_ROWS))

    @property
    def residual(self) -> "_Residual":
        made = assemble(self.known, self.motion, quick=True)
        p = normal_problem(self.known, made)
        found = p.solve(list(range(len(p.items))))
        rss = squares(found.weights, p.grams.by_joint)
        floor = np.where(p.grams.floor > 0.0, p.grams.floor, 1.0)
        n = p.grams.n_effective
        return _Residual(n, np.sqrt(rss / n) / floor, made)


class _Residual(NamedTuple):
    """
    What friction and an offset leave of the equation of motion.

    :param rows: independent ones of each joint
    :param of_joint: rms, in units of the noise
    """

    rows: np.ndarray
    of_joint: np.ndarray
    equation: Equation

    def ratio(self, then: "_Residual") -> np.ndarray:
        """:return: of both, by joint; what is below the noise counts as noise"""
        found = np.maximum(self.of_joint, 1.0) / np.maximum(then.of_joint, 1.0)
        return np.nan_to_num(found, nan=0.0, posinf=0.0)

    def gain(self, then: "_Residual") -> float:
        """:return: in -2 log likelihood"""
        with np.errstate(divide="ignore"):
            return float(self.rows @ (2.0 * np.log(self.ratio(then))))

    def concerned(self, then: "_Residual") -> np.ndarray:
        """:return: whether the residual of each joint differs"""
        return np.abs(np.log(self.ratio(then) + 1e-300)) > np.log(_CONCERNED)

    def accepts(self, then: "_Residual") -> bool:
        """:return: whether the other one is far smaller"""
        concerned = self.concerned(then)
        if self.gain(then) < _WORTH or not concerned.any():
            return False
        return float(np.log(self.ratio(then)[concerned]).mean()) >= np.log(_SMALLER)


class _Ranked(NamedTuple):
    change: Change
    residual: _Residual


def other_convention(twin: Twin, motion: Motion, nuisances: Sequence[str]) -> Convention | None:
    """
    :param twin: nominal model
    :param motion: as measured
    :param nuisances: parameters that are refitted
    :return: the changes of convention under which the residual of the equation of motion, with
        friction and an offset at every joint, is far smaller; None if there are none, or if the log
        fits as it is
    """
    if not isinstance(plant_of(twin), AnalyticTwin) or not motion.moves.any():
        return None
    motion = _fewer(motion)
    log = _Log.of(motion.twin(twin), motion, nuisances)
    first = now = log.residual
    taken: list[Change] = []
    said: list[str] = []
    while np.any(now.of_joint >= _FINE) and len(taken) < 2 * len(twin.joints):
        ranked = [one for one in _likeliest(log, now) if now.accepts(one.residual)]
        if not ranked:
            break
        best, *others = ranked
        gain = now.gain(best.residual)
        if best.change.name in _REVERSING and any(
            now.gain(log.changed(late).residual) > gain for late in late_commands(log.motion)
        ):
            break
        least = gain - _WORTH
        others = [x.change.words for x in others if now.gain(x.residual) > least][:_AS_GOOD]
        said += [best.change.words, *(f"As well possible: {words}" for words in others)]
        log, now = log.changed(best.change), best.residual
        taken.append(best.change)
    if not taken:
        return None
    own = first.concerned(now)
    before, after = (_mean(x.of_joint[own]) for x in (first, now))
    leaves = f"leaves {after:.1f} times the noise, not {before:.0f} times"
    key = "+".join(change.key for change in taken)
    return Convention(key, f"{' '.join(said)} The equation of motion then {leaves}.")


def _mean(residual: np.ndarray) -> float:
    return float(np.exp(np.log(np.maximum(residual, 1.0)).mean()))


def _likeliest(log: _Log, now: _Residual) -> list[_Ranked]:
    """:return: changes that lower the residual, the largest gain first"""
    twin, few = log.twin, log.fewer()

    _, commanded = _left(twin, few.motion)

    def left(change: Change) -> float:
        changed = twin.with_parameters(**change.values)
        rms, force = _left(changed, change.motion(few.motion))
        share = rms / (force if change.name == "torque" else commanded)
        total = float(np.log(np.maximum(share, _SAME)).sum())
        return total if np.isfinite(total) else np.inf

    units = other_units_of_torques(twin, now.equation)
    changes = [
        *changes_of_columns(twin),
        *other_mountings(twin),
        *([units] if units else []),
        *other_gears(twin, few.motion, left),
    ]
    if far := beyond_limits(twin, log.motion):
        # Where a joint is beyond its limits, nothing else is the reason for the residual.
        nearer = [c for c in changes if len(beyond_limits(twin, c.motion(log.motion))) < len(far)]
        changes = nearer or changes
    if len(changes) > _MANY and not log.known.nuisances:
        changes = sorted(changes, key=left)[:_MANY]
    if few.motion is not log.motion:
        changes = [x.change for x in _ranked(few, changes, few.residual)[:_LIKELIEST]]
    return _ranked(log, changes, now)


def _left(twin: Twin, motion: Motion) -> tuple[np.ndarray, np.ndarray]:
    """
    :return: root mean square of what friction and an offset leave of each joint's equation of
        motion, by ordinary least squares on all rows, and of the actuator's force, or one without
        an actuator
    """
    rows = rows_of(motion)
    found = terms(twin, twin.params, rows.q, rows.v, rows.actions)
    load = np.einsum("nij,nj->ni", found.mass, rows.a) + found.bias
    left = []
    for force, v in zip((load - found.actuator).T, rows.v.T, strict=True):
        friction = np.stack([v, np.sign(v), np.ones_like(v)], 1)
        left.append(np.std(force - friction @ np.linalg.lstsq(friction, force, rcond=None)[0]))
    size = np.sqrt(np.mean(found.actuator**2, axis=0))
    return np.array(left), np.where(size > 0.0, size, 1.0)


def _ranked(log: _Log, changes: Sequence[Change], now: _Residual) -> list[_Ranked]:
    tried = [_Ranked(change, log.changed(change).residual) for change in changes]
    lower = [one for one in tried if now.gain(one.residual) > 0.0]
    return sorted(lower, key=lambda one: -now.gain(one.residual))


def residual_beside_friction(twin: Twin, motion: Motion) -> tuple[np.ndarray, np.ndarray]:
    """
    :return: independent rows of each joint, and the residual of its equation of motion with
        friction and an offset, in units of the noise
    """
    motion = _fewer(motion)
    found = _Log.of(motion.twin(twin), motion).residual
    return found.rows, found.of_joint


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
