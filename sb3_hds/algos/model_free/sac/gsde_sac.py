"""SAC with generalised state-dependent exploration."""

import dataclasses
from dataclasses import KW_ONLY

from sb3_hds.algos.base.config import takes
from sb3_hds.algos.model_free.sac.algorithm import SACConfig, SoftActorCritic


@dataclasses.dataclass(frozen=True, eq=False)
class GSDESACConfig(SACConfig):
    """
    Arguments of gSDE-SAC.

    :param use_sde: False: independent noise at each step, and with ``train_freq=1,
        gradient_steps=1`` plain SAC
    :param policy_kwargs: ``log_std_init``, ``full_std``, ``use_expln``, ``clip_mean`` and those of
        every :class:`~sb3_hds.algos.GaussianPolicy`
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
    2021; on Haarnoja et al., *Soft Actor-Critic Algorithms and Applications*, 2018. SBX draws
    noise that does not depend on the state and reports a deviation of 0; here, the features of the
    actor, the learned deviations (``log_std_init``, ``full_std``, ``use_expln``), ``clip_mean``,
    the marginal variance in the log-probability and ``use_sde_at_warmup`` are those of SB3. Unlike
    SB3, updates draw the noise of each state independently: its distribution is the same, its
    gradient varies less. Without ``sde_sample_freq``, each collection of ``train_freq`` steps
    begins with new noise.
    """

    config_class = GSDESACConfig

    @takes(GSDESACConfig)
    def __init__(self, config: GSDESACConfig) -> None:
        self.construct(config)
