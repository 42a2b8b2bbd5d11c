"""The residual force that no candidate explains, and what it depends on."""

from collections.abc import Sequence
from itertools import combinations, product
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from sb3_hds.core import Joint, Trajectories
from sb3_hds.sysid.comparison.held_out import STRICTER, Split, split
from sb3_hds.sysid.estimation.evidence import Evidence, Point, Slopes
from sb3_hds.sysid.estimation.shooting import Shots, evenly, shots_of
from sb3_hds.sysid.motion.joints import motion_of

# Length of a window over which the residual force counts as constant, in periods of the motion, and
# in steps.
_WINDOW, _SHORTEST, _LONGEST = 0.2, 4, 25
# Steps of the fit of their start states.
_STEPS = 5
# Windows that a smooth function is learned from; more cost memory in its square.
_MOST_WINDOWS = 1500
# Candidates of its regularisation, relative to the variance of the force.
_RIDGES = (0.1, 1.0, 10.0, 100.0)
# What counts as something: share of the force's variance that others' windows predict, and level.
_LEAST_GAIN, _LEVEL = 0.05, 0.01
# Patterns of signs: all of so many clusters, or so many drawn.
_ALL_SIGNS_OF, _N_FLIPS = 12, 4096
# A smaller set of quantities that explains this share of what all explain tells where it lives.
_MOST_OF_IT = 0.8
_MOST_RATIO = 4.0
# What varies by a smaller share of its values is constant.
_CONSTANT = 1e-9


class ShortWindows(NamedTuple):
    """
    Windows over which a residual force counts as constant, start states fitted.

    :param evidence: of windows that are lengthened to those of its program
    :param point: the current model, on them
    :param shots: the windows themselves
    :param origin: recording of each, shape ``(n,)``
    :param time: since the recording began [s], shape ``(n,)``
    """

    evidence: Evidence
    point: Point
    shots: Shots
    origin: np.ndarray
    time: np.ndarray


class ResidualForce(NamedTuple):
    """
    Residual force of each window: the constant generalised force that the model lacks there.

    :param force: shape ``(n, dof)`` [N m] or [N]
    :param stderr: standard error of each, from the residuals of the window with that force, shape
        ``(n, dof)``
    :param position: mean over the window, shape ``(n, dof)``
    :param velocity: mean over the window, shape ``(n, dof)``
    :param command: mean over the window, shape ``(n, n_act)``
    :param time: since the recording began [s], shape ``(n,)``
    :param origin: recording, shape ``(n,)``
    :param numbers: measurements in a window
    :param noise: standard deviation of each channel's error in such short windows, shape
        ``(n_obs,)``
    """

    force: np.ndarray
    stderr: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    command: np.ndarray
    time: np.ndarray
    origin: np.ndarray
    numbers: int
    noise: np.ndarray


class PredictableForce(NamedTuple):
    """
    :param joint: joint with the largest predictable share
    :param goes_with: quantities that it depends on
    :param gain: share of its variance that they predict in held-out recordings
    :param p_value: p-value of the hypothesis that nothing can be predicted
    :param power: mean square of the prediction, in units of the force's standard error
    """

    joint: str
    goes_with: tuple[str, ...]
    gain: float
    p_value: float
    power: float


class _Predicted(NamedTuple):
    """
    :param gain: share of the force's variance that is predicted
    :param agreement: predicted times measured, of each window, shape ``(n,)``
    """

    gain: float
    agreement: np.ndarray


def short_windows(
    evidence: Evidence,
    theta: Float[np.ndarray, " p"],
    data: Trajectories,
    period: float,
    most: int,
) -> ShortWindows:
    """
    :param evidence: whose program simulates short windows too
    :param theta: all parameters that may move, shape ``(p,)``; they stay as they are
    :param data: measured
    :param period: of the motion [s]
    :param most: windows
    """
    longest = evidence.shots.actions.shape[1]
    steps = min(int(np.clip(round(_WINDOW * period / data.dt), _SHORTEST, _LONGEST)), longest)
    shots, origin = shots_of(data, steps, evidence.hypotheses.twin, period=period)
    counter: dict[int, int] = {}
    time = np.zeros(len(origin))
    for i, recording in enumerate(origin):
        counter[recording] = counter.get(recording, -1) + 1
        time[i] = counter[recording] * (steps + 1) * data.dt
    some = evenly(len(origin), most)
    shots, origin = shots.rows(some), origin[some]
    counted = (np.arange(longest + 1) <= steps).astype(float)
    short = evidence.on(_lengthened(shots, longest), counted)
    return ShortWindows(short, short.fit(theta, (), n_steps=_STEPS), shots, origin, time[some])


def residual_forces(short: ShortWindows, data: Trajectories) -> ResidualForce:
    """:param data: measured"""
    evidence, point, shots, origin, time = short
    h, steps = evidence.hypotheses, shots.actions.shape[1]
    scale = h.scale[list(h.pushes)]
    slopes = evidence.slopes(point, h.pushes)
    informed = np.maximum(np.einsum("njj->nj", slopes.curvature), 1e-12)
    numbers = (steps + 1) * data.n_obs
    rest = _left_by_forces(short, slopes)
    calmer = np.sqrt(np.median(rest) / max(numbers - point.offsets.shape[1] - len(scale), 1))
    q, v = motion_of(h.nominal, shots.obs, data.dt)
    return ResidualForce(
        force=-scale * slopes.scores / informed,
        stderr=calmer * scale / np.sqrt(informed),
        position=np.unwrap(q, axis=1).mean(1),
        velocity=v.mean(1),
        command=shots.actions.mean(1),
        time=time,
        origin=origin,
        numbers=numbers,
        noise=calmer * evidence.noise,
    )


def _left_by_forces(short: ShortWindows, slopes: Slopes) -> Float[np.ndarray, " n"]:
    """
    What a constant force leaves of each window, sum of squares in units of the noise. That noise
    was measured over long windows, where what is missing has had time to grow.
    """
    measured = short.shots.obs.shape[1]
    residual = np.nan_to_num(short.point.residual[:, :measured], nan=0.0)
    whole = np.sum((residual / short.evidence.noise) ** 2, (1, 2))
    inverse = np.linalg.pinv(slopes.curvature, hermitian=True)
    gained = np.einsum("ni,nij,nj->n", slopes.scores, inverse, slopes.scores)
    return np.maximum(whole - gained, 0.0)


def _lengthened(shots: Shots, steps: int) -> Shots:
    """Windows of so many steps, the last ones of which are not measured."""

    def filled(rows: np.ndarray, length: int) -> np.ndarray:
        missing = length - rows.shape[1]
        return np.concatenate([rows, np.repeat(rows[:, -1:], missing, 1)], 1)

    return shots._replace(obs=filled(shots.obs, steps + 1), actions=filled(shots.actions, steps))


def predictable_force(
    residual: ResidualForce,
    data: Trajectories,
    joints: Sequence[Joint],
    seed: int,
    least_power: float = 0.0,
) -> PredictableForce | None:
    """
    Whether a smooth function of position, velocity, command and time, learned on one half of the
    recordings, predicts the residual force of the other half, and the other way round
    (cross-validation).

    :param least_power: of what is predicted, below which it is too small to matter
    :return: joint and quantities; None if nothing can be predicted
    """
    parts = split(data, residual.origin, seed)
    quantities = _quantities(residual, joints)
    sets = [names for k in (1, 2, len(quantities)) for names in combinations(quantities, k)]
    forces = [
        np.clip(f, -_MOST_RATIO * f.std(), _MOST_RATIO * f.std()) for f in weighed(residual).T
    ]
    told = [
        {names: _predicted(_together(quantities, names), force, parts) for names in sets}
        for force in forces
    ]
    agreement = np.array([[one.agreement for one in by_names.values()] for by_names in told])
    p_values = _by_chance(agreement, parts.cluster)
    found: list[PredictableForce] = []
    for joint, force, by_names, p_of_joint in zip(joints, forces, told, p_values, strict=True):
        p_value = dict(zip(by_names, map(float, p_of_joint), strict=True))
        best = max(by_names, key=lambda names: by_names[names].gain)
        most = by_names[best].gain
        if most < _LEAST_GAIN or p_value[best] >= _LEVEL:
            continue
        enough = min((n for n in by_names if by_names[n].gain >= _MOST_OF_IT * most), key=len)
        gain = by_names[enough].gain
        power = gain * max(float(np.mean(force**2)), 1.0)
        if power < least_power:
            continue
        found.append(PredictableForce(joint.name, enough, gain, p_value[enough], power))
    return max(found, key=lambda r: r.gain, default=None)


def weighed(residual: ResidualForce) -> Float[np.ndarray, "n dof"]:
    """
    :return: forces in units of their standard errors, with less weight for windows that determine
        them poorly
    """
    typical = np.median(residual.stderr, 0)
    return residual.force / residual.stderr * np.minimum(1.0, typical / residual.stderr)


def _quantities(residual: ResidualForce, joints: Sequence[Joint]) -> dict[str, np.ndarray]:
    """:return: what a residual force may depend on, by name, each of shape ``(n, k)``"""
    hinges = np.array([joint.unit == "rad" for joint in joints])
    # A sine of metres would depend on their unit.
    angle = np.where(hinges, residual.position, _scaled(residual.position))
    quantities = {
        "position": np.concatenate([np.cos(angle), np.sin(angle), residual.position], 1),
        "velocity": np.concatenate(
            [residual.velocity, np.tanh(3.0 * _scaled(residual.velocity))], 1
        ),
        "command": residual.command,
        "time": residual.time[:, None],
    }
    return {name: values for name, values in quantities.items() if values.shape[1]}


def _together(quantities: dict[str, np.ndarray], names: tuple[str, ...]) -> list[np.ndarray]:
    """Quantities, and products of friction's sign with where or when: few windows teach no more."""
    found = [quantities[name] for name in names]
    if "velocity" in names:
        sign = np.tanh(3.0 * _scaled(quantities["velocity"]))
        others = [_scaled(quantities[name]) for name in names if name in ("position", "time")]
        found += [
            sign[:, i : i + 1] * values for values in others for i in range(sign.shape[1] // 2)
        ]
    return found


def _scaled(values: np.ndarray) -> np.ndarray:
    std = values.std(0)
    changes = std > _CONSTANT * np.abs(values).max(0, initial=0.0)
    return (values - values.mean(0)) / np.where(changes, std, 1.0)


def _predicted(quantities: list[np.ndarray], force: np.ndarray, parts: Split) -> _Predicted:
    """Each half of the clusters is predicted from the other."""
    features = _scaled(np.concatenate(quantities, 1))
    guess = np.zeros_like(force)
    for learn, check in ((~parts.held_out, parts.held_out), (parts.held_out, ~parts.held_out)):
        rows = np.flatnonzero(learn)
        rows = rows[evenly(len(rows), _MOST_WINDOWS)]
        guess[check] = _ridge(features[rows], force[rows], features[check])
    # Forces are in units of their errors: below one, there is nothing to predict.
    total = max(float(np.sum(force**2)), len(force))
    gain = (np.sum(force**2) - np.sum((force - guess) ** 2)) / total
    return _Predicted(float(gain), force * guess)


def _by_chance(
    agreement: Float[np.ndarray, "joints sets n"], cluster: Int[np.ndarray, " n"]
) -> Float[np.ndarray, "joints sets"]:
    """
    P-value: how often some set of quantities predicts the force of some joint as well where nothing
    can be predicted. Then predictions agree in sign with measurements as often as not, whichever
    the joint and the set, so signs are flipped for all of them together: those of whole clusters,
    because windows of one recording are not independent. What happens in a few recordings only,
    such as hitting a wall, shows there many times, so flips of single windows count too, at a much
    stricter level.

    Source: Westfall and Young, *Resampling-based multiple testing*, Wiley 1993 (the largest
    statistic of a family).

    :param agreement: predicted times measured, of each window
    """
    by_cluster = np.stack(
        [agreement[..., cluster == label].sum(-1) for label in np.unique(cluster)], -1
    )
    return np.minimum(_by_flips(by_cluster), STRICTER * _by_flips(agreement))


def _by_flips(
    agreement: Float[np.ndarray, "joints sets n"],
) -> Float[np.ndarray, "joints sets"]:
    # Every joint in units of what flips make of its own: none hides the others.
    size = np.sqrt(np.sum(agreement**2, -1, keepdims=True).max(1, keepdims=True))
    agreement = agreement / np.where(size > 0.0, size, 1.0)
    n = agreement.shape[-1]
    if n <= _ALL_SIGNS_OF:
        signs = np.array(list(product((1.0, -1.0), repeat=n)))
    else:
        signs = np.random.default_rng(0).choice([-1.0, 1.0], (_N_FLIPS, n))
        signs[0] = 1.0
    largest = np.max(signs @ agreement.reshape(-1, n).T, axis=1)
    # The first pattern is that of the data themselves.
    own = agreement.sum(-1) - 1e-9 * np.abs(agreement).sum(-1)
    return np.mean(largest >= own[..., None], axis=-1)


def _ridge(features: np.ndarray, force: np.ndarray, there: np.ndarray) -> np.ndarray:
    """Kernel ridge regression, its ridge chosen by generalised cross-validation."""
    power, directions = np.linalg.eigh(_kernel(features, features))
    power, rotated = np.maximum(power, 0.0), directions.T @ force

    def score(ridge: float) -> float:
        kept = ridge / (power + ridge)
        return float(np.mean((kept * rotated) ** 2) / np.mean(kept) ** 2)

    answer = directions @ (rotated / (power + min(_RIDGES, key=score)))
    return _kernel(there, features) @ answer


def _kernel(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    squared = np.sum((one[:, None] - other[None]) ** 2, 2)
    return np.exp(-0.5 * squared / one.shape[1])
