"""CrossQ: batch normalisation in the place of target networks."""

from typing import Any, ClassVar

from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, Schedule

from sb3_hds.algos.model_free.sac.algorithm import SoftActorCritic
from sb3_hds.algos.model_free.sac.policy import CrossQPolicy


class CrossQ(SoftActorCritic):
    """
    Batch normalisation in deep reinforcement learning: one pass of the critics over current and
    next pairs of state and action, and no target networks.

    Source: Bhatt et al., *CrossQ: Batch Normalization in Deep Reinforcement Learning for Greater
    Sample Efficiency and Simplicity*, ICLR 2024: critics of width 2048
    (``policy_kwargs={"net_arch": {"pi": [256, 256], "qf": [2048, 2048]}}``; here 512, which two
    cores bear), Adam with b1 = 0.5, learning rate 1e-3, three updates of the critics for each of
    the actor.
    Their discount is 0.99, but 0.9999 on Swimmer. Batch normalisation becomes batch
    renormalisation, in each network after 100,000 updates of its own, as in the authors' code
    (``policy_kwargs={"renorm_warmup_steps": ...}``). SBX's default width is 1024, and its
    learning rate never changes; here, schedules act. The loss of the entropy coefficient has the
    coefficient itself, as in the authors' code, where SBX has its logarithm
    (``linear_ent_coef=False``).

    :param policy: see :class:`~sb3_hds.algos.model_free.sac.algorithm.SoftActorCritic`
    :param env: likewise
    :param learning_rate: of actor, entropy coefficient and critics
    :param policy_delay: updates of the critics for each of the actor
    :param linear_ent_coef: whether the loss of the entropy coefficient has it itself
    :param arguments: those of ``SoftActorCritic``; ``tau`` and ``target_update_interval`` have
        no meaning here
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": CrossQPolicy,
        "MultiInputPolicy": CrossQPolicy,
    }
    policy_family = CrossQPolicy

    def __init__(
        self,
        policy: str | type[BasePolicy] | GymEnv = "MlpPolicy",
        env: GymEnv | str | None = None,
        learning_rate: float | str | Schedule = 1e-3,
        *,
        policy_delay: int = 3,
        linear_ent_coef: bool = True,
        **arguments: Any,
    ) -> None:
        super().__init__(
            policy,
            env,
            learning_rate=learning_rate,
            policy_delay=policy_delay,
            linear_ent_coef=linear_ent_coef,
            **arguments,
        )
