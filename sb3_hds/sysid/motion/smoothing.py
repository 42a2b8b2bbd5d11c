"""
Positions, velocities and accelerations of joints, with the noise of their sensors.

A polynomial is fitted to positions and velocities together in a sliding window: the widest one
whose residuals are still noise.
"""

from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Float

from sb3_hds.sysid.measurements import white_noise

# Degree of the polynomial, and half widths of its window in samples.
_DEGREE, _HALVES = 4, (3, 4, 6, 8, 11, 15, 20, 28, 40)
# A window is too wide if its residuals exceed those of the narrowest one by this factor.
_TOLERANCE = 1.15


class Smoothed(NamedTuple):
    """
    One joint along one recording.

    :param q: position [rad] or [m], shape ``(rows,)``
    :param v: velocity at the instants at which it is sampled [rad/s] or [m/s], shape ``(rows,)``
    :param a: acceleration at the same instants [rad/s2] or [m/s2]
    :param noise_q: standard deviation of a measured position
    :param noise_v: standard deviation of a measured velocity; zero where none is measured
    :param error_v: standard error of ``v``
    :param half: half width of the window [samples]
    """

    q: np.ndarray
    v: np.ndarray
    a: np.ndarray
    noise_q: float
    noise_v: float
    error_v: float
    half: int


def smooth(
    q: Float[np.ndarray, " rows"],
    v: Float[np.ndarray, " rows"] | None,
    dt: float,
    velocity_time: float = 0.0,
) -> Smoothed:
    """
    :param q: measured positions
    :param v: measured velocities; None: there are none
    :param dt: sampling interval [s]
    :param velocity_time: when a velocity is true, as
        :func:`~sb3_hds.sysid.motion.joints.velocity_time_of` has it
    """
    least = 1e-12 * (np.ptp(q) + 1e-300)
    noise_q = max(float(white_noise([q])), least)
    noise_v = 1.0 if v is None else max(float(white_noise([v])), least / dt)
    ratio = noise_q / (noise_v * dt)
    narrowest, best = None, None
    for half in _HALVES:
        if 2 * half + 1 > max(len(q) // 2, 2 * _HALVES[0] + 1) or 2 * half + 1 > len(q):
            break
        fit = _fitted(q, v, dt, ratio, half, velocity_time)
        if narrowest is None:
            narrowest = max(fit.noise_q, least), max(fit.noise_v, least / dt)
        within = (
            fit.noise_q**2 <= _TOLERANCE * narrowest[0] ** 2
            and fit.noise_v**2 <= _TOLERANCE * narrowest[1] ** 2
        )
        if best is not None and not within:
            break
        best = fit
    if best is None:
        speed = np.gradient(q, dt) if v is None else v
        return Smoothed(q, speed, np.gradient(speed, dt), noise_q, 0.0, noise_q / dt, 1)
    return best


def _fitted(
    q: np.ndarray, v: np.ndarray | None, dt: float, ratio: float, half: int, velocity_time: float
) -> Smoothed:
    """The local polynomial of one window width; ``ratio``: weight of velocities times dt."""
    steps, powers = np.arange(-half, half + 1.0), np.arange(_DEGREE + 1)

    def slope(x: np.ndarray, order: int) -> np.ndarray:
        factor = np.prod([np.maximum(powers - i, 0) for i in range(order)], axis=0)
        return np.where(powers >= order, factor * x[:, None] ** np.maximum(powers - order, 0), 0.0)

    rows = [slope(steps, 0)] + ([] if v is None else [ratio * slope(steps + velocity_time, 1)])
    solve = np.linalg.pinv(np.concatenate(rows))
    of_q, of_v = solve[:, : 2 * half + 1], ratio * dt * solve[:, 2 * half + 1 :]

    def at(x: float, order: int) -> np.ndarray:
        """In the interior the fit is a convolution; at both ends the outermost window serves."""
        here = slope(np.array([x]), order)[0]
        out = scipy.ndimage.convolve1d(q, (here @ of_q)[::-1], mode="nearest")
        if v is not None:
            out = out + scipy.ndimage.convolve1d(v, (here @ of_v)[::-1], mode="nearest")
        for edge, first in (
            (slice(0, half), 0),
            (slice(len(q) - half, None), len(q) - 2 * half - 1),
        ):
            inside = slice(first, first + 2 * half + 1)
            c = of_q @ q[inside] + (0.0 if v is None else of_v @ v[inside])
            place = np.arange(len(q))[edge] - first - half + x
            out[edge] = slope(place, order) @ c
        return out / dt**order

    place, speed, acceleration = at(0.0, 0), at(velocity_time, 1), at(velocity_time, 2)
    inner = slice(half, len(q) - half)
    hat = np.einsum("ij,ji->i", np.concatenate(rows), solve)
    noise_q = np.sqrt(np.mean((q - place)[inner] ** 2) / max(1.0 - hat[half], 0.05))
    noise_v = 0.0
    if v is not None:
        left = max(1.0 - hat[3 * half + 1], 0.05)
        noise_v = float(np.sqrt(np.mean((v - speed)[inner] ** 2) / left))
    gains = slope(np.array([velocity_time]), 1)[0] / dt
    error = np.hypot(np.linalg.norm(gains @ of_q) * noise_q, np.linalg.norm(gains @ of_v) * noise_v)
    return Smoothed(place, speed, acceleration, float(noise_q), noise_v, float(error), half)
