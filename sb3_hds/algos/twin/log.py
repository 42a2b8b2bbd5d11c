"""What an epoch tells SB3's logger."""

import math
from typing import TYPE_CHECKING, Any

from sb3_hds.algos.twin.epoch import Report
from sb3_hds.algos.twin.state import Knobs

if TYPE_CHECKING:
    from sb3_hds.algos.twin.algorithm import TwinAlgorithm
    from sb3_hds.algos.twin.hds.algorithm import HDS
    from sb3_hds.algos.twin.hds.correction import Correction


def record_epoch(model: "TwinAlgorithm", report: Report, knobs: Knobs, returns: Any) -> None:
    """
    Record what happened, and the schedules of this epoch.

    :param returns: of the policies that were compared, the best one last; None if none were
    """
    record = model.logger.record
    record("train/learning_rate", knobs.learning_rate)
    record("train/plan_return_before", float(report.before))
    record("train/plan_return_after", float(report.after))
    if returns is not None:
        record("train/return_of_average", float(returns[0]))
        record("train/return_of_best", float(max(returns)))
    record("train/policy_loss", float(report.policy_loss))
    record("train/value_loss", float(report.value_loss))
    record("train/gradient_norm", float(report.gradient_norm))
    record("train/worsened_plans", int(report.worsened))
    record("train/dropped_samples", int(report.dropped))
    record("train/exploration_noise", knobs.noise)
    record("train/temperature", knobs.temperature)
    record("train/n_updates", model._n_updates, exclude="tensorboard")
    record("time/epochs", int(model.policy.progress.n_epochs))
    record("time/twin_timesteps", model.twin_timesteps)


def record_correction(model: "HDS", found: "Correction") -> None:
    """
    Record what the data say about the model: errors that there are, and parameters as the model has
    them now, with the interval of those that it took over from the fit.
    """
    record = model.logger.record
    record("model/beta", found.beta)
    record("model/forgotten", int(found.forgotten))
    for name in ("error_twin", "error_calibrated", "error_hybrid"):
        error = getattr(found, name)
        if not (math.isnan(error) or (name == "error_calibrated" and found.fit is None)):
            record(f"model/{name}", error)
    if found.residual is not None:
        record("model/disagreement", found.residual.disagreement)
    for estimate in found.fit.estimates if found.fit is not None else ():
        value = found.twin.values.get(estimate.name)
        if value is None:
            continue
        record(f"model/{estimate.name}", value)
        if value == estimate.estimate:
            record(f"model/{estimate.name}_low", estimate.low, exclude="stdout")
            record(f"model/{estimate.name}_high", estimate.high, exclude="stdout")
