"""Joint positions, velocities and accelerations of recordings, smoothed, at a suitable interval."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Float

from sb3_hds.core import Params, Trajectories, Twin, rollout
from sb3_hds.core.numerics.compilation import QUICKEST_COMPILATION
from sb3_hds.sysid.motion.joints import (
    differences,
    joint_motion,
    kinematics,
    measures_velocity,
    velocity_time_of,
)
from sb3_hds.sysid.motion.smoothing import Smoothed, smooth

#: units of commands that are targets of a servo
SET_POINTS = ("rad", "rad/s", "m", "m/s", "deg", "deg/s")
# Rows of all recordings below which none are dropped, and samples per period of the motion
# otherwise: dry friction reverses faster than a joint swings.
_ENOUGH, _PER_PERIOD = 10_000, 100
# A joint moves if its excursion exceeds its sensor's noise by this factor.
_STILL = 3.0


class JointMotion(NamedTuple):
    """
    One recording in joint space, every leaf of shape ``(rows, dof)`` but the actions.

    :param q: smoothed positions [rad] or [m]
    :param v: smoothed velocities
    :param a: smoothed accelerations
    :param measured_v: velocities as they were measured, or differences of positions
    :param actions: held from row to row, shape ``(rows - 1, n_act)``
    """

    q: np.ndarray
    v: np.ndarray
    a: np.ndarray
    measured_v: np.ndarray
    actions: np.ndarray


class Motion(NamedTuple):
    """
    :param recordings: in order
    :param origin: recording that each trajectory is from, shape ``(n,)``
    :param dt: interval of the rows [s]
    :param thinning: samples of the data in one interval
    :param measured: whether a joint's velocity is measured, shape ``(dof,)``
    :param noise_q: of each joint's position sensor
    :param noise_v: of each joint's velocity sensor, or of the differences that stand for it
    :param error_v: standard error of the smoothed velocities
    :param period: of each joint's motion, ``2 pi rms(v) / rms(a)`` [s]
    :param blurred: intervals over which smoothing blurs a start or a stop, of each joint
    :param seen: share of an interval within which the twin's integrator evaluates forces
    :param turn: of each joint, one turn [rad], or infinity where it slides
    :param agrees: whether a measured velocity is the derivative of its position
    """

    recordings: tuple[JointMotion, ...]
    origin: np.ndarray
    dt: float
    thinning: int
    measured: np.ndarray
    noise_q: np.ndarray
    noise_v: np.ndarray
    error_v: np.ndarray
    period: np.ndarray
    blurred: np.ndarray
    seen: float
    turn: np.ndarray
    agrees: np.ndarray

    @property
    def speed(self) -> Float[np.ndarray, " dof"]:
        """Root mean square velocity of each joint."""
        return _rms([r.v for r in self.recordings])

    @property
    def excursion(self) -> Float[np.ndarray, " dof"]:
        """Range of each joint's positions over all recordings."""
        return np.ptp(np.concatenate([r.q for r in self.recordings]), axis=0)

    @property
    def fastest(self) -> float:
        """Period of the fastest joint that moves [s]; where none does, that of the recordings."""
        own = self.moves & np.isfinite(self.period)
        return float(np.min(self.period[own], initial=self._length))

    @property
    def typical_period(self) -> float:
        """Geometric mean over the joints that move [s]; where none does, that of the recordings."""
        own = self.period[self.moves & np.isfinite(self.period) & (self.period > 0.0)]
        return float(np.exp(np.mean(np.log(own)))) if len(own) else self._length

    def twin(self, twin: Twin) -> Twin:
        """:return: a twin of the data's interval, at that of the rows"""
        return (
            twin.at_interval(self.dt, twin.substeps * self.thinning) if self.thinning > 1 else twin
        )

    @property
    def _length(self) -> float:
        return float(np.median([len(r.actions) for r in self.recordings])) * self.dt

    @property
    def moves(self) -> np.ndarray:
        """Whether a joint moves by more than its sensor's noise."""
        return self.excursion > _STILL * self.noise_q


def smoothed_motion(twin: Twin, data: Trajectories) -> Motion:
    """
    :param twin: reads positions and velocities from observations
    :param data: measured, sampled at the twin's ``dt``
    """
    velocity_time = velocity_time_of(twin)
    actions = [np.asarray(data.episode(i)[1], float) for i in range(len(data))]
    logged = [(*pair, u) for pair, u in zip(joint_motion(twin, data), actions, strict=True)]
    measured = measures_velocity(twin, data)
    expected = _by_the_model(twin, data)
    found = [
        _smoothed(q, v, measured, data.dt, velocity_time, known)
        for (q, v, _), known in zip(logged, expected, strict=True)
    ]
    values = [
        tuple(np.stack([getattr(c, name) for c in columns], 1) for name in ("q", "v", "a"))
        for columns in found
    ]

    def typical(name: str) -> np.ndarray:
        """Of each joint, the median over recordings."""
        return np.median([[getattr(c, name) for c in cs] for cs in found], axis=0)

    period = 2.0 * np.pi * _rms([v[1] for v in values]) / (_rms([v[2] for v in values]) + 1e-300)
    thinning = max(
        1, int(np.min(period[np.isfinite(period)], initial=np.inf) / (_PER_PERIOD * data.dt))
    )
    thinning = min(thinning, max(1, int(data.lengths.min()) // _PER_PERIOD))
    thinning = min(thinning, -(-int(data.lengths.sum()) // _ENOUGH))
    recordings = []
    for (q, v, commands), smoothed, known in zip(logged, values, expected, strict=True):
        measured_v = v.copy()
        still = ~measured
        if still.any():
            measured_v[:, still] = _differences(q, data.dt, velocity_time, known)[:, still]
        recordings.append(_thinned(smoothed, measured_v, commands, thinning))
    noise_q, noise_v = typical("noise_q"), typical("noise_v")
    noise_v = np.where(measured, noise_v, np.sqrt(0.5 + 6.0 * velocity_time**2) * noise_q / data.dt)
    return Motion(
        tuple(recordings),
        np.asarray(data.origin),
        thinning * data.dt,
        thinning,
        measured,
        noise_q,
        noise_v / np.sqrt(thinning),
        typical("error_v"),
        period,
        np.maximum(np.ceil(0.5 * typical("half") / thinning), 2.0).astype(int),
        1.0 if velocity_time == 0.0 else 1.0 - 1.0 / (twin.substeps * thinning),
        np.array([2.0 * np.pi if joint.unit == "rad" else np.inf for joint in twin.joints]),
        measured & kinematics([(q, v) for q, v, _ in logged], data.dt, period).agrees,
    )


#: positions and velocities that the model alone predicts of one recording, each ``(rows, dof)``
_Expected = tuple[np.ndarray, np.ndarray]


def _by_the_model(twin: Twin, data: Trajectories) -> list[_Expected | None]:
    """
    A servo follows a step of its set point within a sample, and no local polynomial has such a
    corner. Its model has, and the residual of the model is smooth.

    :return: of each recording; None where commands are no set points, or the model diverges
    """
    if not all(actuator.unit in SET_POINTS for actuator in twin.actuators):
        return [None] * len(data)
    n = int(data.lengths.max())
    starts, commands = [], []
    for i in range(len(data)):
        obs, actions = data.episode(i)
        starts.append(np.asarray(obs[0], float))
        last = np.repeat(actions[-1:], n - len(actions), axis=0)
        commands.append(np.concatenate([actions, last]))
    with jax.enable_x64(True):
        params = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), dict(twin.params))
        given = jnp.asarray(starts, jnp.float64), jnp.asarray(commands, jnp.float64)
        q, v = map(np.asarray, _simulated(twin, params, *given))
    rows = [int(length) + 1 for length in data.lengths]
    found = [(q[i, :m], v[i, :m]) for i, m in enumerate(rows)]
    return [pair if all(np.isfinite(x).all() for x in pair) else None for pair in found]


@partial(jax.jit, static_argnums=0, compiler_options=QUICKEST_COMPILATION)
def _simulated(twin: Twin, params: Params, starts: Array, commands: Array) -> tuple[Array, Array]:
    def one(start: Array, actions: Array) -> tuple[Array, Array]:
        states = rollout(twin, params, twin.infer(start, params), actions).states
        return states.q, states.v

    return jax.vmap(one)(starts, commands)


def _smoothed(
    q: np.ndarray,
    v: np.ndarray,
    measured: np.ndarray,
    dt: float,
    velocity_time: float,
    expected: _Expected | None,
) -> list[Smoothed]:
    """:return: each joint, smoothed relative to the model's prediction where that is less noisy"""
    found = []
    for j in range(q.shape[1]):
        own = smooth(q[:, j], v[:, j] if measured[j] else None, dt, velocity_time)
        if expected is not None:
            beside = expected[0][:, j], expected[1][:, j]
            left = q[:, j] - beside[0], v[:, j] - beside[1] if measured[j] else None
            rest = smooth(*left, dt, velocity_time)
            if rest.noise_q < own.noise_q and rest.noise_v <= own.noise_v:
                own = rest._replace(
                    q=beside[0] + rest.q,
                    v=beside[1] + rest.v,
                    a=np.gradient(beside[1], dt) + rest.a,
                )
        found.append(own)
    return found


def _differences(
    q: np.ndarray, dt: float, velocity_time: float, expected: _Expected | None
) -> np.ndarray:
    if expected is None:
        return differences(q, dt, velocity_time)
    return expected[1] + differences(q - expected[0], dt, velocity_time)


def _thinned(
    smoothed: tuple[np.ndarray, ...], measured_v: np.ndarray, actions: np.ndarray, thinning: int
) -> JointMotion:
    q, v, a = smoothed
    if thinning == 1:
        return JointMotion(q, v, a, measured_v, actions)
    n = len(actions) // thinning
    rows = slice(0, n * thinning + 1, thinning)
    held = actions[: n * thinning].reshape(n, thinning, actions.shape[1]).mean(1)
    # A cubic through its neighbours: noise is averaged, motion is not.
    averaged = np.stack([smooth_mean(x, thinning) for x in measured_v.T], 1)
    return JointMotion(q[rows], v[rows], a[rows], averaged[rows], held)


def smooth_mean(x: np.ndarray, half: int) -> np.ndarray:
    """:return: the value of a local cubic in windows of ``2 half + 1`` samples"""
    width = min(2 * half + 1, len(x) - (1 - len(x) % 2))
    return np.asarray(scipy.signal.savgol_filter(x, width, 3, mode="interp")) if width > 3 else x


def _rms(pieces: list[np.ndarray]) -> np.ndarray:
    return np.sqrt(np.mean(np.concatenate(pieces) ** 2, axis=0))
