"""Estimate the parameters of a twin from measured data."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from sb3_hds.core import Parameter, Trajectories, Twin
from sb3_hds.core.contract import check_methods
from sb3_hds.core.numerics.compilation import keep_programs
from sb3_hds.core.trajectories.episodes import same_interval
from sb3_hds.data.resampling.report import Reading
from sb3_hds.errors import CalibrationError
from sb3_hds.sysid.estimation.covariance import Spread, covariance_of
from sb3_hds.sysid.estimation.evidence import Evidence, portion_for
from sb3_hds.sysid.estimation.hypotheses import Hypotheses
from sb3_hds.sysid.estimation.inverse_dynamics import NO_THRESHOLD, Forces, by_inverse_dynamics
from sb3_hds.sysid.estimation.parameters import Free, free_names, one_each, own_values, tie
from sb3_hds.sysid.estimation.results import Estimate, Fit
from sb3_hds.sysid.estimation.shooting import Shots, n_free, shots_of

# Length of a window where none is given [s], within these numbers of steps.
_WINDOW = 0.5
_SHORTEST, _LONGEST = 5, 50
# Noise that the first pass assumes, and the least believed, in shares of a channel's spread.
_FIRST_NOISE, _LEAST_NOISE = 0.05, 1e-7
# Huber's threshold, in units of the noise: 95 % as efficient as least squares on Gaussian noise.
_HUBER = 1.345
_PASSES = 3
# Steps of start states alone. A step that lowers the log likelihood by less is the last: it moves
# estimates by a fraction of their standard errors.
_FIRST_STEPS, _LEAST_STEP = 8, 1e-3
# An estimate this close to a bound lies on it, in units of its scale.
_ON_BOUND = 1e-3
# Beyond this ratio of two intervals, one is taken to be in another unit.
_OTHER_UNIT = 100.0


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
    :param n_windows: number of windows that are used: a random choice of more, or a compiled
        program for more than there are; default: all
    :param max_steps: of the solver
    :param seed: of the choice of windows
    :return: estimates with standard errors and units, and the calibrated twin
    :raises CalibrationError: for an unknown or missing parameter, other channels or another
        interval than the twin's, fewer measurements than unknowns, or forces of a twin that is no
        ``AnalyticTwin``
    :raises TrajectoryError: if no recording is as long as a window
    :raises TwinError: for a twin whose methods do not return what they have to
    """
    check_methods(twin)
    keep_programs()
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
    threshold = _HUBER if loss == "huber" else NO_THRESHOLD
    if errors == "force":
        return _fit_forces(twin, wanted, data, shots, origin, threshold, level)
    return fit_windows(
        twin,
        wanted,
        shots,
        origin,
        spread_of(data),
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
    spread: Float[np.ndarray, " obs"],
    *,
    threshold: float = _HUBER,
    prior: float = 0.0,
    believed: Float[np.ndarray, " p"] | None = None,
    level: float = 0.95,
    max_steps: int = 100,
    elsewhere: Callable[[], Forces | None] | None = None,
) -> Fit:
    """
    :func:`calibrate` on windows that were cut already.

    :param free: parameters, by the name of the value that they take
    :param shots: windows; those of weight zero do not count
    :param origin: recording of each window, shape ``(n,)``
    :param spread: standard deviation of each channel over the data
    :param threshold: of the Huber loss, in units of the noise
    :param believed: centre of the prior; default: the twin's own values
    :param elsewhere: another start of the search, used if simulations with the twin's own values
        err by more than a channel's standard deviation
    :raises CalibrationError: for fewer measurements than unknowns
    """
    _check_enough(twin, free, shots)
    real = origin >= 0
    kept, origin = Shots(*(np.asarray(leaf)[real] for leaf in shots)), origin[real]
    evidence = Evidence(
        Hypotheses.of_values(twin, free, believed, prior),
        kept,
        _FIRST_NOISE * spread,
        width=len(free),
        portion=portion_for(shots.n),
        threshold=threshold,
    )
    at = evidence.fit(own_values(twin, free), (), n_steps=_FIRST_STEPS)
    before, found = at.raw, None
    if elsewhere is not None and np.any(_rms(before) > spread):
        other = elsewhere()
        there = other and evidence.fit(other.values, (), n_steps=_FIRST_STEPS)
        if there and there.cost < at.cost:
            at = there
    for _ in range(_PASSES):
        found = evidence.solve(at.theta, range(len(free)), at.offsets, max_steps, least=_LEAST_STEP)
        at = found.point
        noise = _noise(at.raw, len(free), n_free(twin), spread)
        evidence = evidence.with_noise(noise)
    assert found is not None
    at = evidence.fit(at.theta, (), at.offsets, n_steps=_FIRST_STEPS)
    slopes, scale = evidence.slopes(at), evidence.hypotheses.scale
    n_measured = at.raw.size - n_free(twin) * len(at.raw)
    uncertainty = covariance_of(
        slopes.curvature.sum(0), slopes.scores, origin, scale, prior, n_measured
    )
    told = _Told(before, at.raw, noise, found.converged, found.n_steps, "simulation")
    return _result(twin, free, at.theta, uncertainty, told, level)


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
    real, spread = origin >= 0, spread_of(data)
    evidence = Evidence(
        Hypotheses.of_values(twin, free),
        Shots(*(np.asarray(leaf)[real] for leaf in shots)),
        _FIRST_NOISE * spread,
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
        evidence.fit(values, (), n_steps=_FIRST_STEPS).raw
        for values in (own_values(twin, free), found.values)
    )
    noise = _noise(after, 0, n_free(twin), spread)
    told = _Told(before, after, noise, True, 1, "force")
    return _result(twin, free, found.values, uncertainty, told, level)


def _rms(raw: np.ndarray) -> np.ndarray:
    with np.errstate(over="ignore"):
        return np.sqrt(np.mean(raw**2, (0, 1)))


def default_window(data: Trajectories) -> int:
    """:return: steps per window"""
    steps = int(np.clip(round(_WINDOW / data.dt), _SHORTEST, _LONGEST))
    return min(steps, int(data.lengths.max()))


def spread_of(data: Trajectories) -> Float[np.ndarray, " obs"]:
    """:return: standard deviation of each channel over the data, one where it never changes"""
    real = np.concatenate([data.episode(i)[0] for i in range(len(data))])
    spread = real.std(0)
    return np.where(spread > 0.0, spread, 1.0)


def check_fits(twin: Twin, data: Trajectories) -> None:
    """:raises CalibrationError: if the data cannot have been measured on what the twin simulates"""
    if (data.n_obs, data.n_act) != (len(twin.channels), len(twin.actuators)):
        names = ", ".join(channel.name for channel in twin.channels)
        raise CalibrationError(
            f"{twin.name} observes {len(twin.channels)} channels ({names}) and takes "
            f"{len(twin.actuators)} commands; the data have {data.n_obs} and {data.n_act}. "
            "Choose the columns, or the twin, that fit."
        )
    report = data.report if isinstance(data.report, Reading) else None
    misfit = report.misfit(twin.channels, twin.actuators) if report else ""
    if misfit:
        raise CalibrationError(misfit)
    if not same_interval(data.dt, twin.dt):
        raise CalibrationError(
            f"{twin.name} steps by {twin.dt:g} s and the data are sampled every {data.dt:g} s. "
            f"{_other_unit(data.dt / twin.dt)}Use data.resample(dt={twin.dt:g}) (in the map of "
            f"columns, dt: {twin.dt:g}), or make the twin with dt={data.dt:g} (on the command "
            f"line, --set dt:{data.dt:g})."
        )


def _other_unit(ratio: float) -> str:
    """What to do where stamps were taken for seconds that are thousands of times shorter."""
    if ratio < _OTHER_UNIT:
        return ""
    order = int(np.clip(round(np.log10(ratio) / 3.0), 1, 3))
    unit = ("milliseconds", "microseconds", "nanoseconds")[order - 1]
    return (
        f"The column of time may be in {unit}: then say so in the map of columns, "
        f"time: {{column: NAME, scale: {10.0 ** (-3 * order):g}}}. Otherwise: "
    )


def _check_enough(twin: Twin, free: Free, shots: Shots) -> None:
    real = int(np.sum(shots.weight))
    measured = real * int(np.prod(shots.obs.shape[1:]))
    unknown = len(free) + real * n_free(twin)
    if measured <= unknown:
        raise CalibrationError(
            f"{real} windows of {shots.actions.shape[1]} steps hold {measured} measurements, and "
            f"{len(free)} parameters with the start states are {unknown} unknowns. "
            "Record more, free fewer parameters, or ask for longer windows."
        )


def _noise(
    raw: np.ndarray, n_params: int, n_start: int, spread: np.ndarray
) -> Float[np.ndarray, " obs"]:
    """Standard deviation of each channel's error, by the median, so that outliers do not matter."""
    error = raw.reshape(-1, raw.shape[-1])
    freedom = error.size / max(error.size - n_params - n_start * len(raw), 1)
    noise = 1.4826 * np.median(np.abs(error), 0) * np.sqrt(freedom)
    return np.maximum(noise, _LEAST_NOISE * spread)


class _Told(NamedTuple):
    """What a fit is told with: errors of simulations, shape ``(n, rows, n_obs)``, and the rest."""

    before: np.ndarray
    after: np.ndarray
    noise: np.ndarray
    converged: bool
    n_steps: int
    errors: str


def _result(
    twin: Twin,
    free: Free,
    values: np.ndarray,
    spread: Spread,
    told: _Told,
    level: float,
) -> Fit:
    groups = tuple(free.values())
    parameters = [twin.parameters[group[0]] for group in groups]
    margin = spread.quantile(level) * spread.stderr
    estimates = tuple(
        Estimate(
            name=name,
            estimate=float(value),
            stderr=float(stderr),
            low=float(max(value - half, parameter.lower)),
            high=float(min(value + half, parameter.upper)),
            unit=parameter.unit,
            before=twin.values[group[0]],
            at_bound=bool(at_bound),
        )
        for (name, group), parameter, value, stderr, half, at_bound in zip(
            free.items(),
            parameters,
            values,
            spread.stderr,
            margin,
            _at_bound(parameters, values),
            strict=True,
        )
    )
    return Fit(
        twin=twin.with_parameters(**one_each(groups, values.tolist())),
        estimates=estimates,
        covariance=spread.covariance,
        channels=tuple((channel.name, channel.unit) for channel in twin.channels),
        error_before=_rms(told.before),
        error_after=_rms(told.after),
        noise=told.noise,
        n_windows=len(told.after),
        window=told.after.shape[1] - 1,
        n_groups=spread.n_groups,
        level=level,
        converged=told.converged,
        n_steps=told.n_steps,
        undetermined=tuple(_in_words(tuple(free), row) for row in spread.undetermined),
        errors=told.errors,
    )


def _at_bound(parameters: Sequence[Parameter], values: np.ndarray) -> list[bool]:
    """Whether values lie on a physical bound."""
    return [
        bool(min(value - p.lower, p.upper - value) < _ON_BOUND * p.scale)
        for p, value in zip(parameters, values, strict=True)
    ]


def _in_words(names: tuple[str, ...], direction: np.ndarray) -> str:
    """Which parameters a direction that the data do not determine consists of."""
    share = np.abs(direction)
    return ", ".join(names[i] for i in np.argsort(-share) if share[i] > 0.1)
