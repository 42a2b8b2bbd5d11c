"""How fast motions that start side by side part, which limits how long a prediction can be."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sb3_hds.core import Trajectories, Twin
from sb3_hds.core.compilation import QUICKEST_COMPILATION

# Measurements at which the twin is linearised.
_SOME = 64


def divergence_rate(twin: Twin, data: Trajectories) -> float:
    """
    :param data: measured, sampled at the twin's ``dt``
    :return: greatest rate [1/s] at which a small change of the state grows along the recordings,
        from eigenvalues of the linearised step; zero where none grows
    """
    obs, actions = (np.concatenate(leaves) for leaves in zip(*_rows(data), strict=True))
    chosen = np.linspace(0, len(actions) - 1, _SOME).astype(int)
    slopes = np.asarray(_linearized(twin, jnp.asarray(obs[chosen]), jnp.asarray(actions[chosen])))
    slopes = slopes[np.isfinite(slopes).all((1, 2))]
    if not len(slopes):
        return 0.0
    growth = float(np.abs(np.linalg.eigvals(slopes)).max())
    return max(np.log(growth), 0.0) / twin.dt if growth > 0.0 else 0.0


def _rows(data: Trajectories) -> list[tuple[np.ndarray, np.ndarray]]:
    episodes = (data.episode(i) for i in range(len(data)))
    return [(np.asarray(obs)[:-1], np.asarray(actions)) for obs, actions in episodes]


@partial(jax.jit, static_argnums=0, compiler_options=QUICKEST_COMPILATION)
def _linearized(
    twin: Twin, obs: Float[Array, "n n_obs"], actions: Float[Array, "n n_act"]
) -> Float[Array, "n tangent tangent"]:
    params = twin.params

    def slope(row: Array, action: Array) -> Array:
        state = twin.infer(row, params)
        after = twin.step(state, action, params)

        def moved(tangent: Array) -> Array:
            return twin.difference(twin.step(twin.retract(state, tangent), action, params), after)

        return jax.jacfwd(moved)(jnp.zeros_like(twin.difference(state, state)))

    return jax.vmap(slope)(obs, actions)
