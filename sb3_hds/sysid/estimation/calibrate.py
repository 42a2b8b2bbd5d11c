"""Estimate the parameters of a twin from measured data."""

import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from sb3_hds.core import Trajectories, Twin
from sb3_hds.core.contract import check_methods
from sb3_hds.core.numerics.compilation import cache_compiled_programs
from sb3_hds.errors import CalibrationError
from sb3_hds.sysid.estimation.evidence import Evidence, portion_for
from sb3_hds.sysid.estimation.hypotheses import Hypotheses
from sb3_hds.sysid.estimation.inverse_dynamics import (
    HUBER,
    NO_THRESHOLD,
    Forces,
    by_inverse_dynamics,
)
from sb3_hds.sysid.estimation.normal_equations import Uncertainty, covariance_of
from sb3_hds.sysid.estimation.parameters import Free, free_names, nominal_values, one_each, tie
from sb3_hds.sysid.estimation.results import Estimate, Fit
from sb3_hds.sysid.estimation.shooting import Shots, n_free, shots_of
from sb3_hds.sysid.measurements import NORMAL, channel_deviations, check_fits, refuse_slow

# Length of a window where none is given [s], within these numbers of steps.
_WINDOW = 0.5
_SHORTEST, _LONGEST = 5, 50
# Noise that the first pass assumes, and the least noise, in shares of a channel's standard
# deviation.
_FIRST_NOISE, _LEAST_NOISE = 0.05, 1e-7
_PASSES = 3
# Steps that fit start states alone. The search ends with a step that changes the log likelihood by
# less than this: it moves estimates by a fraction of their standard errors.
_FIRST_STEPS, _LEAST_STEP = 8, 1e-3
# An estimate this close to a bound counts as on it, in units of its scale.
_ON_BOUND = 1e-3


def calibrate(
    twin: Twin,
    data: Trajectories,
    *,
    free: Iterable[str] | None = None,
    tied: Mapping[str, Iterable[str]] | None = None,
    window: int | None = None,
    errors: str = "simulation",
    loss: str = "huber",
    prior: float = 0.0,
    level: float = 0.95,
    n_windows: int | None = None,
    max_steps: int = 100,
    seed: int = 0,
) -> Fit:
    """
    Estimate parameters of a twin from measured data, with standard errors.

    Levenberg-Marquardt in double precision over short windows with free start states, which are
    eliminated from the normal equations. Each channel is weighted by its noise, which is estimated
    too. Standard errors are those of the sandwich estimator, clustered by recording (by
    window where there are few recordings): they hold for noise that is neither white nor Gaussian.

    Source: Bock, *Recent advances in parameter identification techniques for ODE*, 1983 (multiple
    shooting, and how start states are eliminated); Huber and Ronchetti, *Robust Statistics*, 2009.

    :param twin: whose values are where the search begins, and stay where they are not ``free``
    :param data: measured trajectories, sampled at the twin's ``dt``
    :param free: names of the parameters to estimate; default: all but ``twin.known_parameters``
    :param tied: free parameters that take one value, such as those of joints of a kind, by a name
        for it: ``{"hip_damping": ["left_hip_damping", "right_hip_damping"]}``
    :param window: steps per window; default: half a second, between 5 and 50 steps, and not longer
        than the longest recording
    :param errors: that are minimised: ``"simulation"`` errors, of the channels over a window
        (output error); or ``"force"`` errors, of the equation of motion (inverse dynamics), for
        logged torques that are less certain than the sensors. If simulations with the twin's own
        values diverge, the search starts from the inverse-dynamics estimate.
    :param loss: ``"huber"``, for which outliers count less, or ``"linear"`` for plain squares
    :param prior: strength of a normal prior around the twin's own values: the reciprocal of its
        standard deviation, in units of each parameter's ``scale``. 0: no prior.
    :param level: of the confidence intervals
    :param n_windows: number of windows: a random choice if there are more, padding if there are
        fewer, so that one compiled program serves both; default: all
    :param max_steps: of the solver
    :param seed: of the choice of windows
    :return: estimates with standard errors and units, and the calibrated twin
    :raises CalibrationError: for an unknown or missing parameter, other channels or another
        interval than the twin's, fewer measurements than unknowns, forces of a twin that is no
        ``AnalyticTwin``, or a twin on MuJoCo's engine
    :raises TrajectoryError: if no recording is as long as a window
    :raises TwinError: for a twin whose methods do not return what they have to
    """
    check_methods(twin)
    refuse_slow(twin, "calibrate")
    cache_compiled_programs()
    wanted = tie(twin, free_names(twin, free), tied or {})
    check_fits(twin, data)
    if loss not in ("huber", "linear"):
        raise CalibrationError(f"loss must be 'huber' or 'linear', got {loss!r}.")
    if errors not in ("simulation", "force"):
        raise CalibrationError(f"errors must be 'simulation' or 'force', got {errors!r}.")
    if not 0.0 <= prior < math.inf:
        raise CalibrationError(f"prior must be at least 0 (no belief), got {prior}.")
    if n_windows is not None and n_windows < 1:
        raise CalibrationError(f"n_windows must be at least 1, got {n_windows}.")
    if not 0.0 < level < 1.0:
        raise CalibrationError(f"level must lie between 0 and 1, got {level}.")
    shots, origin = shots_of(data, window or default_window(data), twin, n_windows, seed)
    threshold = HUBER if loss == "huber" else NO_THRESHOLD
    if errors == "force":
        return _fit_forces(twin, wanted, data, shots, origin, threshold, level)
    return fit_windows(
        twin,
        wanted,
        shots,
        origin,
        channel_deviations(data),
        threshold=threshold,
        prior=prior,
        level=level,
        max_steps=max_steps,
        elsewhere=lambda: by_inverse_dynamics(twin, tuple(wanted.values()), data, threshold),
    )


def fit_windows(
    twin: Twin,
    free: Free,
    shots: Shots,
    origin: np.ndarray,
    deviations: Float[np.ndarray, " obs"],
    *,
    threshold: float = HUBER,
    prior: float = 0.0,
    prior_mean: Float[np.ndarray, " p"] | None = None,
    level: float = 0.95,
    max_steps: int = 100,
    elsewhere: Callable[[], Forces | None] | None = None,
) -> Fit:
    """
    :func:`calibrate` on windows that were cut already.

    :param free: parameters, by the name of the value that they take
    :param shots: windows; those of weight zero do not count
    :param origin: recording of each window, shape ``(n,)``
    :param deviations: standard deviation of each channel over the data
    :param threshold: of the Huber loss, in units of the noise
    :param prior_mean: centre of the prior; default: the twin's own values
    :param elsewhere: computes another start of the search, used if the errors of simulations with
        the twin's own values exceed a channel's standard deviation
    :raises CalibrationError: for fewer measurements than unknowns
    """
    real = origin >= 0
    n, steps = int(np.sum(shots.weight)), shots.actions.shape[1]
    measured, unknown = n * int(np.prod(shots.obs.shape[1:])), len(free) + n * n_free(twin)
    if measured <= unknown:
        raise CalibrationError(
            f"{n} windows of {steps} steps hold {measured} measurements, and {len(free)} "
            f"parameters with the start states are {unknown} unknowns. Record more, free fewer "
            "parameters, or ask for longer windows."
        )
    kept, origin = shots.rows(real), origin[real]
    evidence = Evidence(
        Hypotheses.of_values(twin, free, prior_mean, prior),
        kept,
        _FIRST_NOISE * deviations,
        width=len(free),
        portion=portion_for(shots.n),
        threshold=threshold,
    )
    at = evidence.fit(nominal_values(twin, free), (), n_steps=_FIRST_STEPS)
    before, found = at.residual, None
    if elsewhere is not None and np.any(_rms(before) > deviations):
        other = elsewhere()
        there = other and evidence.fit(other.values, (), n_steps=_FIRST_STEPS)
        if there and there.cost < at.cost:
            at = there
    for _ in range(_PASSES):
        found = evidence.solve(at.theta, range(len(free)), at.offsets, max_steps, least=_LEAST_STEP)
        at = found.point
        noise = _noise(at.residual, len(free), n_free(twin), deviations)
        evidence = evidence.with_noise(noise)
    assert found is not None
    at = evidence.fit(at.theta, (), at.offsets, n_steps=_FIRST_STEPS)
    slopes, scale = evidence.slopes(at), evidence.hypotheses.scale
    n_measured = at.residual.size - n_free(twin) * len(at.residual)
    uncertainty = covariance_of(
        slopes.curvature.sum(0), slopes.scores, origin, scale, prior, n_measured
    )
    solver = {"noise": noise, "converged": found.converged, "n_steps": found.n_steps}
    return _result(twin, free, at.theta, uncertainty, level, (before, at.residual), **solver)


def _fit_forces(
    twin: Twin,
    free: Free,
    data: Trajectories,
    shots: Shots,
    origin: np.ndarray,
    threshold: float,
    level: float,
) -> Fit:
    found = by_inverse_dynamics(twin, tuple(free.values()), data, threshold)
    if found is None:
        raise CalibrationError(
            f"errors='force' asks for the equation of motion of an AnalyticTwin, and {twin.name} "
            "has more than that, or none. Calibrate the twin without effects, or leave errors out."
        )
    real, deviations = origin >= 0, channel_deviations(data)
    evidence = Evidence(
        Hypotheses.of_values(twin, free),
        shots.rows(real),
        _FIRST_NOISE * deviations,
        width=0,
        portion=portion_for(shots.n),
        threshold=threshold,
    )
    scale = evidence.hypotheses.scale
    errors, slopes, recording = found.windows(shots.actions.shape[1])
    slopes = slopes * scale
    uncertainty = covariance_of(
        np.einsum("nmp,nmq->pq", slopes, slopes),
        np.einsum("nmp,nm->np", slopes, errors),
        recording,
        scale,
        0.0,
        errors.size,
    )
    before, after = (
        evidence.fit(values, (), n_steps=_FIRST_STEPS).residual
        for values in (nominal_values(twin, free), found.values)
    )
    noise = _noise(after, 0, n_free(twin), deviations)
    solver = {"noise": noise, "converged": True, "n_steps": 1, "errors": "force"}
    return _result(twin, free, found.values, uncertainty, level, (before, after), **solver)


def _rms(residual: np.ndarray) -> np.ndarray:
    with np.errstate(over="ignore"):
        return np.sqrt(np.mean(residual**2, (0, 1)))


def default_window(data: Trajectories) -> int:
    """:return: steps per window"""
    steps = int(np.clip(round(_WINDOW / data.dt), _SHORTEST, _LONGEST))
    return min(steps, int(data.lengths.max()))


def _noise(
    residual: np.ndarray, n_params: int, n_start: int, deviations: np.ndarray
) -> Float[np.ndarray, " obs"]:
    """Robust standard deviation of each channel's error, from the median."""
    error = residual.reshape(-1, residual.shape[-1])
    freedom = error.size / max(error.size - n_params - n_start * len(residual), 1)
    noise = NORMAL * np.median(np.abs(error), 0) * np.sqrt(freedom)
    return np.maximum(noise, _LEAST_NOISE * deviations)


def _result(
    twin: Twin,
    free: Free,
    values: np.ndarray,
    uncertainty: Uncertainty,
    level: float,
    residuals: tuple[np.ndarray, np.ndarray],
    **solver: Any,
) -> Fit:
    """
    :param residuals: simulated minus measured, before and after, each of shape ``(n, rows, n_obs)``
    :param solver: what :class:`Fit` says of the solver, and the noise
    """
    groups = tuple(free.values())
    margin = uncertainty.quantile(level) * uncertainty.stderr
    estimates = []
    for (name, group), x, stderr, half in zip(
        free.items(), values, uncertainty.stderr, margin, strict=True
    ):
        parameter = twin.parameters[group[0]]
        room = min(x - parameter.lower, parameter.upper - x)
        estimates.append(
            Estimate(
                name=name,
                estimate=float(x),
                stderr=float(stderr),
                low=float(max(x - half, parameter.lower)),
                high=float(min(x + half, parameter.upper)),
                unit=parameter.unit,
                before=twin.values[group[0]],
                at_bound=bool(room < _ON_BOUND * parameter.scale),
            )
        )
    before, after = residuals
    return Fit(
        twin=twin.with_parameters(**one_each(groups, values.tolist())),
        estimates=tuple(estimates),
        covariance=uncertainty.covariance,
        channels=tuple((channel.name, channel.unit) for channel in twin.channels),
        error_before=_rms(before),
        error_after=_rms(after),
        n_windows=len(after),
        window=after.shape[1] - 1,
        n_groups=uncertainty.n_groups,
        level=level,
        undetermined=tuple(_combination(tuple(free), row) for row in uncertainty.undetermined),
        **solver,
    )


def _combination(names: tuple[str, ...], direction: np.ndarray) -> str:
    """:return: the parameters that make up an undetermined direction, the largest share first"""
    share = np.abs(direction)
    return ", ".join(names[i] for i in np.argsort(-share) if share[i] > 0.1)
