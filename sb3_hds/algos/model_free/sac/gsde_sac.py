"""SAC with generalised state-dependent exploration."""

from typing import Any

from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, Schedule

from sb3_hds.algos.model_free.sac.algorithm import SoftActorCritic


class GSDESAC(SoftActorCritic):
    r"""
    SAC that explores by :math:`a = \mu(s) + \theta^T z(s)` with a noise matrix :math:`\theta` that
    is drawn anew every few steps: smooth motion that depends on the state, which motors
    stand.

    Source: Raffin, Kober and Stulp, *Smooth Exploration for Robotic Reinforcement Learning*, CoRL
    2021; on Haarnoja et al., *Soft Actor-Critic Algorithms and Applications*, 2018. SBX draws
    noise that does not depend on the state and reports a deviation of 0; here, the features of the
    actor, the learned deviations (``log_std_init``, ``full_std``, ``use_expln``), ``clip_mean``,
    the marginal variance in the log-probability and ``use_sde_at_warmup`` are those of SB3. Unlike
    SB3, updates draw the noise of each state independently: its distribution is the same, its
    gradient varies less. Without ``sde_sample_freq``, each collection of ``train_freq`` steps
    begins with new noise.

    :param policy: see :class:`~sb3_hds.algos.model_free.sac.algorithm.SoftActorCritic`
    :param env: likewise
    :param learning_rate: of actor, entropy coefficient and critics; number, schedule or
        ``"lin_3e-4"``
    :param use_sde: False: independent noise at each step, and with ``train_freq=1,
        gradient_steps=1`` plain SAC
    :param train_freq: steps between two calls of ``train``
    :param gradient_steps: updates in each of them
    :param policy_kwargs: ``log_std_init``, ``full_std``, ``use_expln``, ``clip_mean`` and those of
        every policy
    :param arguments: those of ``SoftActorCritic``
    """

    def __init__(
        self,
        policy: str | type[BasePolicy] | GymEnv = "MlpPolicy",
        env: GymEnv | str | None = None,
        learning_rate: float | str | Schedule = 3e-4,
        *,
        use_sde: bool = True,
        train_freq: int | tuple[int, str] = 8,
        gradient_steps: int = 8,
        **arguments: Any,
    ) -> None:
        super().__init__(
            policy,
            env,
            learning_rate=learning_rate,
            use_sde=use_sde,
            train_freq=train_freq,
            gradient_steps=gradient_steps,
            **arguments,
        )
