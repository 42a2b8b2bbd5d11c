"""Correction of the twin by measured data: parameters of twin and effects, then a learned force."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from sb3_hds.algos.twin.hds.recorded_steps import last_steps
from sb3_hds.algos.twin.hds.windows import (
    EXACT,
    FEWEST,
    ChangePoint,
    Windows,
    detect_change,
    force_share_name,
    hold_out_windows,
    latest_windows,
    no_force,
    rms,
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
    :param replan: whether the model has changed so much that plans should be made again
    :param change_point: start of the data that count, if a change of the system was detected
    :param attached: nominal values of the parameters of newly attached effects
    :param fit: of the parameters, if they were estimated
    :param residual: the learned force, if it was learned
    :param error_twin: of the nominal twin
    :param error_calibrated: of the calibrated twin
    :param error_hybrid: of the calibrated twin with the learned force
    """

    twin: Twin
    beta: float
    replan: bool
    change_point: ChangePoint | None = None
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
        forgotten = int(self.change_point is not None)
        values: dict[str, float] = {"beta": self.beta, "forgotten": forgotten}
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
        with_prefix = lambda logged: {f"model/{name}": x for name, x in logged.items()}  # noqa: E731
        return with_prefix(values), with_prefix(intervals)


class Tested(NamedTuple):
    """
    A twin whose predictions were compared with the data.

    :param errors: of each window
    """

    twin: Twin
    errors: np.ndarray


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
            return Correction(twin, beta, replan=False, error_twin=typical)
    try:
        windows = windows_of(data, twin, std, change)
    except TrajectoryError:
        return Correction(twin, beta, replan=False)
    both = twin.with_parameters(**config.nominal), twin
    nominal, current = (Tested(each, windows.errors(each)) for each in both)
    real = windows.counted
    if len(real) < FEWEST:
        return Correction(twin, beta, replan=False, error_twin=rms(nominal.errors[real]))
    latest = latest_windows(windows, n_new)
    if max(rms(nominal.errors[real]), rms(nominal.errors[latest])) < EXACT:
        replan = gain(nominal.errors[real], current.errors[real]) > _NOTICEABLE
        error = rms(nominal.errors[real])
        return Correction(nominal.twin, 0.0, replan=replan, error_twin=error)
    windows, change_point = detect_change(windows, current.errors, latest, n_new)
    windows = hold_out_windows(windows, change_point or change)
    real = windows.counted
    if len(real) < FEWEST or not windows.held_out.any():
        error = rms(nominal.errors[real])
        return Correction(twin, beta, replan=False, change_point=change_point, error_twin=error)
    correction = _corrected(nominal, current, config, windows, beta, learn_force)
    return dataclasses.replace(correction, change_point=change_point)


def _corrected(
    nominal: Tested,
    current: Tested,
    config: CorrectionConfig,
    windows: Windows,
    beta: float,
    learn_force: bool,
) -> Correction:
    """
    :param nominal: the twin before any data
    :param current: the twin that was planned in so far; its errors are those without learned force
    """
    nominal, current, config, added = _add_suspects(nominal, current, config)
    fit = _calibrated(nominal.twin, current.twin, windows, config)
    best = _better_twin(nominal, current, fit, windows)
    best, added = _drop_useless_suspects(best, added, windows)
    held_out = windows.held_out
    correction = Correction(
        best.twin,
        0.0,
        replan=False,
        attached=added,
        fit=fit,
        error_twin=rms(nominal.errors[held_out]),
        error_calibrated=rms(best.errors[held_out]),
    )
    errors_before = current.errors
    if beta > 0.0:
        errors_before = windows.errors(current.twin, current.twin.params)
    correction, errors = _with_residual(correction, best, windows, config, learn_force)
    replan = gain(errors[held_out], errors_before[held_out]) > _NOTICEABLE
    return dataclasses.replace(correction, replan=replan)


def _add_suspects(
    nominal: Tested, current: Tested, config: CorrectionConfig
) -> tuple[Tested, Tested, CorrectionConfig, dict[str, float]]:
    """
    Attach suspected effects with nominal parameters, which leave the errors unchanged.

    :return: both twins with the suspected effects, the config with their parameters, and the
        nominal values of these
    """
    missing = missing_effects(current.twin, config.suspected)
    if not missing:
        return nominal, current, config, {}
    nominal, current = (t._replace(twin=t.twin.extend(*missing)) for t in (nominal, current))
    added = nulls_of(missing)
    config = dataclasses.replace(
        config, names=(*config.names, *added), nominal={**config.nominal, **added}
    )
    return nominal, current, config, added


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
    try:
        return fit_windows(
            twin.with_parameters(**no_force(twin)),
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


def _better_twin(nominal: Tested, current: Tested, fit: Fit | None, windows: Windows) -> Tested:
    """:return: the best of calibrated, current and nominal twin"""
    held_out = windows.held_out
    better = nominal
    if current.errors[held_out].mean() < nominal.errors[held_out].mean():
        better = current
    if fit is None or not all(np.isfinite(e.estimate) for e in fit.estimates):
        return better
    if not windows.held_out_by_recording and probability_before(fit, nominal.twin) < _IMPROBABLE:
        return better
    twin = current.twin.with_parameters(**{e.name: e.estimate for e in fit.estimates})
    calibrated = Tested(twin, windows.errors(twin))
    if (
        gain(calibrated.errors[held_out], nominal.errors[held_out]) > _LEAST_OF_CALIBRATION
        and gain(calibrated.errors[held_out], current.errors[held_out]) >= 0.0
    ):
        return calibrated
    return better


def _drop_useless_suspects(
    best: Tested, added: Mapping[str, float], windows: Windows
) -> tuple[Tested, dict[str, float]]:
    """
    Detach suspected effects that do not lower the error, since they cost simulation time; the next
    correction estimates them again.

    :return: the twin without those effects, and ``added`` without their parameters
    """
    remaining = dict(added)
    for key in dict.fromkeys(name.rpartition(".")[0] for name in added):
        own = {name: null for name, null in added.items() if name.startswith(f"{key}.")}
        reduced = best.twin.with_parameters(**own)
        errors = windows.errors(reduced)
        if gain(best.errors[windows.held_out], errors[windows.held_out]) < _LEAST_OF_SUSPECT:
            best = Tested(reduced.without(key), errors)
            remaining = {name: null for name, null in remaining.items() if name not in own}
    return best, remaining


def _with_residual(
    correction: Correction,
    best: Tested,
    windows: Windows,
    config: CorrectionConfig,
    learn_force: bool,
) -> tuple[Correction, np.ndarray]:
    """
    :param best: the twin of the correction
    :return: the correction, and the errors of the model to plan in
    """
    (twin, errors), residual, held_out = best, None, windows.held_out
    wanted = config.beta != 0.0 and rms(errors[held_out]) > EXACT
    if wanted and learn_force:
        scale = 0.05 * windows.std if correction.fit is None else correction.fit.noise
        scale = np.maximum(scale, 1e-3 * windows.std)
        try:
            residual = fit_force(
                twin, windows.shots, held_out, scale, seed=config.seed, **config.residual_kwargs
            )
        except CalibrationError:
            residual = None
    hybrid = twin if residual is None else residual.twin
    share_name = force_share_name(hybrid)
    if share_name is None:
        return correction, errors
    hybrid_errors = windows.errors(hybrid, {**hybrid.params, share_name: 1.0})
    error_hybrid = rms(hybrid_errors[held_out])
    correction = dataclasses.replace(correction, residual=residual, error_hybrid=error_hybrid)
    # A force that does not lower the error only costs simulation time.
    if residual is not None and not (residual.accepted or force_share_name(twin)):
        return correction, errors
    helps = is_better(hybrid_errors[held_out], errors[held_out])
    beta = 0.0
    if helps:
        trust = min(1.0, gain(hybrid_errors[held_out], errors[held_out]) / _TRUSTED)
        beta = trust if config.beta == "auto" else float(config.beta)
    twin = hybrid.with_parameters(**{share_name: 1.0 if helps else 0.0})
    correction = dataclasses.replace(correction, twin=twin, beta=beta)
    return correction, hybrid_errors if beta > 0.0 else errors


def names_to_estimate(twin: Twin, wanted: str | Sequence[str] | None) -> tuple[str, ...]:
    """
    :param wanted: ``"all"``, names of parameters, or None
    :return: full names of the parameters to estimate
    :raises CalibrationError: for a name that the twin does not have
    """
    if wanted == "all":
        return every_name(twin)
    return free_names(twin, wanted) if wanted else ()
