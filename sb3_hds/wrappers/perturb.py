"""Disturbances: sensor noise, sensor failure, pushes."""

from typing import Any

import gymnasium
import numpy as np
from gymnasium.utils import RecordConstructorArgs

from sb3_hds.errors import EnvironmentMismatchError, ParameterError
from sb3_hds.wrappers.observations import is_vector

_FAILURES = (None, "zero", "constant")
# Of MuJoCo's bodies, 0 is the world and 1 the torso.
_TORSO = 1


class Perturb(gymnasium.Wrapper, RecordConstructorArgs):
    """
    Adds sensor noise, a failed sensor and random pushes. Noise and failures affect observations
    only, not rewards or the state; random numbers come from the generator of the environment.

    :param env: its observations are a Box with one axis
    :param noise: standard deviation of the white noise on each entry, in the unit of the entry
    :param failing: reading of a failed sensor: ``"zero"`` or ``"constant"``; None: none fails
    :param sensor: index of the failed entry; None: a random one in each episode
    :param constant: reading of a sensor that fails with ``"constant"``
    :param push: force on the torso [N], in a random direction
    :param push_probability: probability of a push per step
    :raises ParameterError: for arguments out of range
    :raises EnvironmentMismatchError: for other observations, or a push without MuJoCo
    """

    def __init__(
        self,
        env: gymnasium.Env,
        *,
        noise: float = 0.0,
        failing: str | None = None,
        sensor: int | None = None,
        constant: float = 5.0,
        push: float = 0.0,
        push_probability: float = 0.05,
    ) -> None:
        RecordConstructorArgs.__init__(
            self,
            noise=noise,
            failing=failing,
            sensor=sensor,
            constant=constant,
            push=push,
            push_probability=push_probability,
        )
        gymnasium.Wrapper.__init__(self, env)
        space = env.observation_space
        if not is_vector(space):
            raise EnvironmentMismatchError(f"Perturb takes a Box with one axis, got {space}.")
        in_range = 0.0 <= noise < np.inf and 0.0 <= push_probability <= 1.0
        if failing not in _FAILURES or not in_range or not np.isfinite([constant, push]).all():
            raise ParameterError(
                f"Perturb(noise={noise}, failing={failing!r}, constant={constant}, push={push}, "
                f"push_probability={push_probability}): noise must be at least 0, failing None, "
                "'zero' or 'constant', the probability from 0 to 1, and every number finite."
            )
        if sensor is not None and not 0 <= sensor < space.shape[0]:
            raise ParameterError(
                f"There is no sensor {sensor}: observations have {space.shape[0]} entries."
            )
        if push and not hasattr(getattr(env.unwrapped, "data", None), "xfrc_applied"):
            raise EnvironmentMismatchError(f"A push needs an environment of MuJoCo, got {env}.")
        self.noise, self.failing, self.sensor, self.constant = noise, failing, sensor, constant
        self.push, self.push_probability = push, push_probability
        self._failed = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        obs, info = self.env.reset(seed=seed, options=options)
        self._failed = self.sensor
        if self.sensor is None and self.failing:
            self._failed = int(self.np_random.integers(len(obs)))
        return self._sensed(obs), info

    def step(self, action: Any) -> tuple[np.ndarray, Any, bool, bool, dict[str, Any]]:
        if self.push:
            self._push()
        obs, reward, terminated, truncated, info = self.env.step(action)
        return self._sensed(obs), reward, terminated, truncated, info

    def _push(self) -> None:
        inner: Any = self.env.unwrapped
        force = np.zeros(3)
        if self.np_random.random() < self.push_probability:
            direction = self.np_random.normal(size=3)
            force = self.push * direction / np.linalg.norm(direction)
        inner.data.xfrc_applied[_TORSO, :3] = force

    def _sensed(self, obs: np.ndarray) -> np.ndarray:
        sensed = np.array(obs)
        if self.noise:
            sensed = sensed + self.noise * self.np_random.normal(size=sensed.shape)
        if self.failing:
            sensed[self._failed] = 0.0 if self.failing == "zero" else self.constant
        box: Any = self.observation_space
        # A sensor saturates at the ends of its range, and a policy was trained within it.
        return np.clip(sensed, box.low, box.high).astype(obs.dtype)
