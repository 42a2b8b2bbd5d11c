"""SimBa: SAC with residual networks on normalised observations."""

import dataclasses
from typing import Any, ClassVar

import numpy as np
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, Schedule

from sb3_hds.algos.model_free.sac.algorithm import SoftActorCritic
from sb3_hds.algos.model_free.sac.policy import SimbaSACPolicy
from sb3_hds.algos.model_free.sac.update import Recipe, average, mean


class SimbaSAC(SoftActorCritic):
    r"""
    SAC with SimBa's networks: a running normalisation of observations inside the policy, residual
    blocks with layer norm, weight decay.

    Source: Lee et al., *SimBa: Simplicity Bias for Scaling Up Parameters in Deep Reinforcement
    Learning*, ICLR 2025: replay ratio 2, critics of width 512 and learning rate 1e-4
    (``policy_kwargs={"net_arch": {"pi": [128], "qf": [512, 512]}}, learning_rate=1e-4``; here a
    quarter of that width, which two cores bear, and four times that rate, since a layer's values
    change the less at an update the fewer units it has), weight decay 1e-2, initial temperature
    0.01, target entropy of minus half the number of controls. The least of two critics counts in
    tasks that end early; their later code takes all of MuJoCo's in Gymnasium for such, HalfCheetah
    included. In others, the authors have one critic: ``clipped_double_q=False`` with
    ``policy_kwargs={"n_critics": 1}``; of more, it takes the mean. Their
    discount, 1 - 5 / T with episodes of T steps, within 0.95 and 0.995, is for ``gamma`` to say.

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

    :param policy: see :class:`~sb3_hds.algos.model_free.sac.algorithm.SoftActorCritic`
    :param env: likewise
    :param learning_rate: of actor, entropy coefficient and critics
    :param gradient_steps: updates per call of ``train``
    :param ent_coef: a number, ``"auto"``, or ``"auto_0.1"`` to start there
    :param linear_ent_coef: whether the loss of the entropy coefficient has it itself
    :param clipped_double_q: whether the least of the critics counts, not their mean
    :param arguments: those of ``SoftActorCritic``
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": SimbaSACPolicy,
        "MultiInputPolicy": SimbaSACPolicy,
        "SimbaPolicy": SimbaSACPolicy,
    }

    def __init__(
        self,
        policy: str | type[BasePolicy] | GymEnv = "MlpPolicy",
        env: GymEnv | str | None = None,
        learning_rate: float | str | Schedule = 4e-4,
        *,
        gradient_steps: int = 2,
        ent_coef: float | str = "auto_0.01",
        linear_ent_coef: bool = True,
        clipped_double_q: bool = True,
        **arguments: Any,
    ) -> None:
        self.clipped_double_q = clipped_double_q
        super().__init__(
            policy,
            env,
            learning_rate=learning_rate,
            gradient_steps=gradient_steps,
            ent_coef=ent_coef,
            linear_ent_coef=linear_ent_coef,
            **arguments,
        )

    def check_arguments(self) -> None:
        super().check_arguments()
        fine = isinstance(self.clipped_double_q, bool | np.bool_)
        self.refuse_unless(fine, "clipped_double_q", "True or False")

    def auto_target_entropy(self) -> float:
        return -0.5 * self.policy.n_act

    def recipe(self) -> Recipe:
        recipe = super().recipe()
        if self.clipped_double_q:
            return recipe
        return dataclasses.replace(recipe, target_of=average, worth=mean)
