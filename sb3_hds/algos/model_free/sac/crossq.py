"""CrossQ: batch normalisation in the place of target networks."""

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
    usual_optimizer = ("adam", {"b1": 0.5})


class CrossQPolicy(GaussianPolicy):
    """
    Batch normalisation in actor and critics, and Adam's ``b1`` of 0.5 (Bhatt et al., ICLR 2024).
    Their critics have 2048 units, which two cores are too slow for: ``net_arch={"pi": [256, 256],
    "qf": [2048, 2048]}``; the default has a quarter of them.
    """

    @takes(CrossQPolicyConfig)
    def __init__(self, config: CrossQPolicyConfig) -> None:
        self.construct(config)


@dataclasses.dataclass(frozen=True, eq=False)
class CrossQConfig(SACConfig):
    """
    Arguments of CrossQ; ``tau`` and ``target_update_interval`` have no effect.
    """

    learning_rate: Rate = 1e-3
    _: KW_ONLY
    policy_delay: int = 3
    linear_ent_coef: bool = True


class CrossQ(SoftActorCritic):
    """
    Batch normalisation in deep reinforcement learning: one pass of the critics over current and
    next pairs of state and action, and no target networks.

    Source: Bhatt et al., *CrossQ: Batch Normalization in Deep Reinforcement Learning for Greater
    Sample Efficiency and Simplicity*, ICLR 2024: critics of width 2048
    (``policy_kwargs={"net_arch": {"pi": [256, 256], "qf": [2048, 2048]}}``; here 512, which two
    cores can train), Adam with b1 = 0.5, learning rate 1e-3, three updates of the critics for each
    of the actor. Their discount is 0.99, but 0.9999 on Swimmer. Batch normalisation becomes batch
    renormalisation, in each network after 100,000 updates of its own, as in the authors' code
    (``policy_kwargs={"renorm_warmup_steps": ...}``). SBX's default width is 1024, and its learning
    rate never changes; here, schedules act. The loss of the entropy coefficient has the coefficient
    itself, as in the authors' code, where SBX has its logarithm (``linear_ent_coef=False``).
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
