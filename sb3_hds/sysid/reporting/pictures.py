"""What a diagnosis shows: numbers ready to draw."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from sb3_hds.sysid.comparison.unexplained import MissingForce

# Of a normal distribution, 90 % lie within so many standard deviations.
_NORMAL_90 = 1.645


class Replay(NamedTuple):
    """
    One held-out recording, simulated in windows from start states of their own.

    :param time: since its first window [s], shape ``(rows,)``; not a number between windows
    :param measured: shape ``(rows, n_obs)``
    :param before: by the twin as it came, nuisances refitted
    :param after: by the extended twin
    :param margin: half the width of its 90 % interval, by what it misses in all held-out windows
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
    :param missing: the force that is missing before
    :param left: and after
    """

    channels: tuple[tuple[str, str], ...]
    joints: tuple[tuple[str, str], ...]
    actuators: tuple[tuple[str, str], ...]
    replay: Replay
    steps: np.ndarray
    errors: np.ndarray
    missing: MissingForce
    left: MissingForce


def replay_of(
    measured: Float[np.ndarray, "n rows obs"],
    before: Float[np.ndarray, "n rows obs"],
    after: Float[np.ndarray, "n rows obs"],
    rms: Float[np.ndarray, "rows obs"],
    dt: float,
) -> Replay:
    """
    :param measured: windows of one recording, one after the other
    :param before: simulated minus measured
    :param after: simulated minus measured
    :param rms: what the extended twin misses in any window, root mean square
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
