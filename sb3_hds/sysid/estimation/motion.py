"""How the joints moved, as far as measurements say."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sb3_hds.core import Params, Twin
from sb3_hds.core.numerics.compilation import QUICKEST_COMPILATION

# Samples from which the first velocity is told.
_FEW = 5
# Rows before and after each other.
_PAIRS = (slice(None, -1), slice(1, None))


def motion_of(
    twin: Twin, obs: Float[np.ndarray, "n rows obs"], dt: float, params: Params | None = None
) -> tuple[Float[np.ndarray, "n rows dof"], Float[np.ndarray, "n rows dof"]]:
    """
    :param obs: measurements in a row, every ``dt`` [s]
    :param params: under which they are read; default: the twin's own
    :return: positions, and velocities; where no velocity is observed, differences of positions
    """
    q, v, ways = _read(twin, obs, twin.params if params is None else params)
    if q.shape[1] > 1 and not v.any():
        v = _rates(ways, dt)
    return q, v


def first_offsets(
    twin: Twin, obs: Float[np.ndarray, "n rows n_obs"], dt: float, params: Params | None = None
) -> Float[np.ndarray, "n free"]:
    """
    Where a search for start states begins.

    :param params: under which measurements are read; default: the twin's own
    :return: offsets from what first measurements say: zero, but for velocities that are not
        observed, which differences of positions tell
    """
    q, v, ways = _read(twin, obs[:, :_FEW], twin.params if params is None else params)
    v = np.zeros_like(q) if v[:, 0].any() else _rates(ways, dt)
    return np.concatenate([np.zeros_like(q[:, 0]), v.mean(1)], 1)


def _rates(ways: Float[np.ndarray, "n ways dof"], dt: float) -> Float[np.ndarray, "n rows dof"]:
    """Differences over two steps, over one at the ends."""
    rates = ways / dt
    inside = 0.5 * (rates[:, 1:] + rates[:, :-1])
    return np.concatenate([rates[:, :1], inside, rates[:, -1:]], 1)


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
