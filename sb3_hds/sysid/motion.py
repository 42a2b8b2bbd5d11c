"""How the joints moved, as far as measurements say."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sb3_hds.core import Params, State, Twin
from sb3_hds.core.compilation import QUICKEST_COMPILATION

# Samples from which the first velocity is told.
_FEW = 5


def motion_of(
    twin: Twin, obs: Float[np.ndarray, "n rows obs"], dt: float, params: Params | None = None
) -> tuple[Float[np.ndarray, "n rows dof"], Float[np.ndarray, "n rows dof"]]:
    """
    :param obs: measurements in a row, every ``dt`` [s]
    :param params: under which they are read; default: the twin's own
    :return: positions, and velocities; where no velocity is observed, differences of positions
    """
    q, v = _read(twin, obs, twin.params if params is None else params)
    if q.shape[1] > 1 and not v.any():
        v = np.gradient(q, dt, axis=1)
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
    q, v = _read(twin, obs[:, :_FEW], twin.params if params is None else params)
    v = np.zeros_like(q) if v[:, 0].any() else np.gradient(q, dt, axis=1)
    return np.concatenate([np.zeros_like(q[:, 0]), v.mean(1)], 1)


def _read(twin: Twin, obs: np.ndarray, params: Params) -> tuple[np.ndarray, np.ndarray]:
    seen = _inferred(twin, jnp.asarray(obs), params)
    return np.asarray(seen.q, float), np.asarray(seen.v, float)


@partial(jax.jit, static_argnums=0, compiler_options=QUICKEST_COMPILATION)
def _inferred(twin: Twin, obs: Float[Array, "n rows obs"], params: Params) -> State:
    return jax.vmap(jax.vmap(lambda row: twin.infer(row, params)))(obs)
