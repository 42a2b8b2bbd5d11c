"""TQC: quantile critics; the largest quantiles are dropped from the targets."""

import dataclasses
from dataclasses import KW_ONLY
from typing import Any

from sb3_hds.algos.base.config import check_count, takes
from sb3_hds.algos.model_free.sac.algorithm import SACConfig, SoftActorCritic
from sb3_hds.algos.model_free.sac.objectives import TruncatedQuantiles, mean_q, quantile_huber
from sb3_hds.algos.model_free.sac.update import UpdateConfig


@dataclasses.dataclass(frozen=True, eq=False)
class TQCConfig(SACConfig):
    """
    Arguments of TQC.

    :param top_quantiles_to_drop_per_net: times the number of critics: how many of the largest
        quantiles of all critics together are dropped from the targets
    :param policy_kwargs: ``n_quantiles`` is 25 unless given; see
        :class:`~sb3_hds.algos.GaussianPolicy`
    """

    _: KW_ONLY
    top_quantiles_to_drop_per_net: int = 2

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_counts({"top_quantiles_to_drop_per_net": 0})


class TQC(SoftActorCritic):
    """
    Truncated quantile critics.

    Source: Kuznetsov et al., *Controlling Overestimation Bias with Truncated Mixture of Continuous
    Distributional Quantile Critics*, ICML 2020: 25 quantiles, five networks of three layers of 512
    (``policy_kwargs={"n_critics": 5, "net_arch": {"pi": [256, 256], "qf": [512, 512, 512]}}``), of
    which 2 quantiles are dropped for each network, none on HalfCheetah, 5 on Hopper; learning
    starts with the first full batch (``learning_starts=256``). SB3-contrib and SBX use two
    networks; so does the default here.
    """

    config_class = TQCConfig
    usual_policy_kwargs = {"n_quantiles": 25}

    @takes(TQCConfig)
    def __init__(self, config: TQCConfig) -> None:
        self.construct(config)

    def update_config(self) -> UpdateConfig:
        return dataclasses.replace(
            super().update_config(),
            target_values=TruncatedQuantiles(self.config.top_quantiles_to_drop_per_net),
            critic_loss=quantile_huber,
            actor_objective=mean_q,
        )

    def check_environment(self, config: Any) -> None:
        super().check_environment(config)
        n, n_quantiles = config.top_quantiles_to_drop_per_net, config.policy_kwargs["n_quantiles"]
        check_count("n_quantiles", n_quantiles)
        if n >= n_quantiles:
            raise ValueError(
                "top_quantiles_to_drop_per_net must be a whole number of at least 0 and below the "
                f"{n_quantiles} quantiles of a critic (policy_kwargs={{'n_quantiles': ...}}), got "
                f"{n!r}."
            )
