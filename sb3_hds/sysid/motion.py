"""How the joints moved, as far as measurements say."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from sb3_hds.core import Params, Twin

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
    values = twin.params if params is None else params
    seen = jax.vmap(jax.vmap(lambda row: twin.infer(row, values)))(jnp.asarray(obs))
    q, v = np.asarray(seen.q, float), np.asarray(seen.v, float)
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
    dof = len(twin.joints)
    values = twin.params if params is None else params
    q, v = motion_of(twin, obs[:, :_FEW], dt, values)
    first = jax.vmap(lambda row: twin.infer(row, values).v)(jnp.asarray(obs[:, 0]))
    if np.asarray(first).any():
        return np.zeros((len(obs), 2 * dof))
    return np.concatenate([np.zeros_like(q[:, 0]), v.mean(1)], 1)
