"""DroQ: dropout and layer norm in the critics, and many updates per step."""

import dataclasses
from typing import Any

from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, Schedule

from sb3_hds.algos.model_free.sac.algorithm import SoftActorCritic
from sb3_hds.algos.model_free.sac.update import Recipe, mean


class DroQ(SoftActorCritic):
    """
    Dropout Q-functions: a replay ratio of 20 that critics survive by dropout and layer norm.

    Source: Hiraoka et al., *Dropout Q-Functions for Doubly Efficient Reinforcement Learning*, ICLR
    2022. As there, and unlike SBX's setting of SAC, the actor climbs the **mean** of the critics
    (algorithm 2), not the least of them. The paper's target entropies are -1 for Hopper, -2 for
    Humanoid, -3 for Walker2d and -4 for Ant; its code has -3 for HalfCheetah, which the paper
    leaves out.

    :param policy: see :class:`~sb3_hds.algos.model_free.sac.algorithm.SoftActorCritic`
    :param env: likewise
    :param learning_rate: of actor, entropy coefficient and critics; number, schedule or
        ``"lin_3e-4"``
    :param gradient_steps: updates of the critics per call of ``train``
    :param policy_delay: updates of the critics for each of the actor
    :param policy_kwargs: ``dropout_rate`` is 0.01 and ``layer_norm`` True unless they are given
    :param arguments: those of ``SoftActorCritic``
    """

    def __init__(
        self,
        policy: str | type[BasePolicy] | GymEnv = "MlpPolicy",
        env: GymEnv | str | None = None,
        learning_rate: float | str | Schedule = 3e-4,
        *,
        gradient_steps: int = 20,
        policy_delay: int = 20,
        policy_kwargs: dict[str, Any] | None = None,
        **arguments: Any,
    ) -> None:
        super().__init__(
            policy,
            env,
            learning_rate=learning_rate,
            gradient_steps=gradient_steps,
            policy_delay=policy_delay,
            policy_kwargs={"dropout_rate": 0.01, "layer_norm": True, **(policy_kwargs or {})},
            **arguments,
        )

    def recipe(self) -> Recipe:
        return dataclasses.replace(super().recipe(), worth=mean)
