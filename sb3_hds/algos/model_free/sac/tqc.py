"""TQC: quantile critics, of which the largest quantiles are left out."""

import dataclasses
from typing import Any

from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, Schedule

from sb3_hds.algos.base.construct import check_count, is_count
from sb3_hds.algos.model_free.sac.algorithm import SoftActorCritic
from sb3_hds.algos.model_free.sac.quantiles import Truncated, quantile_huber
from sb3_hds.algos.model_free.sac.update import Recipe, mean


class TQC(SoftActorCritic):
    """
    Truncated quantile critics.

    Source: Kuznetsov et al., *Controlling Overestimation Bias with Truncated Mixture of Continuous
    Distributional Quantile Critics*, ICML 2020: 25 quantiles, five networks of three layers of 512
    (``policy_kwargs={"n_critics": 5, "net_arch": {"pi": [256, 256], "qf": [512, 512, 512]}}``), of
    which 2 quantiles are dropped for each network, none on HalfCheetah, 5 on Hopper; learning
    starts with the first full batch (``learning_starts=256``). SB3-contrib and SBX use two
    networks; so does the default here.

    :param policy: see :class:`~sb3_hds.algos.model_free.sac.algorithm.SoftActorCritic`
    :param env: likewise
    :param learning_rate: of actor, entropy coefficient and critics; number, schedule or
        ``"lin_3e-4"``
    :param top_quantiles_to_drop_per_net: as many times the number of critics are left out of the
        pool of all critics' next values, the largest of the pool
    :param policy_kwargs: ``n_quantiles`` is 25 unless given
    :param arguments: those of ``SoftActorCritic``
    """

    def __init__(
        self,
        policy: str | type[BasePolicy] | GymEnv = "MlpPolicy",
        env: GymEnv | str | None = None,
        learning_rate: float | str | Schedule = 3e-4,
        *,
        top_quantiles_to_drop_per_net: int = 2,
        policy_kwargs: dict[str, Any] | None = None,
        **arguments: Any,
    ) -> None:
        self.top_quantiles_to_drop_per_net = top_quantiles_to_drop_per_net
        super().__init__(
            policy,
            env,
            learning_rate=learning_rate,
            policy_kwargs={"n_quantiles": 25, **(policy_kwargs or {})},
            **arguments,
        )

    def recipe(self) -> Recipe:
        return dataclasses.replace(
            super().recipe(),
            target_of=Truncated(self.top_quantiles_to_drop_per_net),
            error=quantile_huber,
            worth=mean,
        )

    def check_arguments(self) -> None:
        super().check_arguments()
        n, n_quantiles = self.top_quantiles_to_drop_per_net, self.policy_kwargs["n_quantiles"]
        check_count("n_quantiles", n_quantiles)
        if not (is_count(n, 0) and n < n_quantiles):
            raise ValueError(
                "top_quantiles_to_drop_per_net must be a whole number of at least 0 and below the "
                f"{n_quantiles} quantiles of a critic (policy_kwargs={{'n_quantiles': ...}}), got "
                f"{n!r}."
            )
