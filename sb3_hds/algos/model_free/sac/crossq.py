"""CrossQ: batch normalisation instead of target networks."""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY
from typing import ClassVar

from stable_baselines3.common.policies import BasePolicy

from sb3_hds.algos.base.config import Rate, takes
from sb3_hds.algos.model_free.sac.algorithm import SACConfig, SoftActorCritic
from sb3_hds.algos.model_free.sac.policy import GaussianPolicy, GaussianPolicyConfig


@dataclasses.dataclass(frozen=True, eq=False)
class CrossQPolicyConfig(GaussianPolicyConfig):
    """
    Arguments of ``CrossQPolicy``; the optimiser is Adam with a ``b1`` of 0.5.

    :param net_arch: ``{"pi": [256, 256], "qf": [512, 512]}`` by default
    :param renorm_warmup_steps: batch normalisation in actor and critics, which becomes batch
        renormalisation after this number of updates; None: neither of them
    """

    net_arch: Sequence[int] | Mapping[str, Sequence[int]] = dataclasses.field(
        default_factory=lambda: {"pi": (256, 256), "qf": (512, 512)}
    )
    renorm_warmup_steps: int | None = 100_000
    default_optimizer = ("adam", {"b1": 0.5})


class CrossQPolicy(GaussianPolicy):
    """
    Batch normalisation in actor and critics, and Adam with a ``b1`` of 0.5 (Bhatt et al., ICLR
    2024). The default critics have 512 units per layer, a quarter of the paper's, so that two cores
    can train them. The paper's: ``net_arch={"pi": [256, 256], "qf": [2048, 2048]}``.
    """

    @takes(CrossQPolicyConfig)
    def __init__(self, config: CrossQPolicyConfig) -> None:
        self.construct(config)


@dataclasses.dataclass(frozen=True, eq=False)
class CrossQConfig(SACConfig):
    """Arguments of CrossQ; ``tau`` and ``target_update_interval`` have no effect."""

    learning_rate: Rate = 1e-3
    _: KW_ONLY
    policy_delay: int = 3
    linear_ent_coef: bool = True


class CrossQ(SoftActorCritic):
    """
    Batch-normalised critics without target networks: one joint forward pass of the critics over
    current and next pairs of state and action.

    Source: Bhatt et al., *CrossQ: Batch Normalization in Deep Reinforcement Learning for Greater
    Sample Efficiency and Simplicity*, ICLR 2024: critics of width 2048
    (``policy_kwargs={"net_arch": {"pi": [256, 256], "qf": [2048, 2048]}}``; here 512, which two
    cores can train), Adam with b1 = 0.5, learning rate 1e-3, three updates of the critics per
    update of the actor, a discount of 0.99 (0.9999 on Swimmer). As in the authors' code, batch
    normalisation becomes batch renormalisation after 100,000 updates of the network
    (``policy_kwargs={"renorm_warmup_steps": ...}``), and the loss of the entropy coefficient is
    linear in the coefficient; in SBX, it is linear in its logarithm (``linear_ent_coef=False``),
    the default width is 1024, and learning-rate schedules have no effect.
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": CrossQPolicy,
        "MultiInputPolicy": CrossQPolicy,
    }
    policy_family = CrossQPolicy

    config_class = CrossQConfig

    @takes(CrossQConfig)
    def __init__(self, config: CrossQConfig) -> None:
        self.construct(config)
