"""Open loop: oscillators move the joints, and CMA-ES optimises their constants."""

import dataclasses
import secrets
import sys
import time
from collections.abc import Sequence
from functools import partial
from typing import Any, ClassVar, Self

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback
from stable_baselines3.common.utils import safe_mean
from stable_baselines3.common.vec_env import VecEnv

from sb3_hds.algos.base.checks import (
    check_log_interval,
    check_origin,
    checked_timesteps,
    jax_device,
)
from sb3_hds.algos.base.config import takes
from sb3_hds.algos.base.policy import TensorPolicy
from sb3_hds.algos.base.root import TensorAlgorithm
from sb3_hds.algos.open_loop import cma_es
from sb3_hds.algos.open_loop.config import OpenLoopConfig
from sb3_hds.algos.open_loop.gait import Constants, GaitSpace
from sb3_hds.algos.open_loop.policy import OscillatorPolicy
from sb3_hds.algos.open_loop.robot import (
    Robot,
    refuse_without_state,
    robot_of,
    state_vectors,
)
from sb3_hds.algos.open_loop.rollouts import Trial, Trials
from sb3_hds.errors import EnvironmentMismatchError, ParameterError


class OpenLoop(TensorAlgorithm):
    r"""
    One oscillator per joint, :math:`q_i^*(t) = a_i \sin(\theta_i(t) + \varphi_i) + b_i`, with one
    frequency for swing and one for stance, and a tracking loop, :math:`u = k_p (q^* - q) -
    k_d\,\dot q`. The rest of the observation is not used.

    Source: Raffin et al., *An Open-Loop Baseline for Reinforcement Learning Locomotion Tasks*, RLJ
    2024. It uses CMA-ES, too; its ranges and its treatment of random resets are not published.
    Here:

    - all candidates of a generation start from the same resets, and are compared by their mean
      returns
    - episodes are truncated after ``horizon`` steps, so that there are more of them
    - the last ``ranking_share`` of the steps compares the best candidates and the mean of the
      distribution on full episodes from new resets; the worse half drops out in each round

    **Joints.** In MuJoCo environments, every actuator tracks the joint that it drives
    (``actuator_trnid``). Position and velocity are read from the observation if it contains all of
    them (HalfCheetah, Ant, Hopper, Walker2d, Swimmer, Humanoid, ...), so that a model predicts in
    any copy of the environment, such as that of ``rl_zoo3 enjoy``. Otherwise (Reacher, Pusher),
    they are read from the environment: then ``predict`` works only for the environment of the model
    or of ``read_joints_from``, unless the wrapper ``ShowJoints`` adds the joints to the
    observation. Without joints (Pendulum-v1), the oscillators are the commands. Observations that
    ``VecNormalize`` scales do not contain joint positions, and are refused.

    **The phase** is the recurrent state of ``predict``: pass on the returned state, as
    ``evaluate_policy``, ``EvalCallback`` and ``rl_zoo3 enjoy`` do. Without it, every call is the
    first one of an episode.

    The environment must allow resets during episodes (``Monitor(allow_early_resets=True)``, the
    default). A ``VecEnv`` that cannot reset a single copy runs full episodes from its own resets.
    """

    default_timesteps: ClassVar[int] = 200_000
    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": OscillatorPolicy,
        "MultiInputPolicy": OscillatorPolicy,
    }
    #: base class that every policy of the algorithm extends
    policy_family: ClassVar[type[TensorPolicy]] = OscillatorPolicy
    policy: OscillatorPolicy

    config_class = OpenLoopConfig

    @takes(OpenLoopConfig)
    def __init__(self, config: OpenLoopConfig) -> None:
        self.construct(config)

    def construct(self, config: OpenLoopConfig, **more: Any) -> None:  # type: ignore[override]
        frequency: Any = np.atleast_1d(np.asarray(config.frequency, float)).tolist()
        gait = config.gait if isinstance(config.gait, str | None) else list(config.gait)
        config = dataclasses.replace(config, frequency=frequency, gait=gait)
        # SB3 requires a learning rate, which is not used.
        super().construct(config, learning_rate=0.0, **more)
        self.robot: dict[str, Any] | None = None

    def _setup_model(self) -> None:
        check_origin(type(self), self.saved_by)
        _ = self.config  # checks the arguments, after loading, too
        jax_device(self._device_name)
        self._setup_lr_schedule()
        self.set_random_seed(self.seed)
        if self.env is not None:
            self._inspect_env(self.env)
        assert self.robot is not None
        self.policy = self.policy_class(  # type: ignore[assignment]
            self.observation_space,
            self.action_space,
            self.lr_schedule,
            robot=self.robot,
            **self.policy_kwargs,
        )
        self._choose_joint_source()
        self._restart(np.zeros(self.gait_space.dim))
        self.policy.constants = self.gait_space.decode(self.policy.search.mean)

    @property
    def gait_space(self) -> GaitSpace:
        """The search space of gaits."""
        assert self.robot is not None
        return self.config.gait_space(Robot(**self.robot))

    @property
    def constants(self) -> dict[str, Any]:
        """The gait that acts, as arguments of :meth:`set_constants` [rad, rad/s]."""
        return {name: part.tolist() for name, part in self.policy.constants._asdict().items()}

    def set_constants(
        self,
        *,
        omega_swing: float,
        omega_stance: float,
        amplitude: Sequence[float] | float = 1.0,
        offset: Sequence[float] | float = 0.0,
        phase: Sequence[float] | float = 0.0,
        kp: Sequence[float] | float | None = None,
        kd: Sequence[float] | float | None = None,
    ) -> Self:
        """
        Set the gait that acts: a published one, or ``constants`` of another model. The next search
        starts there, and replaces it by gaits that are better on new resets.

        A single number is for all joints, whose order is that of the actuators.

        :param omega_swing: while the sine is positive [rad/s]
        :param omega_stance: while it is not [rad/s]
        :param amplitude: [rad]
        :param offset: [rad]
        :param phase: [rad]
        :param kp: default: that of the constructor
        :param kd: default: that of the constructor
        :raises ParameterError: for another number of joints than there are, and for values that
            are not finite or frequencies that are not above 0
        """
        config = self.config
        given = {
            "amplitude": amplitude,
            "offset": offset,
            "phase": phase,
            "omega_swing": omega_swing,
            "omega_stance": omega_stance,
            "kp": config.kp if kp is None else kp,
            "kd": config.kd if kd is None else kd,
        }
        assert self.robot is not None
        names = self.robot["names"]
        constants = Constants(**{name: _sized(name, v, names) for name, v in given.items()})
        self.policy.constants = constants
        self._restart(self.gait_space.encode(constants))
        self.policy.search = self.policy.search._replace(ranked=np.asarray(True))
        return self

    def read_joints_from(self, env: VecEnv | None) -> None:
        """
        Let ``predict`` read joints from an environment, as from the encoders of motors, instead of
        the observation.

        :param env: with as many copies as there will be observations; None: use the observation
        :raises EnvironmentMismatchError: if it is no MuJoCo environment
        """
        if env is not None:
            refuse_without_state(env)
        self.policy.read_states = None if env is None else partial(state_vectors, env)

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """
        SB3's ``set_env``, which also determines joints and time step again.

        :raises EnvironmentMismatchError: if it has other joints
        """
        before, robot = self.env, self.robot
        super().set_env(env, force_reset)
        if self.env is before:
            return
        assert self.env is not None
        self._inspect_env(self.env)
        assert robot is not None and self.robot is not None
        if self.robot["names"] != robot["names"]:
            raise EnvironmentMismatchError(
                f"The gait is one of the joints {', '.join(robot['names'])}; this environment has "
                f"{', '.join(self.robot['names'])}."
            )
        self.policy.robot = Robot(**self.robot)
        self._choose_joint_source()

    def learn(
        self,
        total_timesteps: int | None = None,
        callback: MaybeCallback = None,
        log_interval: int | None = 1,
        tb_log_name: str | None = None,
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> Self:
        """
        Search for better constants. A further call continues the search.

        :param total_timesteps: steps of the environment; default ``default_timesteps``
        :param callback: called at every step of the environment
        :param log_interval: generations between two log lines; None: no lines
        :param tb_log_name: name of the run for TensorBoard; default: the class's name
        :param reset_num_timesteps: False continues the count of timesteps
        :param progress_bar: whether to show a progress bar
        """
        check_log_interval(log_interval)
        total = checked_timesteps(
            self.default_timesteps if total_timesteps is None else total_timesteps
        )
        name = tb_log_name or type(self).__name__
        total_timesteps, callback = self._setup_learn(
            total, callback, reset_num_timesteps, name, progress_bar
        )
        callback.on_training_start(locals(), globals())
        search_until = total_timesteps - self.config.ranking_share * total
        trials = Trials(self, self.policy, callback, total_timesteps)
        going, latest = True, 0
        # The next generation must not use the steps of the ranking.
        while going and self.num_timesteps + max(latest, 1) <= search_until:
            before = self.num_timesteps
            going = self._generation(trials, callback, log_interval)
            latest = self.num_timesteps - before
        if going and self.num_timesteps < total_timesteps:
            self._rank(trials, log_interval)
        callback.on_training_end()
        return self

    def _generation(self, trials: Trials, callback: BaseCallback, log_interval: int | None) -> bool:
        """:return: whether all candidates of the generation were evaluated"""
        search, space = self.policy.search, self.gait_space
        gaits = _stacked([space.decode(point) for point in cma_es.candidates(search)])
        seeds = cma_es.reset_seeds(search)
        due = np.argwhere(~np.isfinite(search.returns))

        def keep(trial: Trial, value: float) -> None:
            known = self.policy.search.returns.copy()
            known[trial.place] = value
            self.policy.search = self.policy.search._replace(returns=known)

        callback.on_rollout_start()
        wanted = [Trial(int(row), int(seeds[reset]), (row, reset)) for row, reset in due]
        done = trials.run(gaits, wanted, keep, self.config.horizon)
        callback.on_rollout_end()
        if not done:
            return False
        returns = self.policy.search.returns.mean(axis=1)
        self.policy.search = search = cma_es.tell(self.policy.search)
        if not search.ranked:
            self.policy.constants = space.decode(search.elites[0])
        self._log(returns, log_interval)
        return True

    def _rank(self, trials: Trials, log_interval: int | None) -> None:
        """Compare the finalists in rounds of full episodes, each from the same new reset."""
        space, search = self.gait_space, self.policy.search
        found = np.isfinite(search.elite_returns)
        points = [search.mean, *search.elites[found]]
        finalists = [self.policy.constants, *(space.decode(point) for point in points)]
        scores: list[list[float]] = [[] for _ in finalists]
        left = list(range(len(finalists)))
        while True:
            values: dict[int, float] = {}

            def keep(trial: Trial, value: float, values: dict[int, float] = values) -> None:
                values[trial.row] = value

            seed = cma_es.round_seed(self.policy.search)
            n_rounds = np.asarray(self.policy.search.n_rounds + 1)
            self.policy.search = self.policy.search._replace(n_rounds=n_rounds)
            done = trials.run(_stacked(finalists), [Trial(i, seed, ()) for i in left], keep, None)
            if not done:
                return
            for i, value in values.items():
                scores[i].append(value)
            left.sort(key=lambda i: -float(np.mean(scores[i])))
            self.policy.constants = finalists[left[0]]
            self.policy.search = self.policy.search._replace(ranked=np.asarray(True))
            self.logger.record("search/best_whole_episodes", float(np.mean(scores[left[0]])))
            if log_interval is not None:
                self.dump_logs()
            if len(scores[left[0]]) > 1 and len(left) > 2:
                left = left[: max(2, len(left) // 2)]

    def _log(self, returns: np.ndarray, log_interval: int | None) -> None:
        search = self.policy.search
        record = self.logger.record
        record("search/mean_return", float(returns.mean()))
        record("search/best_return", float(returns.max()))
        record("search/best_return_so_far", float(search.elite_returns[0]))
        record("search/sigma", float(search.sigma))
        if log_interval is not None and int(search.generation) % log_interval == 0:
            self.dump_logs()

    def dump_logs(self) -> None:
        """Write a log line."""
        seconds = max((time.time_ns() - self.start_time) / 1e9, sys.float_info.epsilon)
        record = self.logger.record
        if self.ep_info_buffer:
            record("rollout/ep_rew_mean", safe_mean([e["r"] for e in self.ep_info_buffer]))
            record("rollout/ep_len_mean", safe_mean([e["l"] for e in self.ep_info_buffer]))
        if self.ep_success_buffer:
            record("rollout/success_rate", safe_mean(self.ep_success_buffer))
        made = self.num_timesteps - self._num_timesteps_at_start
        record("time/fps", int(made / seconds))
        record("time/time_elapsed", int(seconds), exclude="tensorboard")
        record("time/total_timesteps", self.num_timesteps, exclude="tensorboard")
        record("train/n_updates", self._n_updates, exclude="tensorboard")
        self.logger.dump(step=self.num_timesteps)

    @property
    def _n_updates(self) -> int:
        """Number of complete generations."""
        return int(self.policy.search.generation)

    @_n_updates.setter
    def _n_updates(self, n: int) -> None:
        """Ignore SB3's initial value: the search counts its generations."""

    def _restart(self, start: np.ndarray) -> None:
        dim, config = len(start), self.config
        self.policy.search = cma_es.init_search(
            start,
            config.initial_sigma,
            secrets.randbelow(2**31) if self.seed is None else int(self.seed),
            config.population_size or cma_es.default_population(dim),
            config.n_resets,
            config.n_elites,
        )

    def _inspect_env(self, env: VecEnv) -> None:
        """
        Determine joints and time step of an environment.

        :raises EnvironmentMismatchError: if its joints cannot be divided among the gait's legs
        """
        config = self.config
        robot = robot_of(env, config.control, config.joints, config.dt)
        normalises = getattr(self.get_vec_normalize_env(), "norm_obs", False)
        if robot.control == "track" and config.joints != "env" and normalises:
            raise ValueError(
                "OpenLoop reads joints from observations, which VecNormalize scales: use "
                "VecNormalize(norm_obs=False), or joints='env'."
            )
        n_legs = len(config.leads)
        if len(robot.names) % n_legs:
            raise EnvironmentMismatchError(
                f"A gait of {n_legs} legs needs as many joints in each, leg by leg; there are "
                f"{len(robot.names)}: {', '.join(robot.names)}."
            )
        self.robot = robot.to_dict()

    def _choose_joint_source(self) -> None:
        """Read joints from the environment if the observation does not contain them."""
        robot = self.policy.robot
        assert robot is not None
        unseen = robot.control == "track" and not robot.seen_position
        self.read_joints_from(self.env if unseen else None)


def _stacked(gaits: Sequence[Constants]) -> Constants:
    return Constants(*(np.stack(parts) for parts in zip(*gaits, strict=True)))


def _sized(name: str, value: Any, joints: Sequence[str]) -> np.ndarray:
    """:return: one number per joint; a frequency is a single number"""
    array = np.asarray(value, float)
    of_all = name.startswith("omega")
    if array.shape not in (((),) if of_all else ((), (len(joints),))):
        wanted = "one number" if of_all else f"one number, or one for each of {', '.join(joints)}"
        raise ParameterError(f"{name} must be {wanted}, got {value}.")
    if not np.isfinite(array).all() or (of_all and array <= 0.0):
        raise ParameterError(f"{name} must be finite{' and above 0' * of_all}, got {value}.")
    return array if of_all else np.broadcast_to(array, (len(joints),)).copy()
