"""SimBa: SAC with residual networks on normalised observations."""

import dataclasses
from dataclasses import KW_ONLY
from typing import ClassVar

import flax.linen as nn
from stable_baselines3.common.policies import BasePolicy

from sb3_hds.algos.base.config import Rate, takes
from sb3_hds.algos.model_free.sac.algorithm import SACConfig, SoftActorCritic
from sb3_hds.algos.model_free.sac.networks import ORTHONORMAL
from sb3_hds.algos.model_free.sac.policy import SimbaPolicy, SimbaPolicyConfig
from sb3_hds.algos.model_free.sac.update import UpdateConfig, mean_q, mean_values


@dataclasses.dataclass(frozen=True, eq=False)
class SimbaSACPolicyConfig(SimbaPolicyConfig):
    """Arguments of ``SimbaSACPolicy``, which squashes the deviation unless it explores by gSDE."""

    squashes = True


class SimbaSACPolicy(SimbaPolicy):
    """
    The policy of SimbaSAC: also what actions are drawn from is that of SimBa's authors, with
    ``squash_log_std=True`` where there is no gSDE, and so is where last layers start.
    """

    @takes(SimbaSACPolicyConfig)
    def __init__(self, config: SimbaSACPolicyConfig) -> None:
        self.construct(config)

    def last_layers(self) -> tuple[nn.initializers.Initializer, nn.initializers.Initializer]:
        return ORTHONORMAL, ORTHONORMAL


@dataclasses.dataclass(frozen=True, eq=False)
class SimbaSACConfig(SACConfig):
    """
    Arguments of SimbaSAC.

    :param clipped_double_q: whether the minimum of the critics counts, not their mean
    """

    learning_rate: Rate = 4e-4
    _: KW_ONLY
    gradient_steps: int = 2
    ent_coef: float | str = "auto_0.01"
    linear_ent_coef: bool = True
    clipped_double_q: bool = True

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_flag("clipped_double_q")


class SimbaSAC(SoftActorCritic):
    r"""
    SAC with SimBa's networks: a running normalisation of observations inside the policy, residual
    blocks with layer norm, weight decay.

    Source: Lee et al., *SimBa: Simplicity Bias for Scaling Up Parameters in Deep Reinforcement
    Learning*, ICLR 2025: replay ratio 2, critics of width 512 and learning rate 1e-4
    (``policy_kwargs={"net_arch": {"pi": [128], "qf": [512, 512]}}, learning_rate=1e-4``; here a
    quarter of that width, which two cores can train, and four times that rate, since a layer's
    values change the less at an update the fewer units it has), weight decay 1e-2, initial
    temperature 0.01, target entropy of minus half the number of controls. The least of two critics
    counts in tasks that end early; their later code takes all of MuJoCo's in Gymnasium for such,
    HalfCheetah included. In others, the authors have one critic: ``clipped_double_q=False`` with
    ``policy_kwargs={"n_critics": 1}``; of more, it takes the mean. Their discount, 1 - 5 / T with
    episodes of T steps, within 0.95 and 0.995, is for ``gamma`` to say.

    As in the authors' code, :math:`\tanh` squashes the logarithm of the deviation of actions into
    [-10, 2]: actions start with a deviation near :math:`e^{-4}`, where SAC and SBX clip it to [-20,
    2] and start near 1. With gSDE (``use_sde=True``), the deviation is that of the noise matrix,
    which is neither. The loss of the entropy coefficient has the coefficient itself, as theirs,
    where SBX has its logarithm. Critics are updated before the actor, as in SBX and in the other
    algorithms here; the authors' code updates them last.

    SBX's variant is ``learning_rate=3e-4, ent_coef="auto", target_entropy=-n_act,
    linear_ent_coef=False, gradient_steps=1`` with ``policy_kwargs={"net_arch": [256, 256],
    "normalize_observations": False, "squash_log_std": False, "optimizer_kwargs": {"weight_decay":
    1e-4}}``.
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": SimbaSACPolicy,
        "MultiInputPolicy": SimbaSACPolicy,
        "SimbaPolicy": SimbaSACPolicy,
    }

    config_class = SimbaSACConfig

    @takes(SimbaSACConfig)
    def __init__(self, config: SimbaSACConfig) -> None:
        self.construct(config)

    def auto_target_entropy(self) -> float:
        return -0.5 * self.policy.n_act

    def update_config(self) -> UpdateConfig:
        config = super().update_config()
        if self.config.clipped_double_q:
            return config
        return dataclasses.replace(config, target_values=mean_values, actor_objective=mean_q)
