"""Before any comparison: recordings audited and cut into windows, candidates, two halves."""

import dataclasses
import hashlib
import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from sb3_hds.core import Effect, Trajectories, Twin, rk4
from sb3_hds.core.twin import plant_of
from sb3_hds.data import Audit, audit
from sb3_hds.data.audit.jumps import Glitches, Outliers
from sb3_hds.data.audit.velocity import BackwardDifference
from sb3_hds.sysid.checks.conventions import Convention, other_convention
from sb3_hds.sysid.checks.timing import align_velocities, match_logged_integrator
from sb3_hds.sysid.comparison.halves import Half
from sb3_hds.sysid.comparison.held_out import Split, split
from sb3_hds.sysid.comparison.scales import sized
from sb3_hds.sysid.equation.screening import SMALL_MACHINE, Screened, screen
from sb3_hds.sysid.equation.terms import terms
from sb3_hds.sysid.estimation.evidence import Evidence, portion_for
from sb3_hds.sysid.estimation.hypotheses import Hypotheses
from sb3_hds.sysid.estimation.parameters import Belief
from sb3_hds.sysid.estimation.shooting import Shots, evenly, shots_of
from sb3_hds.sysid.measurements import channel_deviations, white_noise
from sb3_hds.sysid.motion.motion import Motion, smoothed_motion
from sb3_hds.sysid.progress import Bar

# Length of a window in periods of the motion, within these numbers of steps; it is half as long
# where there would be fewer windows than that.
_WINDOW, _SHORTEST, _LONGEST, _FEW = 0.75, 8, 200, 24
# Logarithm of how much an error of a start state may grow within a window, 55 times: where it grows
# more, some windows are fitted by another motion than the one that was measured.
_GROWTH = 4.0
# Windows of each half that are simulated, where machines have more joints than a few: each joint
# makes each more expensive.
_WINDOWS_OF_ALL_JOINTS, _ALL_WINDOWS = 240, 1_000_000
# Region of practical equivalence, in shares of a channel's standard deviation: no simulation is
# exact, and a finding must matter.
IRRELEVANT = 5e-3
# Noise before it is known, in the same units.
_FIRST_NOISE = 0.05
# Parameters that a cause has at most, and fewer clusters than these cannot say anything.
_WIDEST, _FEWEST_CLUSTERS = 3, 6
# Samples and sub-steps of Runge-Kutta that a period of the motion needs.
_SAMPLES, _SUBSTEPS = 100, 200
# Longest sub-step of Runge-Kutta, in shares of the time in which dry friction stops a joint: the
# longer it is, the more the twin smooths it. And by how many times there may be more of them.
_OF_STOP, _MOST_FINER = 0.02, 16
# Rows of an equation of motion, at most: of one joint, and of several, divided by their number
# squared, since each joint adds columns that every joint's equation has. An hour of six joints, a
# thousand times a second, fits 8 GiB then.
_MOST_ROWS, _MOST_ROWS_OF_JOINTS = 100_000, 1_000_000
# Of longer recordings, stretches of so many periods are used, and at least so many of them; a few
# of this number of rows tell the period.
_STRETCH, _FEWEST_STRETCHES, _LOOK = 10, 16, 10_000
# Rows at which the twin is linearised, and finite differences in shares of the motion.
_SOME, _STEP = 64, 1e-5


def divergence_rate(twin: Twin, motion: Motion) -> float:
    """
    :param twin: at the interval of the data
    :param motion: of the joints
    :return: greatest rate [1/s] at which a small change of the state grows along the recordings,
        from eigenvalues of the linearised step, in which positions follow the new velocities;
        zero where none grows
    """
    twin, dt, dof = motion.twin(twin), motion.dt, len(motion.period)
    parts = [(r.q[:-1], r.v[:-1], r.actions) for r in motion.recordings]
    q, v, u = map(np.concatenate, zip(*parts, strict=True))
    chosen = np.linspace(0, len(u) - 1, min(_SOME, len(u))).astype(int)
    q, v, u = q[chosen], v[chosen], u[chosen]
    steps = _STEP * np.diag(np.concatenate([_positive(motion.excursion), _positive(motion.speed)]))
    moved = [np.zeros(2 * dof), *steps]
    states = np.concatenate([np.concatenate([q, v], 1) + step for step in moved])
    commands = np.tile(u, (len(moved), 1))
    q, v = states[:, :dof], states[:, dof:]
    pushed = terms(twin, twin.params, q, v, commands, recorded=False).change
    pushed = pushed.reshape(len(moved), len(u), dof)
    by_state = (pushed[1:] - pushed[0]) / np.diag(steps)[:, None, None]
    faster = np.concatenate([np.zeros((dof, dof)), np.eye(dof)], 1) + by_state.transpose(1, 2, 0)
    further = np.concatenate([np.eye(dof), np.zeros((dof, dof))], 1) + dt * faster
    slopes = np.concatenate([further, faster], 1)
    slopes = slopes[np.isfinite(slopes).all((1, 2))]
    if not len(slopes):
        return 0.0
    growth = float(np.abs(np.linalg.eigvals(slopes)).max())
    return max(np.log(growth), 0.0) / dt if growth > 0.0 else 0.0


def _positive(x: np.ndarray) -> np.ndarray:
    return np.where(x > 0.0, x, 1.0)


@dataclasses.dataclass(frozen=True, eq=False)
class Prepared:
    """
    Recordings and candidates, ready to be compared.

    :param nominal: model, with the parameters that are simulated
    :param audit: of the recordings
    :param corrected: what was corrected in them, a sentence each
    :param sensor_noise: standard deviation of each channel's noise, shape ``(n_obs,)``
    :param data: recordings, at the interval that a diagnosis needs
    :param thinning: samples of the log in one of these
    :param period: typical period of the motion [s]
    :param convention: of the model that the log does not follow; None if it follows all
    :param screened: causes by the equation of motion; None where there is no such equation
    :param hypotheses: candidates that are simulated
    :param std: standard deviation of each channel, shape ``(n_obs,)``
    :param shots: windows
    :param origin: recording of each window
    :param most_windows: that are simulated of each half
    :param parts: which windows propose, and which confirm
    :param least_substeps: of simulations, before dry friction was found
    """

    nominal: Twin
    audit: Audit
    corrected: tuple[str, ...]
    sensor_noise: Float[np.ndarray, " obs"]
    data: Trajectories
    thinning: int
    period: float
    convention: Convention | None
    screened: Screened | None
    hypotheses: Hypotheses
    std: Float[np.ndarray, " obs"]
    shots: Shots
    origin: np.ndarray
    most_windows: int
    parts: Split
    least_substeps: int

    @property
    def reason_to_refuse(self) -> str:
        """Why these data cannot support a verdict; empty if they may."""
        if self.audit.reason:
            return self.audit.reason
        rows = ~self.parts.held_out, self.parts.held_out
        clusters = [len(np.unique(self.parts.cluster[own])) for own in rows]
        if min(clusters) < _FEWEST_CLUSTERS // 2:
            return (
                f"{sum(clusters)} pieces of evidence are too few to propose on some and confirm on "
                "others. Record at least four times as long, or several recordings."
            )
        return ""

    def halves(self) -> tuple[Half, Half]:
        """:return: the evidence that proposes and the one that confirms, parameters scaled"""
        rows = ~self.parts.held_out, self.parts.held_out
        shots = [self.shots.rows(own) for own in rows]
        evidence = Evidence(
            self.hypotheses,
            shots[0],
            self.std,
            width=len(self.hypotheses.nuisances) + max(_WIDEST, self._n_proposed()),
            portion=portion_for(max(own.n for own in shots)),
        )
        if self.screened:
            evidence = dataclasses.replace(
                evidence, hypotheses=self.hypotheses.scaled(self.screened.scales)
            )
        evidence = dataclasses.replace(
            evidence, hypotheses=sized(evidence, self.data), noise=_FIRST_NOISE * self.std
        )
        select, confirm = (
            Half(evidence.on(own), self.parts.cluster[chosen], IRRELEVANT * self.std)
            for own, chosen in zip(shots, rows, strict=True)
        )
        return select, confirm

    def _n_proposed(self) -> int:
        if not self.screened:
            return 0
        items = self.screened.problem.items
        return sum(len(items[m.item].candidate.parameters) for m in self.screened.members)


def prepare(
    twin: Twin,
    data: Trajectories,
    effects: tuple[type[Effect], ...],
    calibrate: Sequence[str] | Mapping[str, Belief],
    seed: int,
    bar: Bar,
) -> Prepared:
    """
    :param twin: nominal model
    :param data: measured
    :param effects: classes of what may be wrong
    :param calibrate: names of nuisance parameters, or a prior for each
    :param seed: of the split
    :param bar: shows how far it is
    """
    bar.stage("reading the log")
    nominal = twin = twin.freed(tuple(calibrate))
    data, audited, corrected = _without_glitches(twin, data)
    data, shortened = shortened_to(twin, data)
    data, in_time = align_velocities(twin, data)
    sensor_noise = white_noise([data.episode(i)[0] for i in range(len(data))])
    twin, data, as_logged = match_logged_integrator(twin, data)
    moved = smoothed_motion(twin, data)
    period = moved.typical_period
    coarse, data, thinning = thinned(twin, data, moved.fastest)
    convention, screened, least_substeps = None, None, coarse.substeps
    if not audited.reason:
        bar.stage("trying conventions")
        convention = other_convention(twin, moved, tuple(calibrate))
    if not audited.reason and convention is None:
        bar.stage("equation of motion")
        screened = screen(twin.freed(), moved, effects, calibrate)
        if screened:
            named = [c.place for c in screened.hypotheses.candidates if c.key in screened.keys]
            nominal = nominal.freed(named)
            coarse = fine_enough(coarse.freed(named), screened)
    only = screened and screened.keys
    where = screened and screened.nameless_at
    hypotheses = Hypotheses.about(
        coarse, effects, calibrate, only, where, period, tuple(moved.speed)
    )
    n_steps = _window_of(data, _span(twin, moved, period))
    shots, origin = shots_of(data, n_steps, hypotheses.twin, period=period)
    most_windows = _ALL_WINDOWS
    if len(twin.joints) > SMALL_MACHINE:
        most_windows = _WINDOWS_OF_ALL_JOINTS // len(twin.joints)
        some = evenly(len(origin), 2 * most_windows)
        shots, origin = shots.rows(some), origin[some]
    return Prepared(
        nominal=nominal,
        audit=audited,
        corrected=(*corrected, *shortened, *in_time, *as_logged),
        sensor_noise=sensor_noise,
        data=data,
        thinning=thinning,
        period=period,
        convention=convention,
        screened=screened,
        hypotheses=hypotheses,
        std=channel_deviations(data),
        shots=shots,
        origin=origin,
        most_windows=most_windows,
        parts=split(data, origin, seed),
        least_substeps=least_substeps,
    )


def hash_of(data: Trajectories) -> str:
    """:return: a checksum of the recordings: values and shapes, interval, origins and conditions"""
    digest = hashlib.sha256(repr((float(data.dt), data.conditions)).encode())
    for leaf in map(np.asarray, (data.obs, data.actions, data.mask, data.origin)):
        digest.update(repr(leaf.shape).encode())
        digest.update(np.ascontiguousarray(leaf).tobytes())
    return digest.hexdigest()[:16]


def _without_glitches(
    twin: Twin, data: Trajectories
) -> tuple[Trajectories, Audit, tuple[str, ...]]:
    """:return: the data without single samples far off, what is found in these, what was cut out"""
    found = _audited(twin, data)
    far = [finding for finding in found.findings if isinstance(finding, Outliers)]
    if not far or not all(isinstance(finding, Glitches) for finding in far):
        return data, found, ()
    data = found.corrected(data)
    words = tuple(f"{finding.sentence} Cut out." for finding in far)
    return data, _audited(twin, data), words


def _audited(twin: Twin, data: Trajectories) -> Audit:
    """Without backward differences: they are moved to where they belong."""
    found = audit(data, twin=twin)
    left = tuple(one for one in found.findings if not isinstance(one, BackwardDifference))
    return dataclasses.replace(found, findings=left)


def shortened_to(twin: Twin, data: Trajectories) -> tuple[Trajectories, tuple[str, ...]]:
    """
    :param data: sampled at the twin's ``dt``
    :return: of recordings that are too long for memory, stretches from all over them, and a
        sentence on that; others as they are
    """
    most = min(_MOST_ROWS, _MOST_ROWS_OF_JOINTS // len(twin.joints) ** 2)
    if data.n_steps <= most:
        return data, ()
    sample = _stretches(data, _LOOK, _LOOK * _FEWEST_STRETCHES)
    moved = smoothed_motion(twin, sample)
    most *= max(1, int(moved.fastest / (_SAMPLES * data.dt)))
    if data.n_steps <= most:
        return data, ()
    length = max(round(_STRETCH * moved.typical_period / data.dt), 1)
    cut = _stretches(data, min(length, most // _FEWEST_STRETCHES), most)
    return cut, (
        f"Of {data.n_steps * data.dt:.4g} s, {cut.n_steps * data.dt:.4g} s are used: {len(cut)} "
        f"stretches of {cut.lengths[0] * data.dt:.3g} s from all over the recordings.",
    )


def _stretches(data: Trajectories, length: int, most: int) -> Trajectories:
    """
    :param length: of a stretch [steps]; all are shorter where recordings are
    :param most: steps of all stretches together, unless a single one is longer
    :return: stretches without overlap, one at random out of each of as many equal parts of the data
    """
    shortest, longest = int(data.lengths.min()), int(data.lengths.max())
    length = min(length, shortest if 10 * shortest > length else longest)
    windows = data.windows(length)
    parts = np.array_split(np.arange(len(windows)), min(max(most // length, 1), len(windows)))
    rng = np.random.default_rng(0)
    return windows[[int(rng.choice(part)) for part in parts]]


class Thinned(NamedTuple):
    """
    :param twin: with the longer interval
    :param data: every n-th observation, and the mean of the commands in between
    :param thinning: 1 where nothing was changed
    """

    twin: Twin
    data: Trajectories
    thinning: int


def thinned(twin: Twin, data: Trajectories, period: float) -> Thinned:
    """
    A hundred samples of a period tell as much about a mechanism as a thousand, at a tenth of the
    cost.

    Where the twin integrates by Runge-Kutta, its sub-steps may become longer, up to a two-hundredth
    of a period; those of other integrators, whose error is a part of the model, stay as they are.

    :param data: sampled at the twin's ``dt``
    :param period: of the fastest motion in them [s]
    """
    thinning = min(round(period / _SAMPLES / data.dt), int(data.lengths.min()))
    if thinning <= 1:
        return Thinned(twin, data, 1)
    dt, inner = thinning * data.dt, twin.dt / twin.substeps
    if getattr(plant_of(twin), "integrator", None) is rk4:
        inner = max(inner, period / _SUBSTEPS)
    pieces = [_every_nth(*data.episode(i), thinning) for i in range(len(data))]
    obs, actions = (list(leaves) for leaves in zip(*pieces, strict=True))
    coarse = Trajectories.from_arrays(obs, actions, dt=dt, conditions=data.conditions)
    coarse = dataclasses.replace(coarse, origin=data.origin, report=data.report)
    return Thinned(twin.at_interval(dt, math.ceil(dt / inner - 1e-9)), coarse, thinning)


def fine_enough(twin: Twin, screened: Screened) -> Twin:
    """
    :return: where the twin integrates by Runge-Kutta, with so many sub-steps that dry friction of
        the proposed set, which stops a joint within one at most, is not smoothed
    """
    if getattr(plant_of(twin), "integrator", None) is not rk4:
        return twin
    least = twin.dt / (_OF_STOP * float(np.min(screened.stops_within)))
    wanted = min(math.ceil(least), _MOST_FINER * twin.substeps)
    return twin.at_interval(twin.dt, max(wanted, twin.substeps))


def _every_nth(
    obs: np.ndarray, actions: np.ndarray, thinning: int
) -> tuple[np.ndarray, np.ndarray]:
    n = len(actions) // thinning
    means = actions[: n * thinning].reshape(n, thinning, actions.shape[1]).mean(1)
    return obs[: n * thinning + 1 : thinning], means


def _span(twin: Twin, moved: Motion, period: float) -> float:
    """:return: length of the windows that are simulated [s]"""
    rate = divergence_rate(twin, moved)
    span = _WINDOW * period
    return min(span, _GROWTH / rate) if rate else span


def _window_of(data: Trajectories, span: float) -> int:
    """
    :param span: that is aimed at [s]
    :return: steps of a window, so that windows fill a typical recording
    """
    rows = int(np.median(data.lengths)) + 1
    steps = min(int(np.clip(round(span / data.dt), _SHORTEST, _LONGEST)), rows - 1)

    def filling(steps: int) -> int:
        return rows // max(round(rows / (steps + 1)), 1) - 1

    whole = filling(steps)
    few = np.sum((data.lengths + 1) // (whole + 1)) < _FEW
    return filling(steps // 2) if few and steps >= 2 * _SHORTEST else whole
