"""What model-free algorithms share: SB3 collects steps and calls ``train``."""

import dataclasses
import itertools
import math
import warnings
from abc import abstractmethod
from dataclasses import KW_ONLY
from typing import Any, ClassVar, NoReturn

import jax
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.buffers import NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.type_aliases import (
    MaybeCallback,
    Schedule,
    TrainFreq,
    TrainFrequencyUnit,
)
from stable_baselines3.her import HerReplayBuffer

from sb3_hds.algos.base.algorithm import OffPolicyTensorAlgorithm
from sb3_hds.algos.base.config import Config, OffPolicyConfig, Rate, between, is_count, schedule_of
from sb3_hds.algos.base.policy import LearningPolicy
from sb3_hds.algos.model_free.replay import ReplaySource
from sb3_hds.algos.nets.observations import check_actions, check_observations
from sb3_hds.algos.nets.optimizers import TrainState, finite_leaves
from sb3_hds.errors import DivergedError, EnvironmentMismatchError

# Logged by updates of the actor, which not every call of ``train`` makes.
_OF_ACTOR = ("actor_loss", "ent_coef", "ent_coef_loss")
_USUAL_BATCH = 256
# Largest number of the precision in which networks compute.
_LARGEST = float(np.finfo(np.float32).max)


@dataclasses.dataclass(frozen=True, eq=False)
class ModelFreeConfig(OffPolicyConfig):
    """
    Arguments of every model-free algorithm.

    :param policy: ``"MlpPolicy"``, ``"MultiInputPolicy"`` for Dict observations, ``"SimbaPolicy"``
        (not CrossQ, TD7 and BRO), a policy class, or the environment itself
    :param learning_rate: of the actor, the entropy coefficient and the critics; number, schedule or
        ``"lin_3e-4"``
    :param qf_learning_rate: of the critics; None: ``learning_rate``
    :param learning_starts: steps with random actions before learning starts; the files in
        ``hyperparams/`` have the papers' values for the papers' tasks (DroQ, CrossQ and SimBa
        5,000, BRO 2,500)
    :param batch_size: transitions per update
    :param tau: weight of the online critics in the Polyak average of the target critics
    :param gradient_steps: updates per call of ``train``; -1: one per environment step since the
        last call
    :param policy_delay: updates of the critics per update of the actor
    :param replay_buffer_class: as in SB3
    :param replay_buffer_kwargs: as in SB3
    :param optimize_memory_usage: as in SB3; needs
        ``replay_buffer_kwargs={"handle_timeout_termination": False}``
    :param n_steps: of n-step returns; above 1 neither with Dict observations nor with
        ``optimize_memory_usage``
    :param use_sde: explore by gSDE instead of independent noise at each step; not with TD7, which
        adds noise to its actions
    :param sde_sample_freq: steps between two draws of the noise matrix, across collections
        (``train_freq``), whereas SB3 draws in each; -1: at the start of each collection. If
        collections are episodes, each starts with a new matrix.
    :param use_sde_at_warmup: whether gSDE also acts before ``learning_starts``
    :param policy_kwargs: see :class:`~sb3_hds.algos.GaussianPolicy`
    :param param_resets: steps of the environment at which networks and their optimisers are reset;
        the entropy coefficient (except with BRO) and TD7's checkpoint are kept
    """

    _: KW_ONLY
    qf_learning_rate: Rate | None = None
    tau: float = 0.005
    policy_delay: int = 1
    replay_buffer_class: type[ReplayBuffer] | None = None
    replay_buffer_kwargs: dict[str, Any] | None = None
    optimize_memory_usage: bool = False
    n_steps: int = 1
    use_sde: bool = False
    sde_sample_freq: int = -1
    use_sde_at_warmup: bool = False
    param_resets: list[int] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        self._require_mapping("replay_buffer_kwargs")
        self.require_counts({"policy_delay": 1, "n_steps": 1, "sde_sample_freq": -1})
        self.require_range(0.0, 1.0, "from 0 to 1", "tau", "gamma")
        if self.qf_learning_rate is not None:
            self.require_rate("qf_learning_rate")
        self.require(
            self.param_resets is None or _are_rising_steps(self.param_resets),
            "param_resets",
            "None or a rising list of steps, such as [15_000, 50_000]",
        )
        made_with = (self.policy_kwargs or {}).get("use_sde", self.use_sde)
        allowed = f"{made_with}, as when the networks were made"
        self.require(self.use_sde == made_with, "use_sde", allowed)
        given: Any = self.replay_buffer_class
        fine = given is None or (isinstance(given, type) and issubclass(given, ReplayBuffer))
        self.require(fine, "replay_buffer_class", "None or a class of replay buffers")
        if given is None and self.n_steps > 1:
            shares = self.optimize_memory_usage
            self.require(not shares, "optimize_memory_usage", "False where n_steps > 1")
        ends = (self.replay_buffer_kwargs or {}).get("handle_timeout_termination", True)
        self.require(
            not (self.optimize_memory_usage and ends),
            "optimize_memory_usage",
            "False, unless time limits may count as ends: "
            "replay_buffer_kwargs={'handle_timeout_termination': False}",
        )


class ModelFreeAlgorithm(OffPolicyTensorAlgorithm):
    """
    Abstract: off-policy learning from transitions.

    SB3's ``learn`` alternates between ``collect_rollouts``, which fills the replay buffer, and
    :meth:`train`, which calls :meth:`_updates`: it draws batches (``batches_of``) and hands them to
    the compiled update of the family (``sac/update.py``, ``td7/update.py``).
    """

    #: steps of ``learn()`` without a number
    default_timesteps: ClassVar[int] = 20_000
    policy: LearningPolicy
    #: fields of the policy's state that ``param_resets`` leaves unchanged
    kept_by_resets: Any
    qf_learning_rate: Any
    policy_delay: int
    #: class of the replay buffer that was derived from arguments, if none was passed
    _derived_buffer: type[ReplayBuffer] | None = None
    #: the state before the last update
    _before: Any = None
    #: the ``param_resets`` that ``reset_idx`` counts
    _counted_resets: list[int] | None = None

    def construct(self, config: ModelFreeConfig, **more: Any) -> None:  # type: ignore[override]
        kind = config.replay_buffer_class
        if config.n_steps > 1 and kind is not None:
            warnings.warn(
                f"n_steps={config.n_steps} is ignored with replay_buffer_class={kind.__name__}: "
                "use SB3's NStepReplayBuffer with replay_buffer_kwargs="
                f"{{'n_steps': {config.n_steps}, 'gamma': {config.gamma}}}."
            )
        buffer_kwargs = config.replay_buffer_kwargs or {}
        more = {"qf_learning_rate": None, "replay_buffer_kwargs": dict(buffer_kwargs), **more}
        super().construct(config, **more)
        self.qf_learning_rate = config.qf_learning_rate

    check_observations = staticmethod(check_observations)

    def set_random_seed(self, seed: int | None = None) -> None:
        """SB3's, which also resets the random keys of updates and policies; None: no change."""
        super().set_random_seed(seed)
        if seed is not None and hasattr(self, "policy"):
            self.policy.set_random_seed(seed)

    @abstractmethod
    def _build(self, seed: int) -> None:
        """Initialise the networks."""

    def _reset_networks(self, seed: int) -> None:
        """Initialise the networks anew; the fields in ``kept_by_resets`` stay."""
        before = self.policy.agent_state
        kept = {name: getattr(before, name) for name in self.kept_by_resets}
        self._build(seed)
        self.policy.agent_state = self.policy.agent_state._replace(**kept)

    @abstractmethod
    def _updates(self, n: int, batch_size: int) -> dict[str, float]:
        """
        :param n: updates of the critics
        :return: metrics of the last update by name, those of the actor of its own last update
        """

    def train(self, gradient_steps: int, batch_size: int) -> None:
        """
        Make updates on batches from the replay buffer.

        :param gradient_steps: number of updates
        :param batch_size: transitions per update
        :raises DivergedError: if an update diverged; the model keeps its last finite state
        :raises ValueError: if the replay buffer is empty
        """
        resets = self.param_resets or []
        if self.reset_idx < len(resets) and self.num_timesteps >= resets[self.reset_idx]:
            self.reset_idx += 1
            self._reset_networks(self.network_seed)
        rate, qf_rate = self.learning_rates()
        if gradient_steps > 0 and self.replay_buffer.size() == 0:  # type: ignore[union-attr]
            raise ValueError(
                f"{type(self).__name__} has nothing to learn from: its replay buffer is empty. "
                "Call learn(), or load_replay_buffer(path) first."
            )
        before = int(self.policy.agent_state.n_updates)
        try:
            report = self._updates(gradient_steps, batch_size)
        finally:
            # Also after an interrupt, when some of the updates were made.
            now = int(self.policy.agent_state.n_updates)
            self._n_updates += now - before
        improved = now // self.policy_delay > before // self.policy_delay
        silent = () if improved else _OF_ACTOR
        self.logger.record("train/learning_rate", rate)
        if self.qf_learning_rate is not None:
            self.logger.record("train/qf_learning_rate", qf_rate)
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        for name, value in report.items():
            if name not in silent:
                self.logger.record(f"train/{name}", value)

    def _accept(self, state: Any, report: dict[str, float]) -> None:
        """
        Accept the state after an update.

        :param report: losses of the update, finite if the networks before it were
        :raises DivergedError: if it diverged; the model keeps its last finite state
        """
        if not all(map(math.isfinite, report.values())):
            self._raise_diverged(f"an update diverged ({report})")
        self._before, self.policy.agent_state = self.policy.agent_state, state

    def remedies(self, updates_per_step: float) -> list[str]:
        (pi, qf), narrow, freq = self.policy.widths, self.policy.narrow, self.train_freq
        found = []
        if max(qf) > narrow:
            arch = {"pi": list(pi), "qf": [narrow for _ in qf]}
            found.append(f"policy_kwargs={{'net_arch': {arch}}}, with critics of {list(qf)} now")
        if updates_per_step > 1.0:
            found.append(f"fewer gradient_steps, {updates_per_step:.3g} for each step now")
        elif isinstance(freq, TrainFreq) and freq.unit is TrainFrequencyUnit.STEP:
            more = 4 * freq.frequency
            found.append(f"train_freq={more} with gradient_steps={max(1, self.gradient_steps)}")
        if self.batch_size > _USUAL_BATCH:
            found.append(f"batch_size={_USUAL_BATCH}, {self.batch_size} now")
        return [*found, "a GPU"]

    def check_weights(self) -> None:
        if not finite_leaves(_train_states(self.policy.agent_state)):
            self._raise_diverged("an update made weights that are not finite")

    def _raise_diverged(self, what: str) -> NoReturn:
        if self._before is not None and not finite_leaves(_train_states(self.policy.agent_state)):
            self.policy.agent_state = self._before
            self.policy.discard_noise()
        raise DivergedError(
            f"{type(self).__name__}: {what}. The model keeps its last good state; lower "
            "learning_rate, or scale rewards."
        )

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        actions = super()._sample_action(learning_starts, action_noise, n_envs)
        if not np.isfinite(actions[1]).all():
            self._raise_diverged("its actions are not finite")
        return actions

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "run",
        progress_bar: bool = False,
    ) -> tuple[int, BaseCallback]:
        if reset_num_timesteps or self._last_obs is None:
            self._end_episode()
        resets = list(self.param_resets or [])
        if resets != self._counted_resets:
            # `load` changed them.
            self._counted_resets = resets
            self.reset_idx = sum(at <= self.num_timesteps for at in resets)
        return super()._setup_learn(
            total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar
        )

    def _end_episode(self) -> None:
        """Mark the last stored step as truncated: the environment is reset."""
        buffer: Any = self.replay_buffer
        if buffer is None or not (buffer.full or buffer.pos):
            return
        if isinstance(buffer, HerReplayBuffer):
            with warnings.catch_warnings(action="ignore"):
                buffer.truncate_last_trajectory()
            return
        goes_on = buffer.dones[buffer.pos - 1] == 0.0
        buffer.dones[buffer.pos - 1, goes_on] = 1.0
        if buffer.handle_timeout_termination:
            buffer.timeouts[buffer.pos - 1, goes_on] = 1.0

    @property
    def replay_source(self) -> ReplaySource:
        """The replay buffer, and how batches are made of its transitions."""
        normalizer = self.get_vec_normalize_env()
        return ReplaySource(self.replay_buffer, normalizer, self.policy.flatten, self.gamma)

    def learning_rates(self) -> tuple[float, float]:
        """:return: current learning rates of the actor and of the critics"""
        rate = self._rate("learning_rate", self.lr_schedule)
        if self.qf_learning_rate is None:
            return rate, rate
        return rate, self._rate("qf_learning_rate", schedule_of(self.qf_learning_rate))

    def _rate(self, name: str, schedule: Schedule) -> float:
        """:raises ValueError: unless it is a finite number of at least 0"""
        # The last collection may exceed ``total_timesteps``.
        remaining = max(0.0, self._current_progress_remaining)
        rate = float(schedule(remaining))
        if not between(rate, 0.0, _LARGEST):
            raise ValueError(
                f"{type(self).__name__}({name}={getattr(self, name)!r}): {name} must be a finite "
                f"number of at least 0 all the time; where {remaining:.3g} of the training "
                f"remains, the schedule says {rate}."
            )
        return rate

    def check_environment(self, config: Any) -> None:
        check_actions(self.action_space)  # type: ignore[arg-type]  # SB3 has refused all but Box
        derived = config.replay_buffer_class is None
        if derived and config.n_steps > 1 and isinstance(self.observation_space, spaces.Dict):
            raise EnvironmentMismatchError(
                "n_steps > 1 needs SB3's NStepReplayBuffer, which has no Dict observation spaces: "
                "use n_steps=1, or gymnasium.wrappers.FlattenObservation."
            )

    def warn_of_unused(self, config: Config, *names: str, why: str) -> None:
        """Warn of arguments that have no effect, and say why."""
        unused = [name for name in names if not config.is_default(name)]
        if unused:
            warnings.warn(f"{type(self).__name__} ignores {', '.join(unused)}: {why}.")

    def _setup_model(self) -> None:
        # SBX would replace None by the first value of ``learning_rate``.
        given, self._before = self.qf_learning_rate, None
        derived = self.replay_buffer_class in (None, self._derived_buffer)
        if derived:
            self._choose_buffer()
        super()._setup_model()
        self.qf_learning_rate = given
        self._derived_buffer = self.replay_buffer_class if derived else None
        self.policy = self.policy_class(  # type: ignore[assignment]
            self.observation_space, self.action_space, self.lr_schedule, **self.policy_kwargs
        )
        self._build(self.network_seed)
        # SB3 draws gSDE's noise and reads its standard deviation from the actor.
        self.actor: Any = self.policy.actor
        self.critic: Any = self.policy.critic

    def _choose_buffer(self) -> None:
        """Choose the class, also after loading: arguments of ``load`` may have changed it."""
        if self._derived_buffer is NStepReplayBuffer:
            held = self.replay_buffer_kwargs.items()
            own = {name: value for name, value in held if name not in ("n_steps", "gamma")}
            self.replay_buffer_kwargs = own
        self.replay_buffer_class = self._default_buffer()

    def _default_buffer(self) -> type[ReplayBuffer] | None:
        """:return: the class that is used if none is passed; None: SB3's default"""
        return None

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "actor", "critic", "_before"]


def _are_rising_steps(given: Any) -> bool:
    if not isinstance(given, list | tuple) or not all(is_count(step, 1) for step in given):
        return False
    return all(before < after for before, after in itertools.pairwise(given))


def _train_states(state: Any) -> list[Any]:
    """:return: the networks of the state with their optimisers"""
    parts = jax.tree.leaves(state, is_leaf=lambda part: isinstance(part, TrainState))
    return [part for part in parts if isinstance(part, TrainState)]
