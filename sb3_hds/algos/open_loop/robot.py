"""What an open-loop policy needs to know of an environment: time step and joints."""

import dataclasses
import functools
from typing import Any

import numpy as np
from gymnasium import spaces
from jaxtyping import Float
from stable_baselines3.common.vec_env import VecEnv

from sb3_hds.errors import EnvironmentMismatchError
from sb3_hds.wrappers.actuated_joints import (
    COMMANDS_POSITIONS,
    ActuatedJoints,
    actuated_joints,
    refuse_servos,
)
from sb3_hds.wrappers.interval import interval_from

# Number of different resets in which an entry of the observation must equal a joint's state, and
# the tolerance.
_N_RESETS = 3
_EQUAL = 1e-6


@dataclasses.dataclass(frozen=True)
class Robot:
    """
    Time step and joints of an environment, as plain data that are saved with a model.

    :param dt: time step [s]
    :param control: ``"track"``: actuators track joint positions; ``"direct"``: oscillators are the
        commands
    :param names: of the actuated joints, in the order of the actuators
    :param lower: lower limit of each joint, or of each command
    :param upper: upper limits
    :param rest: positions at rest in the model, or the middle of each command's range
    :param position: index of each position in ``qpos`` followed by ``qvel``; empty without tracking
    :param velocity: index of each velocity in ``qpos`` followed by ``qvel``
    :param seen_position: index of each position in the observation; empty unless all are observed
    :param seen_velocity: index of each velocity in the observation
    """

    dt: float
    control: str
    names: tuple[str, ...]
    lower: tuple[float, ...]
    upper: tuple[float, ...]
    rest: tuple[float, ...]
    position: tuple[int, ...] = ()
    velocity: tuple[int, ...] = ()
    seen_position: tuple[int, ...] = ()
    seen_velocity: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):  # JSON has lists only
            value = getattr(self, field.name)
            if isinstance(value, list):
                object.__setattr__(self, field.name, tuple(value))

    def to_dict(self) -> dict[str, Any]:
        """:return: JSON data, the arguments of an equal robot"""
        return {
            name: list(value) if isinstance(value, tuple) else value
            for name, value in dataclasses.asdict(self).items()
        }

    def in_states(self, states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """
        :param states: ``qpos`` followed by ``qvel``, shape ``(n_envs, state)``
        :return: positions and velocities of the joints, shape ``(n_envs, act)``
        """
        return states[:, list(self.position)], states[:, list(self.velocity)]

    def in_observations(self, observations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """
        :param observations: shape ``(n_envs, obs)``
        :return: positions and velocities of the joints, shape ``(n_envs, act)``
        """
        return observations[:, list(self.seen_position)], observations[:, list(self.seen_velocity)]


def robot_of(env: VecEnv, control: str, joints: str, dt: float | None) -> Robot:
    """
    Reset the environment a few times to locate the joints in its observations.

    :param control: ``"track"``, ``"direct"``, or ``"auto"``: track if actuators drive joints
    :param joints: ``"observation"``, ``"env"``, or ``"auto"``: the observation if it has them all
    :param dt: time step [s]; None: that of the environment
    :raises EnvironmentMismatchError: if the environment does not allow this control, or does not
        show the joints there
    """
    attribute, error = functools.partial(_attribute, env), EnvironmentMismatchError
    interval = (
        interval_from(attribute, "The environment", error, from_fps=True)
        if dt is None
        else float(dt)
    )
    driven = _driven(env, control)
    if driven is None:
        low, high = _commands(env)
        return Robot(
            dt=interval,
            control="direct",
            names=tuple(f"action[{i}]" for i in range(low.size)),
            lower=tuple(low.tolist()),
            upper=tuple(high.tolist()),
            rest=tuple((0.5 * (low + high)).tolist()),
        )
    found = None if joints == "env" else _in_observation(env, driven)
    if found is None and joints == "observation":
        raise EnvironmentMismatchError(
            f"The observations do not show position and velocity of every joint that is driven "
            f"({', '.join(driven.names)}). Add them by the wrapper sb3_hds.wrappers.ShowJoints, or "
            "let them be read from the environment itself: joints='env'."
        )
    seen_position, seen_velocity = found or ((), ())
    return Robot(
        dt=interval,
        control="track",
        names=driven.names,
        position=tuple(driven.position.tolist()),
        velocity=tuple((driven.n_positions + driven.velocity).tolist()),
        seen_position=seen_position,
        seen_velocity=seen_velocity,
        lower=tuple(driven.lower.tolist()),
        upper=tuple(driven.upper.tolist()),
        rest=tuple(driven.rest.tolist()),
    )


def state_vectors(env: VecEnv) -> Float[np.ndarray, "n_envs state"]:
    """:return: ``qpos`` and ``qvel`` of each copy of a MuJoCo environment"""
    return np.stack(env.env_method("state_vector"))


def refuse_without_state(env: VecEnv) -> None:
    """:raises EnvironmentMismatchError: if the environment does not show its state"""
    if not env.has_attr("state_vector"):
        raise EnvironmentMismatchError(
            "Joints can be read from Gymnasium's MuJoCo environments, which have a method "
            "state_vector(); this environment has none. Let the oscillators be the commands: "
            "control='direct'."
        )


def _driven(env: VecEnv, control: str) -> ActuatedJoints | None:
    if control == "direct":
        return None
    model = _attribute(env, "model")
    if hasattr(model, "actuator_trnid") and model.nu == _commands(env)[0].size:
        try:
            refuse_servos(model, _attribute(env, COMMANDS_POSITIONS))
            return actuated_joints(model)
        except EnvironmentMismatchError:
            if control == "track":
                raise
            return None
    if control == "track":
        raise EnvironmentMismatchError(
            "control='track' needs an environment of MuJoCo with one action for each actuator. "
            "Let the oscillators be the commands: control='direct'."
        )
    return None


def _attribute(env: VecEnv, name: str) -> Any:
    # In another process, asking for an attribute that is not there ends it.
    return env.get_attr(name, indices=[0])[0] if env.has_attr(name) else None


def _commands(env: VecEnv) -> tuple[np.ndarray, np.ndarray]:
    box = env.action_space
    assert isinstance(box, spaces.Box)
    return box.low.astype(float).ravel(), box.high.astype(float).ravel()


def _in_observation(
    env: VecEnv, driven: ActuatedJoints
) -> tuple[tuple[int, ...], tuple[int, ...]] | None:
    """:return: indices of positions and velocities in the observation, if it has all of them"""
    space = env.observation_space
    if not isinstance(space, spaces.Box) or len(space.shape) != 1:
        return None
    pairs = [(np.asarray(env.reset()), state_vectors(env)) for _ in range(_N_RESETS)]
    observed = np.concatenate([obs for obs, _ in pairs])
    there = [
        np.concatenate(part) for part in zip(*(driven.of_state(s) for _, s in pairs), strict=True)
    ]
    columns = []
    for truth in there:
        matches = np.abs(observed[:, :, None] - truth[:, None, :]).max(axis=0) < _EQUAL
        # A joint with the same state after every reset cannot be distinguished from constants.
        if not (matches.any(axis=0) & (np.ptp(truth, axis=0) > _EQUAL)).all():
            return None
        columns.append(tuple(np.argmax(matches, axis=0).tolist()))
    return columns[0], columns[1]
