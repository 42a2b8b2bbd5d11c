"""Data of the figures of a diagnosis, ready to draw."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from sb3_hds.sysid.comparison.halves import NOT_FINITE, Half
from sb3_hds.sysid.comparison.unexplained import ResidualForce
from sb3_hds.sysid.equation.members import FrictionCurve
from sb3_hds.sysid.estimation.evidence import Point

# Half the width of a 90 % interval of a normal distribution, in standard deviations.
_NORMAL_90 = 1.645
# Least number of windows that are shown.
_LEAST_SHOWN = 16


class Replay(NamedTuple):
    """
    Held-out stretches, simulated in windows from start states of their own.

    :param time: since its first window [s], shape ``(rows,)``; not a number between windows
    :param measured: shape ``(rows, n_obs)``
    :param before: by the nominal model, nuisances refitted
    :param after: by the extended twin
    :param margin: half the width of its 90 % interval, by its errors in all held-out windows
    """

    time: Float[np.ndarray, " rows"]
    measured: Float[np.ndarray, "rows obs"]
    before: Float[np.ndarray, "rows obs"]
    after: Float[np.ndarray, "rows obs"]
    margin: Float[np.ndarray, "rows obs"]


class Pictures(NamedTuple):
    """
    :param channels: name and unit of each observation
    :param joints: name and unit of each joint's force
    :param actuators: name and unit of each command
    :param replay: of one recording
    :param steps: ahead, shape ``(k,)``
    :param errors: root mean square over all held-out windows, in units of the noise, before and
        after, shape ``(2, k)``
    :param missing: residual force of the nominal model
    :param left: residual force of the extended model
    :param friction: against velocity, of joints at which friction was found
    """

    channels: tuple[tuple[str, str], ...]
    joints: tuple[tuple[str, str], ...]
    actuators: tuple[tuple[str, str], ...]
    replay: Replay
    steps: np.ndarray
    errors: np.ndarray
    missing: ResidualForce
    left: ResidualForce
    friction: tuple[FrictionCurve, ...] = ()


def replay_of(
    measured: Float[np.ndarray, "n rows obs"],
    before: Float[np.ndarray, "n rows obs"],
    after: Float[np.ndarray, "n rows obs"],
    rms: Float[np.ndarray, "rows obs"],
    dt: float,
) -> Replay:
    """
    :param measured: windows, one after the other
    :param before: simulated minus measured
    :param after: simulated minus measured
    :param rms: root mean square error of the extended twin over all windows
    """
    n, rows = measured.shape[:2]
    gap = lambda windows: np.concatenate(  # noqa: E731
        [windows, np.full((n, 1, windows.shape[2]), np.nan)], 1
    ).reshape(n * (rows + 1), -1)
    time = np.arange(n * (rows + 1), dtype=float) * dt
    time -= np.repeat(np.arange(n), rows + 1) * dt
    time[rows :: rows + 1] = np.nan
    margin = gap(np.broadcast_to(_NORMAL_90 * rms, measured.shape))
    return Replay(time, gap(measured), gap(measured + before), gap(measured + after), margin)


def bounded(errors: np.ndarray) -> np.ndarray:
    """:return: the errors, clipped where a simulation diverged"""
    return np.nan_to_num(np.minimum(errors, NOT_FINITE), nan=NOT_FINITE)


def _shown(cluster: Int[np.ndarray, " n"]) -> Int[np.ndarray, " k"]:
    """
    :param cluster: recording, or piece of one, of each window
    :return: indices of the windows of the first recordings that have enough of them
    """
    shown = np.zeros(len(cluster), bool)
    for one in dict.fromkeys(cluster.tolist()):
        shown |= cluster == one
        if shown.sum() >= _LEAST_SHOWN:
            break
    return np.flatnonzero(shown)


def pictures_of(
    half: Half,
    before: Point,
    after: Point,
    thinning: int,
    missing: ResidualForce,
    left: ResidualForce,
    friction: tuple[FrictionCurve, ...],
) -> Pictures:
    """
    :param thinning: steps of the data in one of the windows
    :param missing: residual force of the nominal model
    :param left: residual force of the extended model
    :param friction: against velocity
    """
    evidence, twin = half.evidence, half.evidence.hypotheses.twin
    rows = _shown(half.cluster)
    measured = np.asarray(evidence.shots.obs)[rows]
    errors = [
        np.sqrt(np.mean(bounded((point.residual / evidence.noise) ** 2), (0, 2)))
        for point in (before, after)
    ]
    rms = np.sqrt(np.mean(after.residual**2, 0))
    return Pictures(
        channels=tuple((c.name, c.unit) for c in twin.channels),
        joints=tuple((j.name, "N" if j.unit == "m" else "N m") for j in twin.joints),
        actuators=tuple((a.name, a.unit) for a in twin.actuators),
        replay=replay_of(measured, before.residual[rows], after.residual[rows], rms, twin.dt),
        steps=thinning * np.arange(measured.shape[1]),
        errors=np.stack(errors),
        missing=missing,
        left=left,
        friction=friction,
    )
