"""What an epoch tells SB3's logger."""

from typing import TYPE_CHECKING, Any

from sb3_hds.algos.epoch import Report
from sb3_hds.algos.learner import Knobs

if TYPE_CHECKING:
    from sb3_hds.algos.twin_algorithm import TwinAlgorithm


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
    record("train/worsened_plans", int(report.worsened))
    record("train/dropped_samples", int(report.dropped))
    record("train/exploration_noise", knobs.noise)
    record("train/temperature", knobs.temperature)
    record("train/n_updates", model._n_updates, exclude="tensorboard")
    record("time/epochs", int(model.policy.progress.n_epochs))
    record("time/twin_timesteps", model.twin_timesteps)
