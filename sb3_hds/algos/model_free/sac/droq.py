"""DroQ: dropout and layer norm in the critics, and many updates per step."""

import dataclasses
from dataclasses import KW_ONLY

from sb3_hds.algos.base.config import takes
from sb3_hds.algos.model_free.sac.algorithm import SACConfig, SoftActorCritic
from sb3_hds.algos.model_free.sac.update import UpdateConfig, mean_q


@dataclasses.dataclass(frozen=True, eq=False)
class DroQConfig(SACConfig):
    """
    Arguments of DroQ: a replay ratio of 20.

    :param policy_kwargs: ``dropout_rate`` is 0.01 and ``layer_norm`` True by default; see
        :class:`~sb3_hds.algos.GaussianPolicy`
    """

    _: KW_ONLY
    gradient_steps: int = 20
    policy_delay: int = 20


class DroQ(SoftActorCritic):
    """
    Dropout Q-functions: a replay ratio of 20, which dropout and layer norm in the critics allow.

    Source: Hiraoka et al., *Dropout Q-Functions for Doubly Efficient Reinforcement Learning*, ICLR
    2022. As there (algorithm 2), and unlike SBX's configuration of SAC, the actor maximises the
    **mean** of the critics, not their minimum. The paper's target entropies are -1 for Hopper, -2
    for Humanoid, -3 for Walker2d and -4 for Ant; its code has -3 for HalfCheetah.
    """

    config_class = DroQConfig
    default_policy_kwargs = {"dropout_rate": 0.01, "layer_norm": True}

    @takes(DroQConfig)
    def __init__(self, config: DroQConfig) -> None:
        self.construct(config)

    def make_update_config(self) -> UpdateConfig:
        return dataclasses.replace(super().make_update_config(), actor_objective=mean_q)
