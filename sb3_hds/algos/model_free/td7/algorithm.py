"""TD7: learned embeddings, prioritised replay, and checkpoints of assessed policies."""

import dataclasses
from dataclasses import KW_ONLY
from typing import Any, ClassVar

import jax
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import ActionNoise, NormalActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import TrainFreq

from sb3_hds.algos.base.checks import jax_device
from sb3_hds.algos.base.config import takes
from sb3_hds.algos.model_free.algorithm import ModelFreeAlgorithm, ModelFreeConfig
from sb3_hds.algos.model_free.replay import Batch, batches_of, transitions
from sb3_hds.algos.model_free.td7.policy import TD7Policy
from sb3_hds.algos.model_free.td7.prioritized_replay import LapReplayBuffer
from sb3_hds.algos.model_free.td7.update import UpdateConfig, UpdateMetrics, update
from sb3_hds.algos.model_free.update import zero_metrics


@dataclasses.dataclass(frozen=True, eq=False)
class TD7Config(ModelFreeConfig):
    """
    Arguments of TD7.

    :param policy: ``"MlpPolicy"``, ``"MultiInputPolicy"`` for Dict observations, a policy class, or
        the environment itself
    :param learning_rate: of encoder, actor and critics; number, schedule or ``"lin_3e-4"``
    :param tau: no effect: target networks are copied
    :param train_freq: steps between two calls of ``train``, or ``(n, "episode")``; None: one
        episode with checkpoints, one step without
    :param gradient_steps: updates per call of ``train``; no effect with checkpoints
    :param target_update_interval: updates between two copies into the target networks
    :param target_policy_noise: standard deviation of the noise on the target policy's actions,
        which are in [-1, 1]
    :param target_noise_clip: limit of that noise
    :param exploration_noise: standard deviation of the noise on actions, unless ``action_noise`` is
        passed
    :param priority_exponent: exponent of errors in priorities; 0: uniform
    :param use_checkpoints: whether policies are assessed; None: with a single environment
    :param max_episodes_per_checkpoint: episodes per assessment after
        ``updates_before_checkpointing``
    :param updates_before_checkpointing: updates until which one episode is an assessment
    :param reset_weight: factor on the best assessment at that point
    :param policy_kwargs: see :class:`~sb3_hds.algos.TD7Policy`
    """

    _: KW_ONLY
    learning_starts: int = 25_000
    train_freq: int | tuple[int, str] | None = None
    policy_delay: int = 2
    target_update_interval: int = 250
    target_policy_noise: float = 0.2
    target_noise_clip: float = 0.5
    exploration_noise: float = 0.1
    priority_exponent: float = 0.4
    use_checkpoints: bool | None = None
    max_episodes_per_checkpoint: int = 20
    updates_before_checkpointing: int = 750_000
    reset_weight: float = 0.9
    derived = ("train_freq",)

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_counts({"target_update_interval": 1, "max_episodes_per_checkpoint": 1})
        noises = ("target_policy_noise", "target_noise_clip", "exploration_noise")
        self.require_range(0.0, np.inf, "a number of at least 0", *noises)
        self.require_range(0.0, 1.0, "from 0 to 1", "priority_exponent", "reset_weight")
        self.require(not self.use_sde, "use_sde", "False: noise is added to the actions")
        kind = self.replay_buffer_class
        if isinstance(kind, type) and issubclass(kind, LapReplayBuffer):
            self.require(self.n_steps == 1, "n_steps", "1 with LapReplayBuffer")
            compressed, allowed = self.optimize_memory_usage, "False with LapReplayBuffer"
            self.require(not compressed, "optimize_memory_usage", allowed)


class TD7(ModelFreeAlgorithm):
    """
    TD3 with state-action embeddings, prioritised replay, value clipping and checkpoints of the
    policy.

    Source: Fujimoto et al., *For SALE: State-Action Representation Learning for Deep Reinforcement
    Learning*, NeurIPS 2023, with its constants (appendix): target networks are copied every 250
    updates, exploration noise is 0.1, the first 25,000 steps are random, the priority exponent is
    0.4, and an assessment takes 20 episodes after 750,000 updates, one before. Kernels and biases
    start uniform, as in the authors' code (torch's defaults). Unlike there, noise is added to
    random actions, too, as in SB3.

    With checkpoints, as in the paper, a policy acts for whole episodes and is assessed by the
    lowest of their returns, in unnormalised rewards; only then it is updated, once for each of its
    steps. That needs a single environment, and episodes that end: if one never does, ``learn``
    never returns, unless ``use_checkpoints=False``. Checkpoints make ``gradient_steps`` ineffective
    (``tau`` always is: target networks are copied). ``param_resets`` keep the checkpoint and its
    assessment. If a model with a checkpoint continues learning without assessments, its first
    update drops the checkpoint. Without a checkpoint, the current policy acts. SBX has no TD7.

    Prioritised replay works with SB3's plain buffer. With ``n_steps`` above 1, Dict observations,
    ``optimize_memory_usage`` or another replay buffer (``HerReplayBuffer``), transitions are drawn
    uniformly, and weights in the loss give it the same expected gradient (Fujimoto, Meger and
    Precup, NeurIPS 2020).
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": TD7Policy,
        "MultiInputPolicy": TD7Policy,
    }
    policy_family = TD7Policy
    #: twice the number of random steps
    default_timesteps: ClassVar[int] = 50_000
    policy: TD7Policy
    use_checkpoints: bool | None
    exploration_noise: float
    target_update_interval: int

    config_class = TD7Config

    @takes(TD7Config)
    def __init__(self, config: TD7Config) -> None:
        self.construct(config)

    def construct(self, config: TD7Config, **more: Any) -> None:  # type: ignore[override]
        self.assessed_episodes, self.assessed_steps = 0, 0
        self.worst_return, self.best_worst_return = np.inf, -np.inf
        self._finished: list[tuple[float, int]] = []
        self._begin_episode()
        self._chosen_freq = config.train_freq
        self._derived_noise: ActionNoise | None = None
        super().construct(config, **more)

    def make_update_config(self) -> UpdateConfig:
        """:return: static configuration of the update"""
        config = self.config
        return UpdateConfig(
            **self.policy.parts,
            target_update_interval=config.target_update_interval,
            policy_delay=config.policy_delay,
            target_noise=config.target_policy_noise,
            noise_clip=config.target_noise_clip,
            alpha=config.priority_exponent,
            uniform=not self.prioritised,
        )

    @property
    def assesses(self) -> bool:
        """Whether policies are assessed before they are updated."""
        return self.n_envs == 1 if self.use_checkpoints is None else self.use_checkpoints

    @property
    def prioritised(self) -> bool:
        """Whether transitions are drawn in proportion to priorities."""
        return isinstance(self.replay_buffer_class, type) and issubclass(
            self.replay_buffer_class, LapReplayBuffer
        )

    def check_environment(self, config: Any) -> None:
        super().check_environment(config)
        several = self.n_envs > 1 and config.use_checkpoints
        config.require(not several, "use_checkpoints", "False with several environments")
        self.warn_of_unused(config, "tau", why="target networks are copied")
        if self.assesses:
            why = "with checkpoints, there are as many updates as steps (use_checkpoints=False)"
            self.warn_of_unused(config, "gradient_steps", why=why)

    def _default_buffer(self) -> type[ReplayBuffer] | None:
        is_dict = isinstance(self.observation_space, spaces.Dict)
        plain = self.n_steps == 1 and not self.optimize_memory_usage and not is_dict
        return LapReplayBuffer if plain else None

    def _setup_model(self) -> None:
        self._choose_train_freq()
        super()._setup_model()
        if self.action_noise is None and self.exploration_noise:
            # SB3 adds noise to actions in the shape of the space.
            size = np.full(self.action_space.shape or (), self.exploration_noise, np.float32)
            self.action_noise = NormalActionNoise(np.zeros_like(size), size)
            self._derived_noise = self.action_noise

    def _choose_train_freq(self) -> None:
        """A ``train_freq`` passed to ``load`` counts; a saved one only if a user had passed it."""
        given: Any = self.train_freq
        if given is not None and not isinstance(given, TrainFreq):
            self._chosen_freq = given
        elif self._chosen_freq is None or given is None:
            self.train_freq = (1, "episode") if self.assesses else 1  # type: ignore[assignment]

    def _excluded_save_params(self) -> list[str]:
        """Noise that was derived from ``exploration_noise`` is derived again after loading."""
        excluded = [*super()._excluded_save_params(), "_derived_noise"]
        # With several environments, SB3 wraps a noise for each of them.
        noise = getattr(self.action_noise, "base_noise", self.action_noise)
        return excluded if noise is not self._derived_noise else [*excluded, "action_noise"]

    def check_replay_buffer(self, buffer: Any, path: Any) -> None:
        super().check_replay_buffer(buffer, path)
        if self.prioritised and not isinstance(buffer, LapReplayBuffer):
            raise ValueError(
                f"'{path}' holds a {type(buffer).__name__}, which has no priorities to draw by. "
                "Load it into TD7(..., replay_buffer_class=ReplayBuffer), which draws uniformly."
            )

    def _build(self, seed: int) -> None:
        self.policy.build(self.make_update_config(), seed, jax_device(self._device_name))

    @property
    def kept_by_resets(self) -> tuple[str, ...]:
        """With the checkpoint, which acts until an assessment is at least as good."""
        return ("n_updates", "checkpoint") if self.policy.has_checkpoint else ("n_updates",)

    def train(self, gradient_steps: int, batch_size: int) -> None:
        """
        Make updates. With checkpoints, there are none during an assessment, then one for each step
        of the assessed policy.

        :param gradient_steps: number of updates without checkpoints
        :param batch_size: transitions per update
        :raises DivergedError: if an update diverged; the model keeps its last finite state
        """
        if self.assesses:
            gradient_steps = self._assess()
        elif gradient_steps > 0:
            self._forget_assessments()
        if gradient_steps > 0:
            super().train(gradient_steps, batch_size)

    def _forget_assessments(self) -> None:
        """Drop checkpoint and assessments before updates without assessment."""
        if self.policy.has_checkpoint:
            self.policy.drop_checkpoint()
        self._finished, self.best_worst_return = [], -np.inf
        self._begin_assessment()

    def _begin_assessment(self) -> None:
        self.assessed_episodes, self.assessed_steps, self.worst_return = 0, 0, np.inf

    def _assess(self) -> int:
        """
        Assess the policy by its episodes since the last update.

        :return: how many updates are due: none while the assessment is not complete
        """
        for reward, length in self._finished:
            self.assessed_episodes += 1
            self.assessed_steps += length
            self.worst_return = min(self.worst_return, reward)
        self._finished = []
        config = self.config
        late = self._n_updates > config.updates_before_checkpointing
        enough = config.max_episodes_per_checkpoint if late else 1
        good = self.worst_return >= self.best_worst_return
        if good and self.assessed_episodes < enough:
            return 0
        if good:
            self.best_worst_return = self.worst_return
            self.policy.keep_checkpoint()
        due = self.assessed_steps
        if not late and self._n_updates + due > config.updates_before_checkpointing:
            self.best_worst_return *= config.reset_weight
        self._begin_assessment()
        return due

    def _updates(self, n: int, batch_size: int) -> dict[str, float]:
        """One by one, since the errors of an update change the priorities for the next."""
        buffer: Any = self.replay_buffer
        rates, policy = self.learning_rates(), self.policy
        report, metrics = {}, zero_metrics(UpdateMetrics)
        for _ in range(n):
            batch, drawn = self._sample_batch(batch_size)
            state, metrics, priorities = update(
                policy.update_config, policy.agent_state, batch, *rates, metrics
            )
            metrics = jax.device_get(metrics)  # NumPy, as before the first update: compiles once
            report = {name: float(value) for name, value in metrics._asdict().items()}
            self._accept(state, report)
            if drawn is None:
                continue
            buffer.set_priorities(*drawn, np.asarray(priorities))
            if int(state.n_updates) % self.target_update_interval == 0:
                buffer.forget_highest()
        return report

    def _sample_batch(self, batch_size: int) -> tuple[Batch, tuple[np.ndarray, np.ndarray] | None]:
        """:return: a batch, and with priorities the indices of its transitions"""
        if not self.prioritised:
            return Batch(
                *(rows[0] for rows in batches_of(self.replay_source, 1, batch_size, 1))
            ), None
        buffer: Any = self.replay_buffer
        drawn = buffer.draw(batch_size)
        return Batch(**transitions(self.replay_source, *drawn)), drawn  # type: ignore[arg-type]

    def after_step(
        self, new_obs: np.ndarray | dict[str, np.ndarray], reward: np.ndarray, dones: np.ndarray
    ) -> None:
        if not self.assesses:
            return
        normalizer = self.get_vec_normalize_env()
        # Assessments far apart are compared, and the scale of normalised rewards drifts.
        earned = reward if normalizer is None else normalizer.get_original_reward()
        self._episode_return += float(earned[0])
        self._episode_length += 1
        if dones[0]:
            # Episodes with random actions do not assess the policy.
            if self.num_timesteps - self._episode_length >= self.learning_starts:
                self._finished.append((self._episode_return, self._episode_length))
            self._begin_episode()

    def _end_episode(self) -> None:
        super()._end_episode()
        self._begin_episode()

    def _begin_episode(self) -> None:
        self._episode_return, self._episode_length = 0.0, 0
