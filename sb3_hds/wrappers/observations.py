"""Wrappers that add to what the policy observes, and the spaces that they make."""

from typing import Any, TypeGuard

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike

from sb3_hds.errors import EnvironmentMismatchError, ParameterError
from sb3_hds.wrappers.actuated_joints import joints_of
from sb3_hds.wrappers.episodes import chosen_limit

_KEY = "remaining_time"


class TimeAware(gymnasium.Wrapper, gymnasium.utils.RecordConstructorArgs):
    r"""
    Adds the remaining time to the observation: :math:`1 - k / n` after ``k`` of ``n`` steps.

    A Box gets one more entry, a Dict the key ``"remaining_time"``. For tasks with a
    true time limit, where values depend on the remaining time. To make its end a termination, add
    :class:`~sb3_hds.wrappers.TruncateToTerminate`. The spaces of the wrapped
    environment are not changed.

    Source: Pardo et al., *Time Limits in Reinforcement Learning*, ICML 2018, section 3.

    :param env: its observations are a Box of floats with one axis, or a Dict
    :param max_episode_steps: ``n``; None: the environment's own limit
    :raises ParameterError: for other observations, a limit that is not a positive integer, or an
        environment without a limit
    """

    def __init__(self, env: gymnasium.Env, max_episode_steps: int | None = None) -> None:
        gymnasium.utils.RecordConstructorArgs.__init__(self, max_episode_steps=max_episode_steps)
        gymnasium.Wrapper.__init__(self, env)
        self.max_episode_steps = chosen_limit("TimeAware", env, max_episode_steps)
        self.observation_space = _with_time(env.observation_space)
        self._elapsed = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        obs, info = self.env.reset(seed=seed, options=options)
        self._elapsed = 0
        return self._seen(obs), info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        obs, reward, terminated, truncated, info = self.env.step(action)
        self._elapsed += 1
        return self._seen(obs), reward, terminated, truncated, info

    def _seen(self, obs: Any) -> Any:
        remaining = max(0.0, 1.0 - self._elapsed / self.max_episode_steps)
        if isinstance(obs, dict):
            return obs | {_KEY: np.array([remaining], np.float32)}
        return np.append(obs, remaining).astype(self.observation_space.dtype)


def _with_time(space: spaces.Space) -> spaces.Space:
    if isinstance(space, spaces.Dict) and _KEY not in space.spaces:
        return spaces.Dict({**space.spaces, _KEY: spaces.Box(0.0, 1.0, (1,), np.float32)})
    if not is_vector(space) or space.dtype.kind != "f":
        raise ParameterError(
            f"TimeAware takes observations that are a Box of floats with one axis, or a Dict "
            f"without '{_KEY}', got {space}. Flatten them first: "
            "gymnasium.wrappers.FlattenObservation."
        )
    return extended_box(space, [0.0], [1.0])


class ShowJoints(gymnasium.ObservationWrapper, gymnasium.utils.RecordConstructorArgs):
    """
    Appends position and velocity of every actuated joint, in the order of the actuators [rad or m,
    rad/s or m/s], so that a policy can track joints without access to the simulator.

    :param env: of MuJoCo, with observations that are a Box with one axis
    :raises EnvironmentMismatchError: for another environment
    """

    def __init__(self, env: gymnasium.Env) -> None:
        gymnasium.utils.RecordConstructorArgs.__init__(self)
        gymnasium.ObservationWrapper.__init__(self, env)
        found, space = joints_of(env), env.observation_space
        if found is None or not is_vector(space):
            raise EnvironmentMismatchError(
                f"ShowJoints needs an environment of MuJoCo whose observations are a Box with one "
                f"axis, got {env} with {space}."
            )
        self._joints = found
        unlimited = np.full(2 * len(found.names), np.inf)
        self.observation_space = extended_box(space, -unlimited, unlimited)

    def observation(self, observation: Any) -> np.ndarray:
        inner: Any = self.env.unwrapped
        seen = np.concatenate([observation, *self._joints.of_state(inner.state_vector())])
        return seen.astype(self.observation_space.dtype)


def is_vector(space: spaces.Space) -> TypeGuard[spaces.Box]:
    """:return: whether it is a Box with one axis"""
    return isinstance(space, spaces.Box) and len(space.shape) == 1


def extended_box(space: spaces.Box, low: ArrayLike, high: ArrayLike) -> spaces.Box:
    """:return: a box with one axis, extended by entries with these limits, in floating point"""
    dtype = np.result_type(space.dtype, np.float32) if space.dtype.kind == "f" else np.float32
    lows, highs = np.append(space.low, low), np.append(space.high, high)
    return spaces.Box(lows.astype(dtype), highs.astype(dtype), dtype=dtype)  # type: ignore[arg-type]
