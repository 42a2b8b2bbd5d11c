"""A policy of oscillators and a loop that tracks them."""

import warnings
from collections.abc import Callable, Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from jaxtyping import Float, Int
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.common.utils import is_vectorized_observation

from sb3_hds.algos.base.policy import TensorPolicy, check_observation
from sb3_hds.algos.open_loop.cma_es import SearchState
from sb3_hds.algos.open_loop.gait import Constants
from sb3_hds.algos.open_loop.robot import Robot
from sb3_hds.core.transforms.oscillators import advance_phase
from sb3_hds.deploy.policy_function import Joints, Memory, PolicyFunction
from sb3_hds.errors import EnvironmentMismatchError
from sb3_hds.wrappers.actuated_joints import track

Targets = Float[np.ndarray, "n_envs act"]


def targets_of(gaits: Constants, steps: Int[np.ndarray, " n"], dt: float) -> Targets:
    """
    The target of action k, which acts from k dt to (k + 1) dt, is that of the middle of this
    interval.

    :param gaits: stacked, one per row
    :param steps: k of each row
    :param dt: time step [s]
    """
    omegas = (omega[:, None] for omega in (gaits.omega_swing, gaits.omega_stance))
    phase = advance_phase(gaits.phase, (steps[:, None] + 0.5) * dt, *omegas)
    return gaits.amplitude * np.sin(phase) + gaits.offset


class OscillatorPolicy(TensorPolicy):
    """
    ``"MlpPolicy"`` of :class:`~sb3_hds.algos.OpenLoop`, which has no network.

    The recurrent ``state`` of ``predict`` is the number of steps since the start of each episode.

    :param observation_space: any space; a Box with one axis if joints are read from it
    :param action_space: a bounded Box of any shape
    :param lr_schedule: passed by SB3; not used
    :param robot: time step and joints, see :class:`~sb3_hds.algos.open_loop.robot.Robot`
    """

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        lr_schedule: Schedule,
        robot: Robot | Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__(observation_space, action_space, squash_output=False)
        n = int(np.prod(action_space.shape))
        self.robot = robot if isinstance(robot, Robot) or robot is None else Robot(**robot)
        self.arguments = {
            "lr_schedule": lr_schedule,
            "robot": None if self.robot is None else self.robot.to_dict(),
        }
        zero, one = np.zeros(n), np.asarray(1.0)
        self.constants = Constants(zero, zero, zero, one, one, zero, zero)
        self.search: SearchState
        #: returns the states of all copies of the environment, if joints are not observed
        self.read_states: Callable[[], np.ndarray] | None = None
        self._lone_calls = 0

    @property
    def constants(self) -> Constants:
        """Constants of the gait that acts."""
        return self._constants

    @constants.setter
    def constants(self, constants: Constants) -> None:
        self._constants = Constants(*(np.asarray(part, float) for part in constants))

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """
        :param observation: one, or a batch with one row for each copy of the environment
        :param state: that the last call returned; None: all episodes start
        :param episode_start: which episodes start
        :return: actions, one row per observation, in units of the action space; the state for the
            next call
        :raises ValueError: if the observation has another shape than the observation space, or is
            not finite
        :raises EnvironmentMismatchError: if joints must be read from an environment and the policy
            has none
        """
        check_observation(observation)
        rows, several = self._as_rows(observation)
        n = len(next(iter(rows.values()))) if isinstance(rows, dict) else len(rows)
        if state is None:
            self._warn_of_lone_calls(episode_start)
            steps = np.zeros(n, np.int64)
        else:
            steps = np.asarray(state[0]).copy()
        if episode_start is not None:
            steps[np.broadcast_to(np.asarray(episode_start, bool), steps.shape)] = 0
        gaits = Constants(*(np.stack([part] * n) for part in self.constants))
        targets = targets_of(gaits, steps, self._dt)
        actions = self.command(targets, rows, gaits.kp, gaits.kd)
        return actions if several else actions[0], (steps + 1,)

    def command(self, targets: Targets, observations: Any, kp: Any, kd: Any) -> np.ndarray:
        """
        :param targets: one row for each copy of the environment
        :param observations: one row for each copy of the environment
        :param kp: proportional gains, one row for each copy, or one for all
        :param kd: derivative gains, one row for each copy, or one for all
        :return: actions, within their limits
        """
        robot = self.robot
        if robot is not None and robot.control == "track":
            positions, velocities = self._joints(observations, len(targets))
            targets = track(targets, positions, velocities, kp, kd)
        box = self.action_space
        assert isinstance(box, spaces.Box)
        return np.clip(targets.reshape(-1, *box.shape), box.low, box.high).astype(box.dtype)

    @property
    def _dt(self) -> float:
        return self.robot.dt if self.robot else 1.0

    def policy_function(self) -> PolicyFunction:
        """:return: the policy with the phases of its oscillators as memory, to be exported"""
        robot, gait = self.robot, self.constants
        omega, dt = (float(gait.omega_swing), float(gait.omega_stance)), self._dt
        tracks = robot is not None and robot.control == "track"
        seen = tracks and bool(robot.seen_position)  # type: ignore[union-attr]

        def act(obs: Any, joints: tuple[Any, ...], memory: tuple[Any, ...]) -> tuple[Any, Any]:
            (phase,) = memory
            targets = gait.amplitude * jnp.sin(phase) + gait.offset
            if tracks:
                position, velocity = robot.in_observations(obs) if seen else joints  # type: ignore[union-attr]
                targets = track(targets, position, velocity, gait.kp, gait.kd)
            return targets, (advance_phase(phase, dt, *omega),)

        first = Memory("phase", advance_phase(gait.phase, 0.5 * dt, *omega))
        machine = Joints(robot.position, robot.velocity) if tracks and not seen else None  # type: ignore[union-attr]
        return PolicyFunction(act, squashed=False, memory=(first,), joints=machine)

    def _joints(self, observations: Any, n: int) -> tuple[np.ndarray, np.ndarray]:
        robot = self.robot
        assert robot is not None
        if self.read_states is None:
            if robot.seen_position:
                return robot.in_observations(observations)
            raise EnvironmentMismatchError(
                "The joints are not in the observation, and this policy has no environment to read "
                "them from: model.read_joints_from(env), with the VecEnv that it acts in. Or train "
                "with the wrapper sb3_hds.wrappers.ShowJoints, which adds them to the observation."
            )
        states = self.read_states()
        if len(states) != n:
            raise EnvironmentMismatchError(
                f"Joints are read from {len(states)} copies of the environment, and there are {n} "
                "observations: model.read_joints_from(env), with the VecEnv that it acts in."
            )
        return robot.in_states(states)

    def _as_rows(self, observation: Any) -> tuple[Any, bool]:
        """:return: observations with one row for each copy, and whether they had rows already"""
        if isinstance(observation, dict):
            (key, space), *_ = self.observation_space.items()  # type: ignore[attr-defined]
            several = np.ndim(observation[key]) > len(space.shape)
            return (
                observation if several else {k: np.asarray(v)[None] for k, v in observation.items()}
            ), several
        rows = np.asarray(observation)
        several = is_vectorized_observation(rows, self.observation_space)
        return rows if several else rows[None], several

    def _warn_of_lone_calls(self, episode_start: np.ndarray | None) -> None:
        self._lone_calls += episode_start is None
        if self._lone_calls == 2:
            warnings.warn(
                "predict() was called again without the state that it returned: the oscillators "
                "start over. Pass it on: "
                "action, state = model.predict(obs, state=state, episode_start=done)."
            )

    def _predict(self, observation: Any, deterministic: bool = False) -> np.ndarray:  # type: ignore[override]
        return self.predict(observation)[0]

    @property
    def weights(self) -> Any:
        return self.constants

    @weights.setter
    def weights(self, tree: Any) -> None:
        self.constants = tree

    @property
    def training_state(self) -> Any:
        return self.search

    @training_state.setter
    def training_state(self, tree: Any) -> None:
        self.search = tree
