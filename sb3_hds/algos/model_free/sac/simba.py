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
    """Arguments of ``SimbaSACPolicy``, which squashes ``log_std`` unless it explores by gSDE."""

    default_squash_log_std = True


class SimbaSACPolicy(SimbaPolicy):
    """
    The policy of SimbaSAC. The action distribution (``squash_log_std=True`` without gSDE) and the
    initialisation of last layers are those of SimBa's authors, too.
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

    :param clipped_double_q: whether targets and actor use the minimum of the critics, not the mean
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
    SAC with SimBa's networks: observations normalised by running statistics inside the policy,
    residual blocks with layer norm, weight decay.

    Source: Lee et al., *SimBa: Simplicity Bias for Scaling Up Parameters in Deep Reinforcement
    Learning*, ICLR 2025: replay ratio 2, critics of width 512 and learning rate 1e-4
    (``policy_kwargs={"net_arch": {"pi": [128], "qf": [512, 512]}}, learning_rate=1e-4``; here a
    quarter of that width, which two cores can train, and four times that rate, since an update
    changes the output of a narrower layer less), weight decay 1e-2, initial temperature 0.01,
    target entropy of minus half the number of actions. The paper uses the minimum of two critics in
    tasks with early termination, in its later code in all of Gymnasium's MuJoCo tasks, and one
    critic in others: ``clipped_double_q=False`` with ``policy_kwargs={"n_critics": 1}``; with more
    critics, that uses their mean. For episodes of T steps, the paper's ``gamma`` is 1 - 5 / T,
    clipped to [0.95, 0.995].

    As in the authors' code, :math:`\tanh` squashes ``log_std`` of the actions into [-10, 2], so
    that their standard deviation starts near :math:`e^{-4}`; SAC and SBX clip it to [-20, 2] and
    start near 1. With gSDE (``use_sde=True``), the standard deviation of the noise matrix is
    neither squashed nor clipped. As in their code, the loss of the entropy coefficient is linear in
    the coefficient; in SBX, in its logarithm. The critics are updated before the actor, as in SBX
    and the other algorithms here; the authors' code updates them last.

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

    def make_update_config(self) -> UpdateConfig:
        config = super().make_update_config()
        if self.config.clipped_double_q:
            return config
        return dataclasses.replace(config, target_values=mean_values, actor_objective=mean_q)
