"""Typical sizes of parameters on a given machine: a servo and a 100 kg axis share one catalogue."""

import dataclasses
import math
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from sb3_hds.core import AnalyticTwin, Trajectories, Twin
from sb3_hds.core.twin import plant_of
from sb3_hds.errors import EffectError
from sb3_hds.sysid.estimation.evidence import Evidence
from sb3_hds.sysid.estimation.hypotheses import Hypotheses
from sb3_hds.sysid.motion.joints import motion_of

# A typical size moves what is predicted by this share of what is measured.
_SHARE = 0.05
# Of the largest command, speed and excursion, where a parameter moves nothing at its null.
_OF_COMMAND, _OF_SPEED, _OF_POSITION = 0.2, 0.1, 0.2
# A spring between motor and load stretches by this share of the excursion under a typical torque.
_STRETCH = 0.4
# Of an admissible range.
_OF_RANGE = 0.1
_NOTHING = 1e-15


class _Moved(NamedTuple):
    """Largest speed, excursion and torque of each joint; no torque where inertias are unknown."""

    speeds: np.ndarray
    excursions: np.ndarray
    torques: np.ndarray


def sized(evidence: Evidence, data: Trajectories) -> Hypotheses:
    """
    :param evidence: windows, with the standard deviation of each channel as its noise
    :raises EffectError: if the twin ignores the effects that are passed to its step
    :return: the hypotheses, with a scale for each parameter that these windows are sensitive to,
        and start values for those that need several
    """
    h = evidence.hypotheses
    point = evidence.fit(h.null, ())
    curvature = np.diag(evidence.slopes(point).curvature.sum(0))
    if not np.any(curvature[list(h.pushes)] > 0.0):
        raise EffectError(
            f"A force at {', '.join(joint.name for joint in h.twin.joints)} moves nothing in "
            f"{h.nominal.name}: its step(state, action, params, effects) does not use the effects "
            "that it is given, so nothing that they do could be found. sb3_hds.core.AnalyticTwin "
            "has a step that does."
        )
    seen = curvature > _NOTHING * point.residual.size
    moved = _motion(h, data)
    scale = np.where(seen, h.scale, _unseen(h, data, moved))
    scale[seen] *= _SHARE * np.sqrt(point.residual.size / curvature[seen])
    # Without a slope a parameter may be a switch, which a tenth of its range does not turn.
    most = np.where(seen, _OF_RANGE, 1.0) * (h.upper - h.lower)
    return dataclasses.replace(h, scale=np.minimum(scale, most), starts=_starts(h, moved))


def _starts(h: Hypotheses, moved: _Moved) -> dict[str, tuple[dict[str, float], ...]]:
    found = {}
    for candidate in (*h.candidates, *h.nameless):
        effect = h.effect_of(candidate)
        if effect is None or candidate.slot != "joint":
            continue
        turn = 2.0 * math.pi if h.twin.joints[candidate.index].unit == "rad" else math.inf
        excursion = min(float(moved.excursions[candidate.index]), turn)
        speed = float(moved.speeds[candidate.index])
        if excursion > 0.0 and (starts := effect.starts(excursion, speed)):
            found[candidate.key] = tuple(
                {f"{candidate.key}.{name}": value for name, value in start.items()}
                for start in starts
            )
    return found


def _unseen(h: Hypotheses, data: Trajectories, moved: _Moved) -> Float[np.ndarray, " p"]:
    """Scales of what has no slope at its null, by the unit: a limit, a speed, a place, a spring."""
    scale = h.scale.copy()
    commands = np.abs(data.actions).max((0, 1)) if data.n_act else np.zeros(0)
    speeds, excursions, torques = moved
    with np.errstate(divide="ignore", invalid="ignore"):
        springs = torques / (_STRETCH * excursions)
    for candidate in (*h.candidates, *h.nameless):
        for name, i in zip(candidate.parameters, h.indices(candidate), strict=True):
            unit = h.parameter(name).unit
            if candidate.slot == "actuator":
                if candidate.index < 0:
                    continue
                if unit == h.twin.actuators[candidate.index].unit and commands[candidate.index]:
                    scale[i] = _OF_COMMAND * commands[candidate.index]
            elif candidate.slot == "joint":
                joint = h.twin.joints[candidate.index]
                if unit == f"{joint.unit}/s" and speeds[candidate.index]:
                    scale[i] = _OF_SPEED * speeds[candidate.index]
                elif unit == joint.unit and joint.unit == "m" and excursions[candidate.index]:
                    scale[i] = _OF_POSITION * excursions[candidate.index]
                elif np.isfinite(spring := springs[candidate.index]) and spring > 0.0:
                    if unit.endswith(f" s/{joint.unit}"):
                        scale[i] = spring * data.dt
                    elif unit.endswith(f"/{joint.unit}"):
                        scale[i] = spring
    return scale


def _motion(h: Hypotheses, data: Trajectories) -> _Moved:
    parts = [motion_of(h.nominal, data.episode(i)[0][None], data.dt) for i in range(len(data))]
    q, v = (np.concatenate([part[k][0] for part in parts]) for k in (0, 1))
    change = np.concatenate([np.diff(part[1][0], axis=0) for part in parts]) / data.dt
    speeds, faster = (np.quantile(np.abs(x), 0.98, axis=0) for x in (v, change))
    return _Moved(speeds, q.max(0) - q.min(0), faster * _inertias(h.nominal, data))


def _inertias(twin: Twin, data: Trajectories) -> np.ndarray:
    plant = plant_of(twin)
    if not isinstance(plant, AnalyticTwin):
        return np.full(len(twin.joints), np.nan)
    start = twin.infer(jnp.asarray(data.obs[0, 0]), twin.params)
    return np.diag(np.asarray(plant.mass_matrix(start.q, plant.params)))
