"""Recordings of an environment or a robot."""

import os
from collections.abc import Callable, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from sb3_hds.data.recording import Recorder
from sb3_hds.errors import TrajectoryError
from sb3_hds.wrappers.interval import interval_of
from sb3_hds.wrappers.observations import is_vector


class Record(gymnasium.Wrapper):
    """
    Writes every reset and step to a file that ``Trajectories.load(path)`` reads.

    Each step is handed to the operating system before ``step`` returns, so a recording stays
    readable if the process is killed. Observations, actions and rewards are unchanged. Wrap the
    environment directly, inside of wrappers that scale. For a loop without an environment, use
    :class:`sb3_hds.data.Recorder`.

    :param env: its observations are a Box with one axis, its actions too, or Discrete
    :param path: ``.jsonl`` is appended if missing; an existing file is never overwritten
    :param dt: control interval [s]; default: the environment's own ``dt`` or ``tau``
    :param obs_names: of the observation channels; default: ``obs[0]``, ``obs[1]``, ...
    :param action_names: of the action channels; default: ``action[0]``, ...
    :param condition: label of the test condition, such as a load or a gain; set
        ``recorder.condition`` to change it for later episodes
    :param clock: returns the time [s], such as ``time.monotonic``, for steps of varying length
    :param append: whether to continue an existing file
    :raises TrajectoryError: for other spaces, an unknown interval, or a file that exists
    """

    def __init__(
        self,
        env: gymnasium.Env,
        path: str | os.PathLike[str],
        *,
        dt: float | None = None,
        obs_names: Sequence[str] | None = None,
        action_names: Sequence[str] | None = None,
        condition: str = "default",
        clock: Callable[[], float] | None = None,
        append: bool = False,
    ) -> None:
        super().__init__(env)
        self.recorder = Recorder(
            path,
            interval_of(env, TrajectoryError) if dt is None else dt,
            obs=_names("obs", env.observation_space, obs_names),
            actions=_names("action", env.action_space, action_names),
            condition=condition,
            clock=clock,
            append=append,
        )

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        obs, info = self.env.reset(seed=seed, options=options)
        self.recorder.start(obs)
        return obs, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """:return: as the environment; the action is recorded as it was passed, before clipping"""
        taken = np.array(action, float)  # an environment may change it in place
        obs, reward, terminated, truncated, info = self.env.step(action)
        self.recorder.step(taken, obs)
        return obs, reward, terminated, truncated, info

    def close(self) -> None:
        self.recorder.close()
        super().close()


def _names(kind: str, space: spaces.Space, names: Sequence[str] | None) -> Sequence[str]:
    single = isinstance(space, spaces.Discrete) and kind == "action"
    if not single and not is_vector(space):
        raise TrajectoryError(
            f"Record takes observations and actions that are boxes of one axis, got the {kind} "
            f"space {space}. Flatten it first: gymnasium.wrappers.FlattenObservation."
        )
    size = 1 if single else int(np.prod(space.shape or ()))
    if names is None:
        return [f"{kind}[{i}]" for i in range(size)]
    if len(names) != size:
        raise TrajectoryError(f"The {kind} space has {size} channels, got the names {list(names)}.")
    return names
