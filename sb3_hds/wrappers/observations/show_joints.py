"""Joint states that the observation lacks."""

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs

from sb3_hds.errors import EnvironmentMismatchError
from sb3_hds.wrappers.actuated_joints import joints_of


class ShowJoints(gymnasium.ObservationWrapper, RecordConstructorArgs):
    """
    Appends position and velocity of every joint that is driven, in the order of the actuators
    [rad or m, rad/s or m/s], so that a policy can track them wherever it acts.

    :param env: of MuJoCo, with observations that are a Box with one axis
    :raises EnvironmentMismatchError: for another environment
    """

    def __init__(self, env: gymnasium.Env) -> None:
        RecordConstructorArgs.__init__(self)
        gymnasium.ObservationWrapper.__init__(self, env)
        found, space = joints_of(env), env.observation_space
        if found is None or not isinstance(space, spaces.Box) or len(space.shape) != 1:
            raise EnvironmentMismatchError(
                f"ShowJoints needs an environment of MuJoCo whose observations are a Box with one "
                f"axis, got {env} with {space}."
            )
        self._joints = found
        unlimited = np.full(2 * len(found.names), np.inf)
        low, high = np.append(space.low, -unlimited), np.append(space.high, unlimited)
        self.observation_space = spaces.Box(
            low.astype(space.dtype), high.astype(space.dtype), dtype=space.dtype.type
        )

    def observation(self, observation: Any) -> np.ndarray:
        inner: Any = self.env.unwrapped
        seen = np.concatenate([observation, *self._joints.of_state(inner.state_vector())])
        return seen.astype(self.observation_space.dtype)
