"""Prediction errors of a twin, window by window, and tests on them."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Float

from sb3_hds.core import Params, Trajectories, Twin
from sb3_hds.core.numerics.compilation import QUICKEST_COMPILATION
from sb3_hds.sysid.estimation.results import Fit
from sb3_hds.sysid.estimation.shooting import Shots, fit_start, n_free, simulate, with_slopes

# Gauss-Newton steps of a start state.
_N_STEPS = 8
# Least gain that counts as better, its level, and the number of bootstrap samples.
_LEAST_GAIN, _LEVEL, _N_BOOTSTRAP = 0.05, 0.05, 1000
# The first recording that may be held out entirely, and the most windows of it.
_FIRST_WHOLE, _LONG = 3, 32
# Ratio of errors from which they count as grown, and the level of the test.
_GROWN, _GROWN_LEVEL = 1.5, 1e-4


def window_errors(
    twin: Twin, params: Params, shots: Shots, scale: Float[np.ndarray, " obs"]
) -> Float[np.ndarray, " n"]:
    """
    Root mean square error of each window, from the start state that fits the twin best: the noise
    of the first measurement does not count, nor does a bias of the twin that another start can
    hide.

    :param params: full parameters of the twin
    :param shots: windows
    :param scale: what an error of one means in each channel
    :return: errors in units of ``scale``, shape ``(n,)``; infinite where a simulation is not finite
    """
    return _in_double_precision(twin, params, shots, scale)[0]


def start_states(
    twin: Twin, params: Params, shots: Shots, scale: Float[np.ndarray, " obs"]
) -> tuple[Float[np.ndarray, "n free"], Float[np.ndarray, "n residuals free"]]:
    """
    :return: the start state that fits the twin best to each window, and an orthonormal basis of the
        errors (in units of ``scale``, flattened) that moving it can cause
    """
    _, offsets, slopes = _in_double_precision(twin, params, shots, scale)
    return offsets, np.linalg.qr(np.nan_to_num(slopes, posinf=0.0, neginf=0.0))[0]


def _in_double_precision(
    twin: Twin, params: Params, shots: Shots, scale: Float[np.ndarray, " obs"]
) -> tuple[np.ndarray, ...]:
    with jax.enable_x64(True):
        doubles = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), params)
        found = _errors(twin, doubles, Shots(*map(jnp.asarray, shots)), jnp.asarray(scale))
        return tuple(map(np.asarray, found))


def single_step_errors(
    twin: Twin, data: Trajectories, scale: Float[np.ndarray, " obs"], n_rows: int
) -> Float[np.ndarray, " n"]:
    """
    Errors of single steps from measured states: quick to compile, and enough to show that a twin is
    exact. They mean little where measurements are noisy or states are not fully observed.

    :param n_rows: number of steps, the latest ones; where there are fewer, some count twice
    :return: root mean square over the channels of each step, in units of ``scale``
    """
    episodes = [data.episode(i) for i in range(len(data))]
    steps = [np.concatenate(part) for part in zip(*((x[:-1], u, x[1:]) for x, u in episodes))]  # noqa: B905
    rows = np.resize(np.arange(len(steps[0]))[-n_rows:], n_rows)
    given = (jnp.asarray(x, jnp.float32) for x in (*(part[rows] for part in steps), scale))
    return np.asarray(_single_steps(twin, twin.params, *given))


def gain(new: Float[np.ndarray, " n"], old: Float[np.ndarray, " n"]) -> float:
    """
    :param new: errors of each window
    :param old: errors of the same windows
    :return: by which share the root mean square over all windows is lower
    """
    squares = (np.sum(np.clip(errors, 1e-9, 1e9) ** 2) for errors in (new, old))
    return float(1.0 - np.sqrt(np.divide(*squares)))


def is_better(new: Float[np.ndarray, " n"], old: Float[np.ndarray, " n"]) -> bool:
    """
    Whether the errors of held-out windows are significantly lower: also in 95 % of bootstrap
    samples of the windows.

    :param new: errors of each window
    :param old: errors of the same windows
    """
    if len(new) < 2 or not gain(new, old) >= _LEAST_GAIN:
        return False
    lower = np.clip(old, 1e-9, 1e9) ** 2 - np.clip(new, 1e-9, 1e9) ** 2
    drawn = np.random.default_rng(0).integers(len(lower), size=(_N_BOOTSTRAP, len(lower)))
    return bool(np.mean(lower[drawn].sum(1) <= 0.0) < _LEVEL)


def has_grown(latest: Float[np.ndarray, " n"], older: Float[np.ndarray, " m"]) -> bool:
    """
    Whether the system has changed: errors of the latest windows are 1.5 times those of older ones,
    significantly (one-sided Welch test on the logarithms, at a level for repeated tests).
    """
    new, old = (np.log(np.clip(errors, 1e-9, 1e9)) for errors in (latest, older))
    test: Any = scipy.stats.ttest_ind(new, old, equal_var=False, alternative="greater")
    return bool(new.mean() - old.mean() > np.log(_GROWN) and test.pvalue < _GROWN_LEVEL)


def probability_before(fit: Fit, believed: Twin) -> float:
    """
    Prior predictive check: prior probability of values at least as far from the nominal ones.

    Source: Box, J. R. Stat. Soc. A 143, 1980 (a prior is checked by its predictive distribution).

    :param believed: its values are the centre of the prior, its parameters' ``scale`` the width
    """
    away = [
        (e.estimate - believed.values[e.name]) / believed.parameters[e.name].scale
        for e in fit.estimates
    ]
    return float(scipy.stats.chi2.sf(np.sum(np.square(away)), len(away)))


def hold_out(number: np.ndarray, place: np.ndarray, share: float = 0.25) -> np.ndarray:
    """
    Which windows are held out from training: entire recordings if there are at least four,
    otherwise stretches of each; of a long recording, stretches from its 32nd window on.

    A window used for training is never held out later: not when recordings are added, since the
    first three are never held out entirely; not when old windows are dropped, since numbers and
    places stay; and not when the share is halved.

    :param number: of each window's recording, counted from the first there ever was; -1 for
        padding, shape ``(n,)``
    :param place: of each window in its recording: 0, 1, ..., shape ``(n,)``
    :return: shape ``(n,)``
    """
    every = max(2, round(1.0 / share))
    stretches = (number + place) % every == every - 1
    if number.max() < _FIRST_WHOLE:
        return stretches & (number >= 0)
    whole = (number % every == every - 1) & (number >= _FIRST_WHOLE)
    return np.where(place < _LONG, whole, stretches) & (number >= 0)


@partial(jax.jit, static_argnums=0, compiler_options=QUICKEST_COMPILATION)
def _single_steps(
    twin: Twin, params: Params, obs: Array, actions: Array, after: Array, scale: Array
) -> Float[Array, " n"]:
    def one(obs: Array, action: Array, after: Array) -> Array:
        state = twin.step(twin.infer(obs, params), action, params)
        error = (twin.observe(state, params) - after) / scale
        return jnp.sqrt(jnp.mean(error**2))

    return jax.vmap(one)(obs, actions, after)


@partial(jax.jit, static_argnums=0, compiler_options=QUICKEST_COMPILATION)
def _errors(
    twin: Twin, params: Params, shots: Shots, scale: Float[Array, " obs"]
) -> tuple[Float[Array, " n"], Float[Array, "n free"], Float[Array, "n residuals free"]]:
    def one(shot: Shots) -> tuple[Array, Array, Array]:
        first = jnp.zeros(n_free(twin), shot.obs.dtype)
        offset = fit_start(twin, params, shot, scale, first, _N_STEPS)
        error = lambda x: ((simulate(twin, params, shot, x) - shot.obs) / scale).ravel()  # noqa: E731
        left, slopes = with_slopes(error, offset)
        rms = jnp.sqrt(jnp.mean(left**2))
        return jnp.where(jnp.isfinite(rms), rms, jnp.inf), offset, slopes

    return jax.vmap(one)(shots)
