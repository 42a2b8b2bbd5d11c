"""What the SAC family shares: soft actor-critic on the networks of its policies."""

import dataclasses
import math
import warnings
from collections.abc import Mapping
from dataclasses import KW_ONLY
from typing import Any, ClassVar

import jax
import numpy as np
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import TrainFrequencyUnit

from sb3_hds.algos.base.checks import jax_device
from sb3_hds.algos.base.config import between, takes
from sb3_hds.algos.model_free.algorithm import ModelFreeAlgorithm, ModelFreeConfig
from sb3_hds.algos.model_free.replay import batches_of
from sb3_hds.algos.model_free.sac.policy import GaussianPolicy, SimbaPolicy
from sb3_hds.algos.model_free.sac.update import (
    Hyperparams,
    UpdateConfig,
    UpdateMetrics,
    log_of,
    squared_error,
    update,
)
from sb3_hds.algos.model_free.update import zero_metrics

# Updates per compiled call.
_MOST_UPDATES = 64


@dataclasses.dataclass(frozen=True, eq=False)
class SACConfig(ModelFreeConfig):
    """
    Arguments of the SAC family.

    :param ent_coef: a number, ``"auto"``, or ``"auto_0.1"`` to start there
    :param target_entropy: a number, or ``"auto"``: minus the number of actions, with SimBa and BRO
        half of that
    :param linear_ent_coef: whether the loss of the entropy coefficient is linear in the coefficient
        itself, as in equation 18 of the paper, instead of in its logarithm, as in SB3, SBX and the
        authors' code of DroQ and TQC
    :param target_update_interval: updates of the critics between two updates of the target critics,
        counted from the first; SB3 restarts the count in each call of ``train``
    """

    _: KW_ONLY
    ent_coef: float | str = "auto"
    target_entropy: float | str = "auto"
    linear_ent_coef: bool = False
    target_update_interval: int = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        entropy = self.target_entropy
        fine = entropy == "auto" or between(entropy, -math.inf, math.inf)
        self.require(fine, "target_entropy", "'auto' or a number")
        self.require_flag("linear_ent_coef")
        self.require_counts({"target_update_interval": 1})
        initial_ent_coef(self.ent_coef)


class SoftActorCritic(ModelFreeAlgorithm):
    """
    Abstract: soft actor-critic (Haarnoja et al. 2018). Algorithms of this family differ by their
    :class:`~sb3_hds.algos.model_free.sac.update.UpdateConfig`.
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": GaussianPolicy,
        "MultiInputPolicy": GaussianPolicy,
        "SimbaPolicy": SimbaPolicy,
    }
    policy_family = GaussianPolicy
    # With the entropy coefficient and its optimiser, as in SBX.
    kept_by_resets = ("log_ent_coef", "obs_stats", "n_updates")
    policy: GaussianPolicy
    ent_coef: float | str
    target_entropy: float | str

    config_class = SACConfig
    #: the algorithm's defaults for arguments of the policy
    default_policy_kwargs: ClassVar[Mapping[str, Any]] = {}

    @takes(SACConfig)
    def __init__(self, config: SACConfig) -> None:
        self.construct(config)

    def construct(self, config: SACConfig, **more: Any) -> None:  # type: ignore[override]
        policy_kwargs = {**self.default_policy_kwargs, **(config.policy_kwargs or {})}
        super().construct(dataclasses.replace(config, policy_kwargs=policy_kwargs), **more)

    def make_update_config(self) -> UpdateConfig:
        """
        Config of the update: that of SAC for the networks of the policy
        (``GaussianPolicy.default_update_config``) with the arguments of this algorithm. Subclasses
        replace parts of it.
        """
        config = self.config
        return dataclasses.replace(
            self.policy.default_update_config(),
            policy_delay=config.policy_delay,
            target_update_interval=config.target_update_interval,
            learns_ent_coef=isinstance(config.ent_coef, str),
            linear_ent_coef=bool(config.linear_ent_coef),
        )

    def auto_target_entropy(self) -> float:
        """:return: the value of ``target_entropy="auto"``"""
        return -float(self.policy.n_act)

    def check_environment(self, config: Any) -> None:
        super().check_environment(config)
        each_step = config.train_freq in (1, (1, "step"))
        if config.use_sde and config.sde_sample_freq < 1 and each_step:
            warnings.warn(
                f"{type(self).__name__}(use_sde=True, train_freq=1) draws a new noise matrix at "
                "each step, which is not smooth: pass sde_sample_freq=8, or train_freq=8 and "
                "gradient_steps=8."
            )

    def _setup_model(self) -> None:
        super()._setup_model()
        if self.policy.update_config.joint_pass:
            why = "there are no target networks with batch normalisation"
            self.warn_of_unused(self.config, "tau", "target_update_interval", why=why)

    def set_parameters(
        self,
        load_path_or_dict: str | dict[str, Any],
        exact_match: bool = True,
        device: Any = "auto",
    ) -> None:
        super().set_parameters(load_path_or_dict, exact_match, device)
        if not isinstance(self.ent_coef, str):
            # A fixed coefficient is an argument, so keep this model's value; `load` gets here, too.
            before = self.policy.agent_state.log_ent_coef
            fixed = {"params": log_of(self.ent_coef)}
            now = before._replace(weights=fixed)
            self.policy.agent_state = self.policy.agent_state._replace(log_ent_coef=now)

    def _build(self, seed: int) -> None:
        start, device = initial_ent_coef(self.ent_coef), jax_device(self._device_name)
        config, n_quantiles = self.make_update_config(), self.policy.n_quantiles
        if config.critic_loss is squared_error and n_quantiles > 1:
            raise ValueError(
                f"{type(self).__name__}(policy_kwargs={{'n_quantiles': {n_quantiles}}}): its "
                "critics have one value each: leave it out, or use TQC."
            )
        self.policy.build(config, start, seed, device)

    def _updates(self, n: int, batch_size: int) -> dict[str, float]:
        policy, hyper = self.policy, self.hyperparams()
        report, metrics = {}, zero_metrics(UpdateMetrics)
        for done in range(0, n, _MOST_UPDATES):
            now = min(_MOST_UPDATES, n - done)
            batches = batches_of(self.replay_source, now, batch_size, next_power_of_2(now))
            state, metrics = update(
                policy.update_config, policy.agent_state, batches, now, hyper, metrics
            )
            metrics = jax.device_get(metrics)  # NumPy, as before the first update: compiles once
            report = {name: float(value) for name, value in metrics._asdict().items()}
            self._accept(state, report)
        return report

    def hyperparams(self) -> Hyperparams:
        """:return: the current values of the hyperparameters that may change"""
        rate, qf_rate = self.learning_rates()
        entropy = self.target_entropy
        wanted = self.auto_target_entropy() if entropy == "auto" else float(entropy)
        return Hyperparams(rate, qf_rate, self.tau, wanted)

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        # SB3 has drawn noise matrices at the start of the collection.
        by_steps = self.train_freq.unit == TrainFrequencyUnit.STEP  # type: ignore[union-attr]
        if self.use_sde and self.sde_sample_freq > 0 and by_steps:
            self.policy.noise_for_step(n_envs, self.sde_sample_freq)
        return super()._sample_action(learning_starts, action_noise, n_envs)

    def after_step(
        self, new_obs: np.ndarray | dict[str, np.ndarray], reward: np.ndarray, dones: np.ndarray
    ) -> None:
        self.policy.update_obs_stats(new_obs)


def initial_ent_coef(ent_coef: float | str) -> float:
    """
    :return: the first value of the entropy coefficient
    :raises ValueError: for anything but a number of at least 0, ``"auto"``, or ``"auto_NUMBER"``
        with a number above 0
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


def next_power_of_2(n: int) -> int:
    """:return: the least power of 2 that is at least ``n``: few sizes are few compiled programs"""
    return 1 << (n - 1).bit_length()
