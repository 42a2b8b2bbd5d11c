"""Inverse-dynamics estimation: least squares on the equation of motion, without simulation."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Float

from sb3_hds.core import AnalyticTwin, State, Trajectories, Twin
from sb3_hds.core.numerics.compilation import QUICKEST_COMPILATION
from sb3_hds.sysid.estimation.parameters import one_each
from sb3_hds.sysid.measurements import NORMAL
from sb3_hds.sysid.motion.motion import smoothed_motion

# Gauss-Newton steps: most parameters are linear, and need one; Huber's weights need a few.
_STEPS = 6
#: Huber's threshold, in units of the noise: 95 % as efficient as least squares on Gaussian noise
HUBER = 1.345
#: for plain squares: beyond any error, in units of the noise
NO_THRESHOLD = 1e12
# Standard deviation of the prior around the twin's own values, in each parameter's scale: a weak
# prior that keeps what the data do not determine.
_BELIEF = 100.0


class Forces(NamedTuple):
    """
    :param values: of the free parameters, within their bounds
    :param errors: residual forces at these values, in units of their noise, weighted by Huber's
        rule, shape ``(n, dof)``
    :param slopes: of these by the parameters, shape ``(n, dof, p)``
    :param recording: that each row is from, shape ``(n,)``
    :param thinning: samples of the data between two rows
    """

    values: np.ndarray
    errors: np.ndarray
    slopes: np.ndarray
    recording: np.ndarray
    thinning: int

    def windows(self, steps: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """:return: errors, slopes and recording of windows of this many samples"""
        rows = max(1, steps // self.thinning)
        places = []
        for one in np.unique(self.recording):
            own = np.flatnonzero(self.recording == one)
            whole = len(own) // rows * rows
            places.append(own[:whole].reshape(-1, rows))
        index = np.concatenate(places)
        n, p = len(index), self.slopes.shape[-1]
        errors, slopes = self.errors[index], self.slopes[index]
        return errors.reshape(n, -1), slopes.reshape(n, -1, p), self.recording[index[:, 0]]


def by_inverse_dynamics(
    twin: Twin, groups: tuple[tuple[str, ...], ...], data: Trajectories, threshold: float = HUBER
) -> Forces | None:
    r"""
    Least squares on the residual of the equation of motion,

    .. math:: M(q)\,\dot v + c(q, v) - \tau(q, v, u)

    Nothing is integrated, so it converges where simulations with wrong values diverge. It is the
    better estimator if torques are less certain than sensors, as on a geared arm. Velocity noise
    biases estimates towards zero.

    Source: Khalil and Dombre, *Modeling, Identification and Control of Robots*, 2002, section 12.

    :param groups: free parameters
    :param threshold: of the Huber loss, in units of the noise
    :return: None for a twin that has more than an equation of motion
    """
    if not isinstance(twin, AnalyticTwin):
        return None
    moved = smoothed_motion(twin, data)
    middle = lambda x: 0.5 * (x[1:] + x[:-1])  # noqa: E731
    parts = [(middle(r.q), middle(r.v), middle(r.a), r.actions) for r in moved.recordings]
    recording = np.repeat(moved.origin, [len(r.actions) for r in moved.recordings])
    parameters = [twin.parameters[group[0]] for group in groups]
    scale = np.array([p.scale if p.scale > 0.0 else 1.0 for p in parameters])
    own = np.array([twin.values[group[0]] for group in groups])
    lower, upper = (np.array([getattr(p, end) for p in parameters]) for end in ("lower", "upper"))
    values = own.copy()
    with jax.enable_x64(True):
        rows = tuple(jnp.asarray(np.concatenate(x), jnp.float64) for x in zip(*parts, strict=True))
        fixed = {k: jnp.asarray(leaf, jnp.float64) for k, leaf in twin.params.items()}
        look = partial(_missing, twin, groups, fixed)
        for step in range(_STEPS + 1):
            missing, slopes = map(np.asarray, look(jnp.asarray(values), *rows))
            if not (np.isfinite(missing).all() and np.isfinite(slopes).all()):
                return None
            weight = _weights(missing, threshold)
            errors, table = weight * missing, weight[..., None] * slopes
            if step == _STEPS:
                break
            belief = np.eye(len(groups)) / _BELIEF
            whole = np.concatenate([table.reshape(-1, len(groups)) * scale, belief])
            right = np.concatenate([-errors.ravel(), (own - values) / scale / _BELIEF])
            room = (lower - values) / scale, (upper - values) / scale
            values = np.clip(values + scale * _within(whole, right, room), lower, upper)
    return Forces(values, errors, table, recording, moved.thinning)


def _weights(missing: np.ndarray, threshold: float) -> np.ndarray:
    size = np.abs(missing)
    noise = np.maximum(NORMAL * np.median(size, 0), 1e-12 * size.max() + 1e-300)
    return np.sqrt(np.minimum(1.0, threshold * noise / np.maximum(size, 1e-300))) / noise


def _within(table: np.ndarray, right: np.ndarray, room: tuple[np.ndarray, np.ndarray]) -> Any:
    """Bounded least squares; a parameter whose bounds coincide stays where it is."""
    low, high = room
    found, free = np.zeros(len(low)), high - low >= 1e-12
    if free.any():
        found[free] = scipy.optimize.lsq_linear(table[:, free], right, (low[free], high[free])).x
    return found


@partial(jax.jit, static_argnums=(0, 1), compiler_options=QUICKEST_COMPILATION)
def _missing(
    twin: AnalyticTwin,
    groups: tuple[tuple[str, ...], ...],
    fixed: dict[str, Array],
    values: Array,
    q: Array,
    v: Array,
    a: Array,
    actions: Array,
) -> tuple[Float[Array, "n dof"], Float[Array, "n dof p"]]:
    def missing(values: Array, q: Array, v: Array, a: Array, action: Array) -> Array:
        p = fixed | one_each(groups, values)
        needed = twin.mass_matrix(q, p) @ a + twin.bias(q, v, p)
        return needed - twin.actuate(State(q, v, {}), action, p)

    def row(*given: Array) -> tuple[Array, Array]:
        return missing(values, *given), jax.jacfwd(missing)(values, *given)

    return jax.vmap(row)(q, v, a, actions)
