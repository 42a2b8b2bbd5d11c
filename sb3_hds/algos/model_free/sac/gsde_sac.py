"""gSDE-SAC: SAC with smooth, state-dependent exploration, or plain SAC without it."""

import dataclasses
from dataclasses import KW_ONLY

from sb3_hds.algos.base.config import takes
from sb3_hds.algos.model_free.sac.algorithm import SACConfig, SoftActorCritic


@dataclasses.dataclass(frozen=True, eq=False)
class GSDESACConfig(SACConfig):
    """
    Arguments of gSDE-SAC.

    :param use_sde: False: independent noise at each step; with ``train_freq=1, gradient_steps=1``
        that is plain SAC
    :param policy_kwargs: ``log_std_init``, ``full_std``, ``use_expln``, ``clip_mean`` and the other
        arguments of :class:`~sb3_hds.algos.GaussianPolicy`
    """

    _: KW_ONLY
    use_sde: bool = True
    train_freq: int | tuple[int, str] | None = 8
    gradient_steps: int = 8


class GSDESAC(SoftActorCritic):
    r"""
    SAC that explores by :math:`a = \mu(s) + \theta^T z(s)` with a noise matrix :math:`\theta` that
    is redrawn every few steps: smooth, state-dependent exploration that does not wear out motors.

    Source: Raffin, Kober and Stulp, *Smooth Exploration for Robotic Reinforcement Learning*, CoRL
    2021, based on Haarnoja et al., *Soft Actor-Critic Algorithms and Applications*, 2018. The
    features of the actor, the learned standard deviations (``log_std_init``, ``full_std``,
    ``use_expln``), ``clip_mean``, the marginal variance in the log-probability and
    ``use_sde_at_warmup`` are those of SB3; SBX draws noise that does not depend on the state and
    reports a standard deviation of 0. Unlike SB3, updates draw the noise of each state
    independently: from the same distribution, with less variance of the gradient. Without
    ``sde_sample_freq``, each collection of ``train_freq`` steps starts with new noise.
    """

    config_class = GSDESACConfig

    @takes(GSDESACConfig)
    def __init__(self, config: GSDESACConfig) -> None:
        self.construct(config)
