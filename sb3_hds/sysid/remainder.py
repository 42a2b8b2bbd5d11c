"""What no candidate explains: the missing force, and what it goes with."""

from itertools import combinations
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from sb3_hds.core import (
    JointEffect,
    JointMoment,
    Memory,
    Parameter,
    Params,
    Scalar,
    Trajectories,
    Twin,
)
from sb3_hds.sysid.comparison import Split, split
from sb3_hds.sysid.evidence import Evidence
from sb3_hds.sysid.hypotheses import Hypotheses
from sb3_hds.sysid.shooting import shots_of

# Length of a window over which the missing force counts as constant [s], and in steps.
_WINDOW, _SHORTEST, _LONGEST = 0.25, 4, 25
# Windows that a smooth function is learned from; more cost memory in its square.
_MOST_WINDOWS = 1500
# Candidates of its regularisation, relative to the variance of the force.
_RIDGES = (0.1, 1.0, 10.0, 100.0)
# What counts as something: share of the force's variance that others' windows predict, and level.
_LEAST_GAIN, _LEVEL, _N_FLIPS = 0.05, 0.02, 4000
# A smaller set of quantities that explains this share of what all explain tells where it lives.
_MOST_OF_IT = 0.8
_MOST_RATIO = 4.0


class _Push(JointEffect):
    """A constant force."""

    name = "push"
    parameters = {"tau": Parameter(null=0.0, scale=0.1, unit="N m")}
    explanation = "Something pushes."
    source = ""

    def torque(self, joint: JointMoment, memory: Memory, params: Params) -> Scalar:
        return params["tau"] * jnp.ones_like(joint.v)


class MissingForce(NamedTuple):
    """
    The force that each window asks for, beyond what the twin has.

    :param force: shape ``(n, dof)`` [N m] or [N]
    :param stderr: of each, from the noise, shape ``(n, dof)``
    :param position: mean over the window, shape ``(n, dof)``
    :param velocity: mean over the window, shape ``(n, dof)``
    :param command: mean over the window, shape ``(n, n_act)``
    :param time: since the recording began [s], shape ``(n,)``
    :param origin: recording, shape ``(n,)``
    """

    force: np.ndarray
    stderr: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    command: np.ndarray
    time: np.ndarray
    origin: np.ndarray


class Remainder(NamedTuple):
    """
    :param joint: name of the joint where most is left
    :param goes_with: quantities that predict it
    :param gain: share of its variance that they predict on recordings not learned from
    :param p_value: chance of that if nothing were there
    :param power: what they predict, mean square in units of the force's error
    """

    joint: str
    goes_with: tuple[str, ...]
    gain: float
    p_value: float
    power: float


def missing_force(twin: Twin, data: Trajectories, noise: Float[np.ndarray, " obs"]) -> MissingForce:
    """
    :param twin: whose values stay as they are
    :param data: measured
    :param noise: of each channel
    """
    steps = int(np.clip(round(_WINDOW / data.dt), _SHORTEST, _LONGEST))
    hypotheses = Hypotheses.about(twin, (_Push,), ())
    shots, origin = shots_of(data, steps, hypotheses.twin)
    evidence = Evidence(hypotheses, shots, noise, 1)
    point = evidence.fit(hypotheses.null, ())
    index = [hypotheses.names.index(f"push.{joint.name}.tau") for joint in twin.joints]
    scale = hypotheses.scale[index]
    slopes = evidence.slopes(point)
    scores = slopes.scores[:, index]
    informed = np.maximum(slopes.curvature[:, index, index], 1e-12)
    seen = jax.vmap(jax.vmap(lambda obs: twin.infer(obs, twin.params)))(jnp.asarray(shots.obs))
    q, v = np.asarray(seen.q, float), np.asarray(seen.v, float)
    counter = {recording: 0 for recording in origin}
    time = np.zeros(len(origin))
    for i, recording in enumerate(origin):
        time[i] = counter[recording] * (steps + 1) * data.dt
        counter[recording] += 1
    return MissingForce(
        force=-scale * scores / informed,
        stderr=scale / np.sqrt(informed),
        position=np.unwrap(q, axis=1).mean(1),
        velocity=v.mean(1),
        command=shots.actions.mean(1),
        time=time,
        origin=origin,
    )


def remainder(
    missing: MissingForce, data: Trajectories, joints: tuple[str, ...], seed: int
) -> Remainder | None:
    """
    Whether a smooth function of position, velocity, command and time, learned on one half of the
    recordings, predicts the missing force of the other half, and the other way round.

    :return: where it is and what it goes with; None if nothing is left that can be predicted
    """
    parts = split(data, missing.origin, seed)
    found: list[Remainder] = []
    for j, joint in enumerate(joints):
        quantities = {
            "position": np.concatenate(
                [np.cos(missing.position), np.sin(missing.position), missing.position], 1
            ),
            "velocity": np.concatenate(
                [missing.velocity, np.tanh(3.0 * _scaled(missing.velocity))], 1
            ),
            "command": missing.command,
            "time": missing.time[:, None],
        }
        force = weighed(missing)[:, j]
        force = np.clip(force, -_MOST_RATIO * force.std(), _MOST_RATIO * force.std())
        told = {
            names: _predicted([quantities[n] for n in names], force, parts)
            for k in (1, 2, 4)
            for names in combinations(quantities, k)
        }
        most, p_value = max(told.values())
        if most < _LEAST_GAIN or p_value * len(told) >= _LEVEL:
            continue
        enough = min((names for names in told if told[names][0] >= _MOST_OF_IT * most), key=len)
        power = told[enough][0] * float(np.mean(force**2))
        found.append(Remainder(joint, enough, *told[enough], power))
    return max(found, key=lambda r: r.gain, default=None)


def weighed(missing: MissingForce) -> Float[np.ndarray, "n dof"]:
    """:return: forces in units of their errors; those of windows that tell little count less"""
    typical = np.median(missing.stderr, 0)
    return missing.force / missing.stderr * np.minimum(1.0, typical / missing.stderr)


def _scaled(values: np.ndarray) -> np.ndarray:
    spread = values.std(0)
    return (values - values.mean(0)) / np.where(spread > 1e-9, spread, 1.0)


def _predicted(
    quantities: list[np.ndarray], force: np.ndarray, parts: Split
) -> tuple[float, float]:
    """
    Each half of the units is predicted from the other.

    :return: share of the variance that is predicted, and the chance of that if nothing were there:
        what was predicted then agrees in sign with what was measured in as many units as not, so
        the signs of whole units are flipped
    """
    features = _scaled(np.concatenate(quantities, 1))
    guess = np.zeros_like(force)
    for learn, check in ((~parts.confirm, parts.confirm), (parts.confirm, ~parts.confirm)):
        rows = np.flatnonzero(learn)[:_MOST_WINDOWS]
        guess[check] = _ridge(features[rows], force[rows], features[check])
    gain = 1.0 - np.sum((force - guess) ** 2) / np.sum(force**2)
    agreement = np.array(
        [np.sum(force[own] * guess[own]) for own in map(parts.unit.__eq__, np.unique(parts.unit))]
    )
    signs = np.random.default_rng(0).choice([-1.0, 1.0], (_N_FLIPS, len(agreement)))
    by_chance = np.sum(signs @ agreement >= agreement.sum())
    return float(gain), float((1 + by_chance) / (1 + _N_FLIPS))


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
