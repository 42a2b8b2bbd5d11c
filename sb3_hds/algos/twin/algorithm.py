"""
What the algorithms that plan in a twin share.

SB3 collects real steps and calls ``train``, which is one planning epoch in the twin (the pure
functions in ``epoch.py``). Timesteps are steps of the user's environment only; simulated steps have
their own counter.
"""

import dataclasses
import math
from collections.abc import Callable
from concurrent.futures import Future
from functools import partial
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, RolloutReturn, TrainFreq

from sb3_hds.algos.base.algorithm import OffPolicyTensorAlgorithm
from sb3_hds.algos.base.checks import callbacks_of, jax_device
from sb3_hds.algos.twin.comparison import (
    choose_policy,
    comparison,
    is_compared,
    twin_steps_per_comparison,
)
from sb3_hds.algos.twin.config import TwinConfig, epoch_config
from sb3_hds.algos.twin.epoch import EpochMetrics, epoch, epoch_log, programs, twin_steps_per_epoch
from sb3_hds.algos.twin.planning_twin import (
    LearnedTensors,
    check_reward,
    check_twin_observes,
    normalization_of,
    prepare_statistics,
    require_twin,
    twin_from_spec,
    twin_given,
)
from sb3_hds.algos.twin.policy import TwinPolicy, all_finite
from sb3_hds.algos.twin.pretraining import PretrainingCallback
from sb3_hds.algos.twin.state import (
    EpochConfig,
    EpochState,
    Hyperparams,
    Workspace,
    init_workspace,
    longest_episode,
)
from sb3_hds.algos.twin.threads import no_poll, run_in_thread, run_in_threads
from sb3_hds.core import Params, Twin
from sb3_hds.core.contract import check_methods
from sb3_hds.core.numerics.compilation import GENERATOR
from sb3_hds.envs.mirror import check_mirrors, twin_of
from sb3_hds.errors import DivergedError

# Decay per epoch of the running means that end the pretraining early, and the fewest epochs before.
_RECENT = 0.9
_FEWEST_EPOCHS = 20
# Factor on the temperature of the annealed acceptance after each epoch: below 1 % after fifty.
_TEMPERATURE_DECAY = 0.9


class TwinAlgorithm(OffPolicyTensorAlgorithm):
    """
    Abstract: base of PODS and HDS.

    ``learn`` runs the planning epochs of the pretraining (``pretraining.py``), then SB3 alternates
    between real steps and :meth:`train`. Both call :meth:`run_epoch`: ``epoch`` (``epoch.py``)
    plans in the twin and regresses the policy on the plans, ``choose_policy`` (``comparison.py``)
    decides which policy acts.
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MlpPolicy": TwinPolicy}
    policy_family = TwinPolicy
    config_class = TwinConfig
    policy: TwinPolicy
    twin: Twin | None
    #: the twin contains the wrappers, so its inputs are the actions before them
    stores_executed: ClassVar[bool] = False
    check_observations = staticmethod(check_twin_observes)

    def construct(self, config: TwinConfig, **more: Any) -> None:  # type: ignore[override]
        config = dataclasses.replace(config, twin=twin_given(config.twin))
        super().construct(config, sde_support=False, **more)
        self.twin_spec: dict[str, Any] | None = None
        # Running means over epochs of the pretraining, which ends when plans stop gaining.
        self.recent_gain, self.recent_return = 0.0, 0.0
        self.n_pretrained = 0
        # A step that was passed to callbacks and not yet added to the replay buffer.
        self.unstored_step: dict[str, Any] | None = None
        self.real_timesteps, self.twin_timesteps = 0, 0
        self.learned_force = LearnedTensors(self)
        self._n_updates = 0
        # In the current call of ``learn``.
        self._epochs_planned, self._epochs_done = 0, 0
        self._workspace: Workspace | None = None
        # Config of the compiled programs; whether that of the comparison compiles, or is compiled.
        self._compiled: EpochConfig | None = None
        self._comparison_compiles: Future[Any] | None = None
        self._comparison_is_compiled = False
        # Whether a callback ended the training, and a function to call while programs compile.
        self.stopped = False
        self.poll: Callable[[], None] = no_poll

    def _setup_model(self) -> None:
        super()._setup_model()
        device = jax_device(self._device_name)
        self.policy = self.policy_class(  # type: ignore[assignment]
            self.observation_space, self.action_space, self.lr_schedule, **self.policy_kwargs
        )
        self.policy.build(jax.random.key(self.network_seed, impl=GENERATOR), device)
        self._workspace = None
        self._setup_twin()

    def _setup_twin(self) -> None:
        """Set the twin: the one that was passed, or had been when saved, or the environment's."""
        given: Any = self.twin  # a name, where one was passed to `load`
        if given is not None and not isinstance(given, Twin):
            self.twin = twin_given(given)
        elif given is None and self.twin_spec is not None:
            self.twin = twin_from_spec(self.twin_spec)
        if self.twin is not None:
            self.twin_spec = self.twin.to_spec()
        self._match_env()

    def _match_env(self) -> None:
        """Plan with the twin of the environment, unless one was passed."""
        twin = self.twin
        if self.env is not None:
            if self.twin_spec is None:
                twin = twin_of(self.env)
            elif twin is not None:
                check_mirrors(self.env, twin)
        if twin is not None:
            check_methods(twin)
            check_reward(twin)
            twin = self._prepare_twin(twin)
            if self.twin is not None and not twin.same_values(self.twin):
                self._workspace = None
        self.twin = twin

    def _prepare_twin(self, twin: Twin) -> Twin:
        """:return: the twin to plan in, given the environment's twin or the one that was passed"""
        return twin

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """
        :param env: an environment with a twin, the same spaces and the same number of copies
        :param force_reset: False continues from the environment's current state
        :raises NoTwinError: if it has no twin; the model then keeps its environment
        """
        before = self.env, self.n_envs, self._vec_normalize_env, self._last_obs
        super().set_env(env, force_reset)
        try:
            self._match_env()
        except Exception:
            self.env, self.n_envs, self._vec_normalize_env, self._last_obs = before
            raise
        if self._last_obs is None:
            self.unstored_step = None

    def _init_callback(self, callback: MaybeCallback, progress_bar: bool = False) -> BaseCallback:
        """SB3 calls it once everything is set up for ``learn``: the pretraining runs there."""
        around = PretrainingCallback(callbacks_of(callback), progress_bar)
        return super()._init_callback(around, progress_bar)

    def _setup_learn(self, total_timesteps: int, *args: Any, **kwargs: Any):
        before = self._last_obs
        total_timesteps, callback = super()._setup_learn(total_timesteps, *args, **kwargs)
        if self._last_obs is not before:
            # The environment was reset: the step did not begin where the next one does.
            self.unstored_step = None
        steps = total_timesteps - self.num_timesteps
        self._epochs_planned = self.pretraining_due + math.ceil(steps / self._steps_per_epoch)
        self._epochs_done, self.stopped = 0, False
        return total_timesteps, callback

    @property
    def _steps_per_epoch(self) -> int:
        """Real steps between two epochs; the most there can be if ``train_freq`` is in episodes."""
        assert isinstance(self.train_freq, TrainFreq)
        if self.train_freq.unit.value == "step":
            return self.train_freq.frequency * self.n_envs
        return self.train_freq.frequency * longest_episode(self._epoch_config.twin)

    def before_planning(self) -> None:
        """Called when a training starts, before the first planning epoch."""

    @property
    def pretraining_due(self) -> int:
        """Number of remaining planning epochs before the next real step."""
        config = self.config
        enough = config.refinements.least_gain * self.recent_return
        if self.n_pretrained >= _FEWEST_EPOCHS and self.recent_gain < enough:
            return 0
        return max(0, config.pretrain_epochs - self.n_pretrained)

    def pretrain_epoch(self) -> None:
        """
        One planning epoch before the first real step. If plans stop gaining, it is the last one,
        and schedules skip the epochs that are left out.
        """
        planned = self.pretraining_due
        steps = self.gradient_steps if self.gradient_steps >= 0 else self._steps_per_epoch
        plans = self.run_epoch(steps).plans
        before, after = float(plans.before), float(plans.after)
        self.recent_gain = _RECENT * self.recent_gain + max(0.0, after - before)
        self.recent_return = _RECENT * self.recent_return + abs(before)
        self.n_pretrained += 1
        self._epochs_done += planned - 1 - self.pretraining_due

    def collect_rollouts(self, *args: Any, **kwargs: Any) -> RolloutReturn:
        if self.stopped:
            # A callback ended the training before the first step.
            return RolloutReturn(0, 0, continue_training=False)
        return super().collect_rollouts(*args, **kwargs)

    def _store_transition(
        self,
        replay_buffer: ReplayBuffer,
        buffer_action: np.ndarray,
        new_obs: np.ndarray,  # type: ignore[override]
        reward: np.ndarray,
        dones: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        self.unstored_step = None
        super()._store_transition(replay_buffer, buffer_action, new_obs, reward, dones, infos)
        self.real_timesteps += self.n_envs

    def train(self, gradient_steps: int, batch_size: int) -> None:
        """One planning epoch with ``gradient_steps`` regression steps, between real steps."""
        self._n_updates += gradient_steps
        self.run_epoch(gradient_steps)

    def run_epoch(self, gradient_steps: int) -> EpochMetrics:
        """
        One planning epoch: improve plans in the twin and regress the policy on them.

        :param gradient_steps: regression steps
        :return: metrics, on the device
        :raises NoTwinError: if the model was loaded without environment and without twin
        :raises DivergedError: if the regression diverged; the model keeps its last finite state
        """
        state, static = self._epoch_state(), self._epoch_config
        hyper = self.hyperparams(static.twin, gradient_steps)
        self._compile_ahead(static, state, hyper)
        state, metrics = epoch(static, state, hyper)
        every = self.config.refinements.compare_every
        due = is_compared(int(state.progress.n_epochs), every, self.comparison_due)
        if due and self._comparison_compiles is not None:
            run_in_threads([self._comparison_compiles.result], self.poll)
            self._comparison_compiles, self._comparison_is_compiled = None, True
        state, returns = choose_policy(static, state, hyper, due, self.was_compared)
        losses = float(metrics.policy_loss), float(metrics.value_loss)
        if not (all(map(math.isfinite, losses)) and all_finite(state.networks)):
            raise DivergedError(
                f"The regression diverged (losses {losses}); the model keeps the state before this "
                "epoch. Lower learning_rate."
            )
        self.policy.networks, self.policy.progress = state.networks, state.progress
        self._workspace = state.workspace
        self._epochs_done += 1
        self.twin_timesteps += twin_steps_per_epoch(static)
        if returns is not None:
            self.twin_timesteps += twin_steps_per_comparison(static)
        for name, value in epoch_log(metrics, hyper, returns).items():
            self.logger.record(name, value)
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        self.logger.record("time/epochs", int(self.policy.progress.n_epochs))
        self.logger.record("time/twin_timesteps", self.twin_timesteps)
        return metrics

    def _compile_ahead(self, static: EpochConfig, state: EpochState, hyper: Hyperparams) -> None:
        """
        Compile the programs of an epoch unless they are, and that of the comparison in another
        thread during the epochs before it is due.
        """
        if static != self._compiled:
            run_in_threads(programs(static, state, hyper), self.poll)
            self._compiled = static
            self._comparison_compiles, self._comparison_is_compiled = None, False
        every = self.config.refinements.compare_every
        n_epochs = int(self.policy.progress.n_epochs)
        ahead = max(1, self._epochs_planned - self._epochs_done)
        soon = every > 0 and (self.comparison_due or n_epochs % every + ahead >= every)
        if soon and self._comparison_compiles is None and not self._comparison_is_compiled:
            self._comparison_compiles = run_in_thread(comparison(static, state, hyper))

    def _epoch_state(self) -> EpochState:
        """The state that an epoch changes; before the first one, find the scales of the task."""
        static, policy = self._epoch_config, self.policy
        workspace = self._workspace
        if workspace is None:
            fresh = int(policy.progress.n_epochs) == 0
            if fresh:
                seed = int(np.asarray(policy.progress.key)[0])
                prepare_statistics(self.get_vec_normalize_env(), static.twin, jax.random.key(seed))
            normalization, params = self._normalization(static.twin), static.twin.params
            started = partial(init_workspace, static, params, normalization, policy.progress)
            [(workspace, scales, progress)] = run_in_threads([started], self.poll)
            if fresh:
                policy.networks = policy.networks._replace(inside=scales.inside)
                progress = progress._replace(
                    reward_scale=scales.reward_scale, reward_offset=scales.reward_offset
                )
            self._workspace, policy.progress = workspace, progress
        return EpochState(policy.networks, policy.progress, workspace)

    @property
    def _epoch_config(self) -> EpochConfig:
        """Static configuration of an epoch."""
        return epoch_config(self.config, self.policy, require_twin(self.twin, self.twin_spec))

    def hyperparams(self, twin: Twin, gradient_steps: int) -> Hyperparams:
        """:return: the hyperparameters of the next epoch, which may change without recompiling"""
        config, n_epochs = self.config, int(self.policy.progress.n_epochs)
        how = config.refinements
        return Hyperparams(
            params=twin.params,
            varied=self.varied(twin),
            learning_rate=self.lr_schedule(self._progress_remaining()),
            noise=config.exploration_noise * config.exploration_decay**n_epochs,
            temperature=config.temperature * _TEMPERATURE_DECAY**n_epochs,
            reset_share=config.reset_share,
            gain_weight=how.gain_weight,
            sensitivity_weight=how.sensitivity_weight,
            averaging=how.averaging,
            gradient_steps=gradient_steps,
            vec_normalize=self._normalization(twin),
        )

    def varied(self, twin: Twin) -> Params:
        """
        :return: parameters that differ between the rollouts of an epoch, each of shape
            ``(n_rollouts,)``
        """
        config = self.config
        if not config.randomisation:
            return {}
        drawn = {}
        for name, parameter in twin.parameters.items():
            deviation = config.randomisation * parameter.scale * np.random.randn(config.n_rollouts)
            values = np.clip(twin.values[name] + deviation, parameter.lower, parameter.upper)
            drawn[name] = jnp.asarray(values, jnp.float32)
        return drawn

    def _normalization(self, twin: Twin) -> Any:
        return normalization_of(self.get_vec_normalize_env(), len(twin.channels))

    @property
    def comparison_due(self) -> bool:
        """Whether policies are compared after this epoch regardless of ``compare_every``."""
        return False

    @property
    def was_compared(self) -> bool:
        """Whether policies were compared after an earlier epoch."""
        every = self.config.refinements.compare_every
        return every > 0 and int(self.policy.progress.n_epochs) >= every

    def _progress_remaining(self) -> float:
        """From 1 to 0 over the planning epochs of this call of ``learn``, pretraining included."""
        if not self._epochs_planned:
            return 1.0
        return max(0.0, 1.0 - self._epochs_done / self._epochs_planned)

    def remedies(self, updates_per_step: float) -> list[str]:
        n = self.config.n_rollouts
        return [
            f"n_rollouts={max(1, n // 4)}, {n} now",
            "a larger train_freq",
            f"fewer gradient_steps, {updates_per_step:.3g} for each step now",
            "a GPU",
        ]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        names, variables = super()._get_torch_save_params()
        return [*names, "learned_force"], variables

    def _excluded_save_params(self) -> list[str]:
        ours = [
            "twin",
            "_workspace",
            "_compiled",
            "_comparison_compiles",
            "_comparison_is_compiled",
            "poll",
            "stopped",
            "unstored_step",
            "learned_force",
        ]
        return [*super()._excluded_save_params(), *ours]
