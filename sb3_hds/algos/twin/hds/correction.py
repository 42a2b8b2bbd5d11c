"""Correction of the twin by measured data: parameters of twin and effects, then a learned force."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from sb3_hds.algos.twin.hds.recorded_steps import last_steps
from sb3_hds.algos.twin.hds.windows import (
    EXACT,
    FEWEST,
    ChangePoint,
    Windows,
    detect_change,
    hold_out_windows,
    latest_windows,
    rms,
    shares_of,
    windows_of,
)
from sb3_hds.algos.twin.planning_twin import missing_effects, nulls_of
from sb3_hds.core import Trajectories, Twin
from sb3_hds.errors import CalibrationError, TrajectoryError
from sb3_hds.sysid import Fit
from sb3_hds.sysid.estimation.calibrate import fit_windows
from sb3_hds.sysid.estimation.parameters import every_name, free_names, untied
from sb3_hds.sysid.estimation.prediction import (
    gain,
    is_better,
    probability_before,
    single_step_errors,
)
from sb3_hds.sysid.estimation.residual_force import Residual, fit_force
from sb3_hds.sysid.measurements import channel_deviations, check_fits

# A twin is exact if this quantile of the errors of this number of latest single steps is below this
# threshold. The quantile is high, since every twin is exact at rest.
_EXACT_STEP, _QUANTILE, _N_SINGLE = 1e-4, 0.98, 256
# Iterations of the solver per pass: the next correction continues from its result.
_SOLVER_STEPS = 20
# Relative decrease of the error after which plans are made again.
_NOTICEABLE = 0.1
# Relative decrease of the error required of a calibrated twin: less than of a learned force, since
# it has few parameters and a prior.
_LEAST_OF_CALIBRATION = 0.02
# Relative increase of the error without a suspected effect from which on the effect stays.
_LEAST_OF_SUSPECT = 0.01
# Probability under the prior below which parameters are rejected if held-out windows are from the
# same recordings: a system that is stuck in dry friction looks like a heavier one.
_IMPROBABLE = 1e-3
# Relative decrease of the error from which on all plans are made with the learned force.
_TRUSTED = 0.25


@dataclasses.dataclass(frozen=True)
class CorrectionConfig:
    """
    Arguments of a correction.

    :param names: parameters to estimate; empty: none
    :param nominal: nominal values of parameters, by name
    :param residual_kwargs: further arguments of ``sysid.fit_residual``
    :param beta: share of rollouts in the learned model, or ``"auto"``; 0: no force is learned
    :param seed: of random numbers
    :param suspected: effects that are estimated, too, if the twin is not exact, and stay attached
        if they lower the error
    """

    names: tuple[str, ...]
    nominal: Mapping[str, float]
    residual_kwargs: Mapping[str, Any]
    beta: float | str
    seed: int
    suspected: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True)
class Correction:
    """
    Result of a correction. Errors are root mean squares over held-out windows, in standard
    deviations of the channels; NaN if there was nothing to compare.

    :param twin: the corrected twin
    :param beta: share of rollouts in the learned model
    :param changed: whether the model has changed so much that plans should be made again
    :param change: start of the data that count, if a change of the system was detected
    :param attached: nominal values of the parameters of newly attached effects
    :param fit: of the parameters, if they were estimated
    :param residual: the learned force, if it was learned
    :param error_twin: of the nominal twin
    :param error_calibrated: of the calibrated twin
    :param error_hybrid: of the calibrated twin with the learned force
    """

    twin: Twin
    beta: float
    changed: bool
    change: ChangePoint | None = None
    attached: Mapping[str, float] = dataclasses.field(default_factory=dict)
    fit: Fit | None = None
    residual: Residual | None = None
    error_twin: float = np.nan
    error_calibrated: float = np.nan
    error_hybrid: float = np.nan

    def log(self) -> tuple[dict[str, float], dict[str, float]]:
        """
        :return: by key, the errors and current parameters; and the limits of the intervals of
            parameters whose estimates were accepted
        """
        values: dict[str, float] = {"beta": self.beta, "forgotten": int(self.change is not None)}
        for name in ("error_twin", "error_calibrated", "error_hybrid"):
            error = getattr(self, name)
            if not (np.isnan(error) or (name == "error_calibrated" and self.fit is None)):
                values[name] = error
        if self.residual is not None:
            values["disagreement"] = self.residual.disagreement
        intervals: dict[str, float] = {}
        for estimate in self.fit.estimates if self.fit is not None else ():
            value = self.twin.values.get(estimate.name)
            if value is None:
                continue
            values[estimate.name] = value
            if value == estimate.estimate:
                intervals[f"{estimate.name}_low"] = estimate.low
                intervals[f"{estimate.name}_high"] = estimate.high
        with_prefix = lambda found: {f"model/{name}": x for name, x in found.items()}  # noqa: E731
        return with_prefix(values), with_prefix(intervals)


def correct(
    twin: Twin,
    data: Trajectories,
    config: CorrectionConfig,
    beta: float,
    learn_force: bool,
    n_new: int,
    change: ChangePoint | None = None,
) -> Correction:
    """
    Estimate parameters, then learn a residual force; accept each only if it predicts held-out
    windows better.

    :param twin: the current twin
    :param data: all measured data, oldest first; ``origin`` numbers the recordings
    :param config: arguments
    :param beta: the current share of rollouts in the learned model
    :param learn_force: whether to learn the force again
    :param n_new: number of steps since the last correction
    :param change: start of the data that count; None: all data count
    :raises CalibrationError: for data that do not fit the twin
    """
    check_fits(twin, data)
    recent = data if change is None else last_steps(data, change.n_steps)
    std = channel_deviations(recent)
    if twin.values == config.nominal:
        single = single_step_errors(twin, recent, std, _N_SINGLE)
        typical = float(np.quantile(single, _QUANTILE))
        if typical < _EXACT_STEP:
            return Correction(twin, beta, changed=False, error_twin=typical)
    try:
        windows = windows_of(data, twin, std, change)
    except TrajectoryError:
        return Correction(twin, beta, changed=False)
    nominal = twin.with_parameters(**config.nominal)
    nominal_errors, current_errors = (windows.errors(t) for t in (nominal, twin))
    real = windows.counted
    if len(real) < FEWEST:
        return Correction(twin, beta, changed=False, error_twin=rms(nominal_errors[real]))
    latest = latest_windows(windows, n_new)
    if max(rms(nominal_errors[real]), rms(nominal_errors[latest])) < EXACT:
        changed = gain(nominal_errors[real], current_errors[real]) > _NOTICEABLE
        return Correction(nominal, 0.0, changed=changed, error_twin=rms(nominal_errors[real]))
    windows, new_change = detect_change(windows, current_errors, latest, n_new)
    windows = hold_out_windows(windows, new_change or change)
    real = windows.counted
    if len(real) < FEWEST or not windows.held.any():
        return Correction(
            twin, beta, changed=False, change=new_change, error_twin=rms(nominal_errors[real])
        )
    found = _corrected(
        nominal, twin, config, windows, nominal_errors, current_errors, beta, learn_force
    )
    return dataclasses.replace(found, change=new_change)


def _corrected(
    nominal: Twin,
    twin: Twin,
    config: CorrectionConfig,
    windows: Windows,
    nominal_errors: np.ndarray,
    current_errors: np.ndarray,
    beta: float,
    learn_force: bool,
) -> Correction:
    """
    :param nominal: the twin before any data
    :param nominal_errors: errors of the nominal twin
    :param current_errors: errors of the current twin
    """
    nominal, twin, config, added = _add_suspects(nominal, twin, config)
    fit = _calibrated(nominal, twin, windows, config)
    calibrated, errors = _better_twin(nominal, twin, fit, nominal_errors, current_errors, windows)
    calibrated, errors, added = _drop_useless_suspects(calibrated, errors, added, windows)
    held = windows.held
    found = Correction(
        calibrated,
        0.0,
        changed=False,
        attached=added,
        fit=fit,
        error_twin=rms(nominal_errors[held]),
        error_calibrated=rms(errors[held]),
    )
    if beta > 0.0:
        current_errors = windows.errors(twin, twin.params)
    found, errors = _with_residual(found, windows, errors, config, learn_force)
    return dataclasses.replace(
        found, changed=gain(errors[held], current_errors[held]) > _NOTICEABLE
    )


def _add_suspects(
    nominal: Twin, twin: Twin, config: CorrectionConfig
) -> tuple[Twin, Twin, CorrectionConfig, dict[str, float]]:
    """
    Attach suspected effects with nominal parameters, which leave the errors unchanged.

    :return: both twins with the suspected effects, the config with their parameters, and the
        nominal values of these
    """
    missing = missing_effects(twin, config.suspected)
    if not missing:
        return nominal, twin, config, {}
    nominal, twin = nominal.extend(*missing), twin.extend(*missing)
    added = nulls_of(missing)
    config = dataclasses.replace(
        config, names=(*config.names, *added), nominal={**config.nominal, **added}
    )
    return nominal, twin, config, added


def _drop_useless_suspects(
    twin: Twin,
    errors: np.ndarray,
    added: Mapping[str, float],
    windows: Windows,
) -> tuple[Twin, np.ndarray, dict[str, float]]:
    """
    Detach suspected effects that do not lower the error, since they cost simulation time; the next
    correction estimates them again.

    :return: the twin without those effects, its errors, and ``added`` without their parameters
    """
    remaining = dict(added)
    for key in dict.fromkeys(name.rpartition(".")[0] for name in added):
        own = {name: null for name, null in added.items() if name.startswith(f"{key}.")}
        reduced = twin.with_parameters(**own)
        without = windows.errors(reduced)
        if gain(errors[windows.held], without[windows.held]) < _LEAST_OF_SUSPECT:
            twin, errors = reduced.without(key), without
            remaining = {name: null for name, null in remaining.items() if name not in own}
    return twin, errors, remaining


def _calibrated(
    nominal: Twin,
    twin: Twin,
    windows: Windows,
    config: CorrectionConfig,
) -> Fit | None:
    """:return: the fit, started at the current values, with the nominal model as prior, if any"""
    if not config.names:
        return None
    prior_values = np.array([nominal.values[name] for name in config.names])
    start = twin.with_parameters(**dict.fromkeys(shares_of(twin), 0.0))
    try:
        return fit_windows(
            start,
            untied(config.names),
            windows.learned,
            windows.origin,
            windows.std,
            prior=1.0,
            prior_mean=prior_values,
            max_steps=_SOLVER_STEPS,
        )
    except CalibrationError:
        return None


def _better_twin(
    nominal: Twin,
    twin: Twin,
    fit: Fit | None,
    nominal_errors: np.ndarray,
    current_errors: np.ndarray,
    windows: Windows,
) -> tuple[Twin, np.ndarray]:
    """:return: the best of calibrated, current and nominal twin, and its errors"""
    held = windows.held
    current = nominal, nominal_errors
    if current_errors[held].mean() < nominal_errors[held].mean():
        current = twin, current_errors
    if fit is None or not all(np.isfinite(e.estimate) for e in fit.estimates):
        return current
    if not windows.held_out_by_recording and probability_before(fit, nominal) < _IMPROBABLE:
        return current
    new = twin.with_parameters(**{e.name: e.estimate for e in fit.estimates})
    errors = windows.errors(new)
    if (
        gain(errors[held], nominal_errors[held]) > _LEAST_OF_CALIBRATION
        and gain(errors[held], current_errors[held]) >= 0.0
    ):
        return new, errors
    return current


def _with_residual(
    found: Correction,
    windows: Windows,
    errors: np.ndarray,
    config: CorrectionConfig,
    learn_force: bool,
) -> tuple[Correction, np.ndarray]:
    """:return: the correction, and the errors of the model to plan in"""
    twin, residual, held = found.twin, None, windows.held
    wanted = config.beta != 0.0 and rms(errors[held]) > EXACT
    if wanted and learn_force:
        scale = 0.05 * windows.std if found.fit is None else found.fit.noise
        scale = np.maximum(scale, 1e-3 * windows.std)
        try:
            residual = fit_force(
                twin, windows.shots, held, scale, seed=config.seed, **config.residual_kwargs
            )
        except CalibrationError:
            residual = None
    hybrid = twin if residual is None else residual.twin
    key = next(iter(shares_of(hybrid)), None)
    if key is None:
        return found, errors
    hybrid_errors = windows.errors(hybrid, {**hybrid.params, key: 1.0})
    found = dataclasses.replace(found, residual=residual, error_hybrid=rms(hybrid_errors[held]))
    # A force that does not lower the error only costs simulation time.
    if residual is not None and not (residual.accepted or shares_of(twin)):
        return found, errors
    helps = is_better(hybrid_errors[held], errors[held])
    share = 0.0
    if helps:
        trust = min(1.0, gain(hybrid_errors[held], errors[held]) / _TRUSTED)
        share = trust if config.beta == "auto" else float(config.beta)
    twin = hybrid.with_parameters(**{key: 1.0 if helps else 0.0})
    found = dataclasses.replace(found, twin=twin, beta=share)
    return found, hybrid_errors if share > 0.0 else errors


def names_to_estimate(twin: Twin, wanted: str | Sequence[str] | None) -> tuple[str, ...]:
    """
    :param wanted: ``"all"``, names of parameters, or None
    :return: full names of the parameters to estimate
    :raises CalibrationError: for a name that the twin does not have
    """
    if wanted == "all":
        return every_name(twin)
    return free_names(twin, wanted) if wanted else ()
