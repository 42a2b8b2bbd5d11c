"""Short windows of measured motion, and their simulation by a twin from the same state."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sb3_hds.core.numerics.compilation import QUICKEST_COMPILATION
from sb3_hds.core.trajectories import Trajectories
from sb3_hds.core.twin import State, Twin
from sb3_hds.data.resampling.values import unwrapped

_SECONDS, _FEWEST_STEPS, _MOST_STEPS = 0.3, 6, 60  # of a window, within these numbers of steps
_MOST_WINDOWS = 64  # windows
_LEAD = 2  # rows before and after the start of a window, for estimating its velocity
_SLOPE_WEIGHTS = np.array([-2.0, -1.0, 0.0, 1.0, 2.0]) / 10.0  # slope of a line through five rows


class Windows(NamedTuple):
    """
    Windows of equal length.

    :param obs: shape ``(n, lead + steps + 1, n_obs)``
    :param actions: from the start on, shape ``(n, steps, n_act)``
    """

    obs: Float[np.ndarray, "n rows n_obs"]
    actions: Float[np.ndarray, "n steps n_act"]


class Replay(NamedTuple):
    """
    Positions in windows, shape ``(n, steps + 1, dof)``, and simulated observations.

    :param measured: positions
    :param extrapolated: at constant velocity
    :param simulated: by the twin
    :param obs: of the twin, shape ``(n, steps + 1, n_obs)``
    """

    measured: Float[np.ndarray, "n rows dof"]
    extrapolated: Float[np.ndarray, "n rows dof"]
    simulated: Float[np.ndarray, "n rows dof"]
    obs: Float[np.ndarray, "n rows n_obs"]

    def unexplained_share(self) -> Float[np.ndarray, " dof"]:
        """:return: mean squared error relative to that of a constant velocity, for each joint"""
        return self._median_ratio(self.simulated - self.measured)

    def acceleration_ratio(self) -> Float[np.ndarray, " dof"]:
        """
        :return: displacement due to the simulated acceleration over that due to the measured one
        """
        return np.sqrt(self._median_ratio(self.simulated - self.extrapolated))

    def _median_ratio(self, part: Float[np.ndarray, "n rows dof"]) -> np.ndarray:
        """Median over the half of the windows in which a joint accelerates most."""
        # A simulation without the friction of a machine may diverge: its error is infinite then.
        with np.errstate(over="ignore", invalid="ignore"):
            size, total = (np.sum(x**2, axis=1) for x in (part, self.measured - self.extrapolated))
        fast = total >= np.median(total, axis=0)
        ratio = size / np.maximum(total, np.finfo(float).tiny)
        ratio = np.where(np.isfinite(ratio), ratio, np.inf)
        return np.array([np.median(r[chosen]) for r, chosen in zip(ratio.T, fast.T, strict=True)])


def windows_of(data: Trajectories) -> Windows | None:
    """:return: up to 64 windows, spread over the data; None if no trajectory is long enough"""
    wanted = int(np.clip(round(_SECONDS / data.dt), _FEWEST_STEPS, _MOST_STEPS))
    steps = min(wanted, int(data.lengths.max()) - _LEAD)
    if steps < _FEWEST_STEPS:
        return None
    begins = [
        (i, k)
        for i, n in enumerate(data.lengths.tolist())
        for k in range(0, n - _LEAD - steps + 1, steps)
    ]
    chosen = np.unique(np.linspace(0, len(begins) - 1, _MOST_WINDOWS).round().astype(int))
    obs, actions = [], []
    for i, k in (begins[c] for c in chosen):
        obs.append(data.obs[i, k : k + _LEAD + steps + 1])
        actions.append(data.actions[i, k + _LEAD : k + _LEAD + steps])
    return Windows(np.array(obs), np.array(actions))


def replay(twin: Twin, windows: Windows, scale: Float[np.ndarray, " n_obs"]) -> Replay:
    """
    Simulate each window from measured positions, and velocities estimated from these.

    :param scale: factor of each channel to the unit of the twin
    """
    obs = windows.obs * scale
    with jax.enable_x64(True):
        q = np.array(_positions(twin, jnp.asarray(obs), twin.params))
        for row in q:
            row[...] = np.stack([unwrapped(column) for column in row.T], axis=1)
        v = np.einsum("k,nkd->nd", _SLOPE_WEIGHTS, q[:, : 2 * _LEAD + 1]) / twin.dt
        start = jnp.asarray(obs[:, _LEAD]), jnp.asarray(q[:, _LEAD]), jnp.asarray(v)
        simulated, seen = _simulated(twin, *start, jnp.asarray(windows.actions), twin.params)
    measured = q[:, _LEAD:]
    time = twin.dt * np.arange(measured.shape[1])[None, :, None]
    extrapolated = measured[:, :1] + v[:, None] * time
    return Replay(measured, extrapolated, np.asarray(simulated), np.asarray(seen))


def position_channels(twin: Twin, windows: Windows) -> dict[int, int]:
    """:return: the channel that measures the position of a joint directly, for each such joint"""
    first = windows.obs[:1]
    found = {}
    with jax.enable_x64(True):
        q = np.asarray(_positions(twin, jnp.asarray(first), twin.params))
        for channel in range(first.shape[-1]):
            doubled = jnp.asarray(np.where(np.arange(first.shape[-1]) == channel, 2.0, 1.0) * first)
            twice = np.asarray(_positions(twin, doubled, twin.params))
            follows = np.isclose(twice, 2.0 * q, rtol=1e-6).all((0, 1)) & (q != 0.0).any((0, 1))
            found |= {joint: channel for joint in np.flatnonzero(follows).tolist()}
    return found


@partial(jax.jit, static_argnums=0, compiler_options=QUICKEST_COMPILATION)
def _positions(twin: Twin, obs: Array, params: dict[str, Array]) -> Array:
    return jax.vmap(jax.vmap(lambda row: twin.infer(row, params).q))(obs)


@partial(jax.jit, static_argnums=0, compiler_options=QUICKEST_COMPILATION)
def _simulated(
    twin: Twin, obs: Array, q: Array, v: Array, actions: Array, params: dict[str, Array]
) -> tuple[Array, Array]:
    """Simulate without termination."""

    def one(first: Array, position: Array, velocity: Array, commands: Array) -> tuple:
        start = twin.infer(first, params)._replace(q=position, v=velocity)

        def advance(state: State, action: Array) -> tuple[State, State]:
            after = twin.step(state, action, params)
            return after, after

        _, later = jax.lax.scan(advance, start, commands)
        states = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), start, later)
        return states.q, jax.vmap(lambda state: twin.observe(state, params))(states)

    return jax.vmap(one)(obs, q, v, actions)
