"""Joint positions and velocities, as the observations of a twin's channels give them."""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sb3_hds.core import Params, Trajectories, Twin, explicit_euler, semi_implicit_euler
from sb3_hds.core.numerics.compilation import QUICKEST_COMPILATION
from sb3_hds.core.twin import plant_of
from sb3_hds.sysid.measurements import FEWEST_CLUSTERS, N_STRETCHES

# Samples that give the first velocity, and that show whether velocities are measured at all.
_FEW, _SOME = 5, 50
# Positions and velocities are compared over this share of a period; they disagree by more than this
# many standard errors and this share of the speed or scale.
_PART, _SURE, _SCALE = 0.25, 4.0, 0.005
# All rows but the last, and all but the first.
_PAIRS = (slice(None, -1), slice(1, None))


class Encoder(NamedTuple):
    """
    :param position: index of the channel that reports a joint's position
    :param velocity: of the one that reports its velocity; None if there is none
    """

    position: int
    velocity: int | None

    @property
    def channels(self) -> tuple[int, ...]:
        """Indices of all channels that it feeds."""
        return (self.position,) if self.velocity is None else (self.position, self.velocity)


def encoders(twin: Twin) -> dict[int, Encoder]:
    """:return: by joint, where channels are positions and velocities themselves"""
    twin = plant_of(twin)
    dof = len(twin.joints)
    state = twin.initial(jax.random.key(0), twin.params)
    if state.q.shape != (dof,):
        return {}

    def seen(x: jax.Array) -> jax.Array:
        return twin.observe(state._replace(q=x[:dof], v=x[dof:]), twin.params)

    here = jnp.concatenate([0.3 + 0.1 * jnp.arange(dof), 0.7 - 0.1 * jnp.arange(dof)])
    slopes, values = np.asarray(jax.jacfwd(seen)(here)), np.asarray(seen(here))
    unit = np.abs(np.abs(slopes).sum(1) - 1.0) < 1e-6
    found = {}
    for j in range(dof):
        places = [
            [
                i
                for i in np.flatnonzero(unit)
                if np.isclose(slopes[i, k], 1.0) and np.isclose(values[i], here[k], atol=1e-5)
            ]
            for k in (j, dof + j)
        ]
        if len(places[0]) == 1 and len(places[1]) <= 1:
            velocity = int(places[1][0]) if places[1] else None
            found[j] = Encoder(int(places[0][0]), velocity)
    return found


def motion_of(
    twin: Twin, obs: Float[np.ndarray, "n rows obs"], dt: float
) -> tuple[Float[np.ndarray, "n rows dof"], Float[np.ndarray, "n rows dof"]]:
    """
    :param obs: measurements in a row, every ``dt`` [s]
    :return: positions, and velocities; where no velocity is observed, differences of positions
    """
    q, v, ways = _read(twin, obs, twin.params)
    if q.shape[1] > 1 and not v.any():
        v = _rates(ways, dt)
    return q, v


def first_offsets(
    twin: Twin, obs: Float[np.ndarray, "n rows n_obs"], dt: float, params: Params | None = None
) -> Float[np.ndarray, "n free"]:
    """
    Where a search for start states begins.

    :param params: under which measurements are read; default: the twin's own
    :return: offsets from the first measurements: zero, except for velocities that are not observed,
        which come from differences of positions
    """
    q, v, ways = _read(twin, obs[:, :_FEW], twin.params if params is None else params)
    v = np.zeros_like(q) if v[:, 0].any() else _rates(ways, dt)
    return np.concatenate([np.zeros_like(q[:, 0]), v.mean(1)], 1)


def _read(twin: Twin, obs: np.ndarray, params: Params) -> tuple[np.ndarray, ...]:
    return tuple(np.asarray(part, float) for part in _inferred(twin, jnp.asarray(obs), params))


@partial(jax.jit, static_argnums=0, compiler_options=QUICKEST_COMPILATION)
def _inferred(twin: Twin, obs: Float[Array, "n rows obs"], params: Params) -> tuple[Array, ...]:
    """Positions and velocities of joints, and the way from each position to the next."""

    def one(rows: Array) -> tuple[Array, ...]:
        seen = jax.vmap(lambda row: twin.infer(row, params))(rows)
        before, after = (jax.tree.map(lambda leaf, s=s: leaf[s], seen) for s in _PAIRS)
        ways = jax.vmap(twin.difference)(after, before)[:, : len(twin.joints)]
        return jax.vmap(twin.coordinates)(seen.q), seen.v, ways

    return jax.vmap(one)(obs)


def joint_motion(twin: Twin, data: Trajectories) -> list[tuple[np.ndarray, np.ndarray]]:
    """:return: positions and velocities of each recording as measured, each ``(rows, dof)``"""
    found = []
    for i in range(len(data)):
        obs = np.asarray(data.episode(i)[0], float)[None]
        q, v = (leaf[0] for leaf in motion_of(twin, obs, data.dt))
        found.append((_unwrapped(twin, q), v))
    return found


def _unwrapped(twin: Twin, q: np.ndarray) -> np.ndarray:
    """Angles that stay within a turn may be wrapped; others count turns, or degrees."""
    q = q.copy()
    for j, joint in enumerate(twin.joints):
        inside = np.abs(q[:, j] - (np.pi if q[:, j].min() >= 0.0 else 0.0)) <= np.pi + 1e-3
        if joint.unit == "rad" and inside.all():
            q[:, j] = np.unwrap(q[:, j])
    return q


def measures_velocity(twin: Twin, data: Trajectories) -> np.ndarray:
    """:return: which velocities come from a sensor: without one, ``infer`` returns zero"""
    obs = jnp.asarray(data.episode(0)[0][:_SOME])
    speeds = jax.vmap(lambda row: twin.infer(row, twin.params).v)(obs)
    return np.any(np.asarray(speeds), axis=0)


def velocity_time_of(twin: Twin) -> float:
    """
    :return: when a velocity of the twin is true, in intervals, positive after its position and
        negative before it (a velocity that is late was true before): Euler's rules update one of
        them with the other from a sub-step before or after
    """
    integrator = getattr(plant_of(twin), "integrator", None)
    if integrator is semi_implicit_euler:
        return -0.5 / twin.substeps
    return 0.5 / twin.substeps if integrator is explicit_euler else 0.0


def differences(
    q: Float[np.ndarray, "rows dof"], dt: float, velocity_time: float
) -> Float[np.ndarray, "rows dof"]:
    """
    :param velocity_time: when a velocity is true, as :func:`velocity_time_of` has it, between -0.5
        and 0.5
    :return: velocities from differences to the rows before and after
    """
    return _rates(np.diff(q, axis=0), dt, velocity_time)


def _rates(ways: np.ndarray, dt: float, velocity_time: float = 0.0) -> np.ndarray:
    """Velocities at all rows, from the ways between them, shape ``(..., rows - 1, dof)``."""
    rates = ways / dt
    before = np.concatenate([rates[..., :1, :], rates], -2)
    after = np.concatenate([rates, rates[..., -1:, :]], -2)
    return (0.5 - velocity_time) * before + (0.5 + velocity_time) * after


class Kinematics(NamedTuple):
    """
    Measured velocities beside the derivatives of their positions, of each joint.

    :param scale: of the velocity, in units of that of the derivative
    :param zero: of the velocity [rad/s] or [m/s]
    :param velocity_time: when a velocity is true, as :func:`velocity_time_of` has it
    :param agrees: whether scale and zero are right
    """

    scale: np.ndarray
    zero: np.ndarray
    velocity_time: np.ndarray
    agrees: np.ndarray


def kinematics(
    recordings: Sequence[tuple[np.ndarray, np.ndarray]], dt: float, period: np.ndarray
) -> Kinematics:
    """
    Differences of positions over parts of a period, regressed on integrals of the velocity, on the
    time and on differences of the velocity; errors are clustered by recording, or by stretches of
    recordings where there are few: the scores of a single cluster add up to nothing.

    :param recordings: positions and velocities as measured, each of shape ``(rows, dof)``
    """
    dof = len(period)
    theta, agrees = np.zeros((dof, 3)), np.zeros(dof, bool)
    for j in range(dof):
        steps = max(2, round(_PART * period[j] / dt)) if np.isfinite(period[j]) else 2
        tables, rights = [], []
        for q, v in recordings:
            places = np.arange(0, len(q), steps)
            if len(places) < 2:
                continue
            trapezoids = np.concatenate([[0.0], np.cumsum(0.5 * (v[1:, j] + v[:-1, j]))]) * dt
            summed, change = np.diff(trapezoids[places]), np.diff(v[places, j]) * dt
            tables.append(np.stack([summed, np.full_like(summed, steps * dt), change], 1))
            rights.append(np.diff(q[places, j]))
        if not tables:
            continue
        table, right = np.concatenate(tables), np.concatenate(rights)
        size = np.sqrt(np.mean(table**2, 0)) + 1e-300
        inverse = np.linalg.pinv((table / size).T @ (table / size))
        theta[j] = inverse @ (table / size).T @ right / size
        few = len(tables) < FEWEST_CLUSTERS
        scores = [
            part.sum(0)
            for x, y in zip(tables, rights, strict=True)
            for part in _stretches(
                x * (y - x @ theta[j])[:, None], -(-N_STRETCHES // len(tables)) if few else 1
            )
        ]
        n = len(scores)
        by_cluster = np.stack(scores) / size
        covariance = inverse @ by_cluster.T @ by_cluster @ inverse
        error = np.sqrt(np.diag(covariance) * n / max(n - 1, 1)) / size
        speed = np.sqrt(np.mean(right**2)) / (steps * dt)
        agrees[j] = abs(theta[j, 0] - 1.0) <= max(_SURE * error[0], _SCALE) and abs(
            theta[j, 1]
        ) <= max(_SURE * error[1], _SCALE * speed)
    return Kinematics(
        1.0 / np.where(theta[:, 0], theta[:, 0], np.inf), -theta[:, 1], -theta[:, 2], agrees
    )


def _stretches(rows: np.ndarray, n: int) -> list[np.ndarray]:
    return [part for part in np.array_split(rows, n) if len(part)]
