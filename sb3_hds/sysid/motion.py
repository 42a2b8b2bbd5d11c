"""How the joints moved, as far as measurements say."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from sb3_hds.core import Twin


def motion_of(
    twin: Twin, obs: Float[np.ndarray, "n rows obs"], dt: float
) -> tuple[Float[np.ndarray, "n rows dof"], Float[np.ndarray, "n rows dof"]]:
    """
    :param obs: measurements in a row, every ``dt`` [s]
    :return: positions, and velocities; where no velocity is observed, differences of positions
    """
    seen = jax.vmap(jax.vmap(lambda row: twin.infer(row, twin.params)))(jnp.asarray(obs))
    q, v = np.asarray(seen.q, float), np.asarray(seen.v, float)
    if q.shape[1] > 1 and not v.any():
        v = np.gradient(q, dt, axis=1)
    return q, v
