"""The shell of the SAC family."""

import dataclasses
import math
import warnings
from typing import Any, ClassVar

import jax
import numpy as np
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, Schedule, TrainFrequencyUnit

from sb3_hds.algos.base.construct import between, is_count, jax_device
from sb3_hds.algos.model_free.algorithm import ModelFreeAlgorithm
from sb3_hds.algos.model_free.replay import batches_of
from sb3_hds.algos.model_free.sac.policy import GaussianPolicy, SimbaPolicy
from sb3_hds.algos.model_free.sac.update import (
    Knobs,
    Recipe,
    Report,
    before_any,
    log_of,
    squared,
    update,
)

# Updates of one compiled call; more are made in several.
_MOST_UPDATES = 64


class SoftActorCritic(ModelFreeAlgorithm):
    """
    Abstract: soft actor-critic (Haarnoja et al. 2018), on which the algorithms of this family
    differ by their :class:`~sb3_hds.algos.model_free.sac.update.Recipe`.

    :param policy: ``"MlpPolicy"``, ``"MultiInputPolicy"`` for Dict observations, ``"SimbaPolicy"``
        (not CrossQ and BRO), a policy class, or the environment itself
    :param env: an environment, its id, or a vectorised environment
    :param learning_rate: of actor, entropy coefficient and critics; number, schedule or
        ``"lin_3e-4"``
    :param ent_coef: a number, ``"auto"``, or ``"auto_0.1"`` to start there
    :param target_entropy: a number, or ``"auto"``: minus the number of controls
    :param linear_ent_coef: whether the loss of the entropy coefficient has it itself, as equation
        18 of the paper, not its logarithm, as SB3, SBX and the authors' code of DroQ and TQC
    :param target_update_interval: updates of the critics for each of the target networks, counted
        from the first; SB3 counts anew in each call of ``train``
    :param arguments: those of :class:`~sb3_hds.algos.model_free.algorithm.ModelFreeAlgorithm`
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": GaussianPolicy,
        "MultiInputPolicy": GaussianPolicy,
        "SimbaPolicy": SimbaPolicy,
    }
    policy_family = GaussianPolicy
    #: fields of the learner that ``param_resets`` leaves as they are
    kept_by_restarts: ClassVar[tuple[str, ...]] = ("log_ent_coef", "seen", "n_updates")
    policy: GaussianPolicy

    def __init__(
        self,
        policy: str | type[BasePolicy] | GymEnv = "MlpPolicy",
        env: GymEnv | str | None = None,
        learning_rate: float | str | Schedule = 3e-4,
        *,
        ent_coef: float | str = "auto",
        target_entropy: float | str = "auto",
        linear_ent_coef: bool = False,
        target_update_interval: int = 1,
        **arguments: Any,
    ) -> None:
        self.ent_coef, self.target_entropy = ent_coef, target_entropy
        self.linear_ent_coef = linear_ent_coef
        self.target_update_interval = target_update_interval
        super().__init__(policy, env, learning_rate=learning_rate, **arguments)

    def recipe(self) -> Recipe:
        """:return: what an update is made of"""
        return dataclasses.replace(
            self.policy.plain_recipe(),
            policy_delay=self.policy_delay,
            target_every=self.target_update_interval,
            learns_ent_coef=isinstance(self.ent_coef, str),
            linear_ent_coef=bool(self.linear_ent_coef),
        )

    def auto_target_entropy(self) -> float:
        """:return: what ``target_entropy="auto"`` means here"""
        return -float(self.policy.n_act)

    def check_arguments(self) -> None:
        super().check_arguments()
        entropy = self.target_entropy
        fine = entropy == "auto" or between(entropy, -math.inf, math.inf)
        self.refuse_unless(fine, "target_entropy", "'auto' or a number")
        fine = isinstance(self.linear_ent_coef, bool | np.bool_)
        self.refuse_unless(fine, "linear_ent_coef", "True or False")
        fine = is_count(self.target_update_interval, 1)
        self.refuse_unless(fine, "target_update_interval", "a whole number of at least 1")
        _initial_ent_coef(self.ent_coef)
        if self.use_sde and self.sde_sample_freq < 1 and self.train_freq in (1, (1, "step")):
            warnings.warn(
                f"{type(self).__name__}(use_sde=True, train_freq=1) draws a new noise matrix at "
                "each step, which is not smooth: pass sde_sample_freq=8, or train_freq=8 and "
                "gradient_steps=8."
            )

    def _setup_model(self) -> None:
        super()._setup_model()
        if self.policy.recipe.joint_pass:
            why = "there are no target networks with batch normalisation"
            self.warn_unless_usual("tau", "target_update_interval", why=why)

    def set_parameters(
        self,
        load_path_or_dict: str | dict[str, Any],
        exact_match: bool = True,
        device: Any = "auto",
    ) -> None:
        super().set_parameters(load_path_or_dict, exact_match, device)
        if not isinstance(self.ent_coef, str):
            # What is no parameter of this model is not another one's to set; ``load`` passes here.
            before = self.policy.learner.log_ent_coef
            fixed = {"params": log_of(self.ent_coef)}
            now = before._replace(weights=fixed)
            self.policy.learner = self.policy.learner._replace(log_ent_coef=now)

    def _build(self, seed: int) -> None:
        start, device = _initial_ent_coef(self.ent_coef), jax_device(self._device_name)
        recipe, n_quantiles = self.recipe(), self.policy.n_quantiles
        if recipe.error is squared and n_quantiles > 1:
            raise ValueError(
                f"{type(self).__name__}(policy_kwargs={{'n_quantiles': {n_quantiles}}}): its "
                "critics have one value each: leave it out, or use TQC."
            )
        self.policy.build(recipe, start, seed, device)

    def _restart(self, seed: int) -> None:
        """The entropy coefficient stays with its optimiser, as in SBX, but for BRO."""
        before = self.policy.learner
        self._build(seed)
        kept = {name: getattr(before, name) for name in self.kept_by_restarts}
        self.policy.learner = self.policy.learner._replace(**kept)

    def _updates(self, n: int, batch_size: int) -> dict[str, float]:
        policy, knobs, report, found = self.policy, self.knobs(), {}, before_any(Report)
        for done in range(0, n, _MOST_UPDATES):
            now = min(_MOST_UPDATES, n - done)
            batches = batches_of(self, now, batch_size, _capacity(now))
            learner, found = update(policy.recipe, policy.learner, batches, now, knobs, found)
            report = _plain(found)
            self._take(learner, report)
        return report

    def knobs(self) -> Knobs:
        """:return: what schedules make of the arguments, at this point of the training"""
        rate, qf_rate = self.learning_rates()
        entropy = self.target_entropy
        wanted = self.auto_target_entropy() if entropy == "auto" else float(entropy)
        return Knobs(rate, qf_rate, self.tau, wanted)

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        # SB3 has drawn noise matrices at the start of the collection.
        if self.use_sde and self.sde_sample_freq > 0 and self._collects_steps():
            self.policy.keep_noise(n_envs, self.sde_sample_freq)
        return super()._sample_action(learning_starts, action_noise, n_envs)

    def _collects_steps(self) -> bool:
        freq: Any = self.train_freq
        return freq.unit == TrainFrequencyUnit.STEP

    def _store_transition(
        self,
        replay_buffer: ReplayBuffer,
        buffer_action: np.ndarray,
        new_obs: np.ndarray | dict[str, np.ndarray],
        reward: np.ndarray,
        dones: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        super()._store_transition(replay_buffer, buffer_action, new_obs, reward, dones, infos)
        self.policy.observed(new_obs)


def _initial_ent_coef(ent_coef: float | str) -> float:
    """
    :raises ValueError: for anything but a number of at least 0, ``"auto"`` or ``"auto_NUMBER"``,
        which is above 0
    """
    start: Any = ent_coef
    if isinstance(ent_coef, str):
        kind, _, start = ent_coef.partition("_")
        start = start or "1.0" if kind == "auto" else "nan"
    try:
        value = float(start)
    except (TypeError, ValueError):
        value = math.nan
    fine = 0.0 < value < math.inf or (value == 0.0 and not isinstance(ent_coef, str))
    if not fine:
        raise ValueError(
            f"ent_coef must be a number of at least 0, 'auto', or 'auto_0.1' to start there, got "
            f"{ent_coef!r}."
        )
    return value


def _capacity(n: int) -> int:
    """:return: the power of 2 from ``n`` on: few sizes are few compiled programs"""
    return 1 << (n - 1).bit_length()


def _plain(report: Report) -> dict[str, float]:
    return {name: float(value) for name, value in jax.device_get(report)._asdict().items()}
