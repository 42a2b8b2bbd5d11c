"""How episodes end: terminations, truncations, step limits, requests of an operator."""

import threading
from collections.abc import Callable
from typing import Any, NamedTuple

import gymnasium

from sb3_hds.errors import ParameterError
from sb3_hds.wrappers.by_name import function_of

# Gymnasium writes -1 for "no limit", and vectorised simulators the largest int32.
_NONE = 2**31 - 1

Step = tuple[Any, Any, bool, bool, dict[str, Any]]


class TerminateToTruncate(gymnasium.Wrapper, gymnasium.utils.RecordConstructorArgs):
    """
    Reports terminations as truncations, so that learners bootstrap the value of the last state.

    For environments that end for a reason outside the task: an operator, leaving the workspace, a
    step limit reported as termination. Rewards are unchanged, so if an end means failure, the
    reward must show it; otherwise, the learner cannot know.

    :param env: of any kind
    """

    def __init__(self, env: gymnasium.Env) -> None:
        gymnasium.utils.RecordConstructorArgs.__init__(self)
        gymnasium.Wrapper.__init__(self, env)

    def step(self, action: Any) -> Step:
        """:return: as the environment, with ``info["was_terminated"]`` if it terminated"""
        obs, reward, terminated, truncated, info = self.env.step(action)
        if terminated:
            return obs, reward, False, True, _marked(info, "was_terminated", truncated=True)
        return obs, reward, False, truncated, info


class TruncateToTerminate(gymnasium.Wrapper, gymnasium.utils.RecordConstructorArgs):
    r"""
    Reports truncations as terminations: the value of the last state is 0.

    For a task with a genuine time limit, such as "as far as possible in ten seconds". Values then
    depend on time, so add :class:`~sb3_hds.wrappers.TimeAware` outside. Without it, the value of an
    observation is ambiguous: :math:`\sum_{k<n} \gamma^k r` with :math:`n` steps remaining.

    Source: Pardo et al., *Time Limits in Reinforcement Learning*, ICML 2018, section 3
    ("time-awareness").

    :param env: of any kind
    """

    def __init__(self, env: gymnasium.Env) -> None:
        gymnasium.utils.RecordConstructorArgs.__init__(self)
        gymnasium.Wrapper.__init__(self, env)

    def step(self, action: Any) -> Step:
        """:return: as the environment, with ``info["was_truncated"]`` if a limit ended it"""
        obs, reward, terminated, truncated, info = self.env.step(action)
        if truncated and not terminated:
            return obs, reward, True, False, _marked(info, "was_truncated", truncated=False)
        return obs, reward, terminated, False, info


class InfiniteHorizon(gymnasium.Wrapper, gymnasium.utils.RecordConstructorArgs):
    """
    An infinite-horizon task in finite episodes: after ``max_episode_steps`` an episode is
    truncated, not terminated.

    Ends before the limit, such as a fall, are unchanged. For environments that count their steps
    and report the last one as a termination, and for those without a limit: a robot that could walk
    for ever still has to be reset from time to time. A failure in the very step of the limit cannot
    be distinguished from the limit, and counts as the limit.

    Source: Pardo et al., *Time Limits in Reinforcement Learning*, ICML 2018, section 4
    ("partial-episode bootstrapping").

    :param env: of any kind
    :param max_episode_steps: None: the environment's own limit
    :raises ParameterError: unless it is a positive integer, or if the environment has no limit
    """

    def __init__(self, env: gymnasium.Env, max_episode_steps: int | None = None) -> None:
        gymnasium.utils.RecordConstructorArgs.__init__(self, max_episode_steps=max_episode_steps)
        gymnasium.Wrapper.__init__(self, env)
        # The name that Gymnasium's TimeLimit uses, so that a search for limits finds both.
        self._max_episode_steps = chosen_limit("InfiniteHorizon", env, max_episode_steps)
        self._elapsed = 0

    @property
    def max_episode_steps(self) -> int:
        """Steps after which an episode is truncated."""
        return self._max_episode_steps

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        self._elapsed = 0
        return self.env.reset(seed=seed, options=options)

    def step(self, action: Any) -> Step:
        """:return: as the environment, with ``info["was_terminated"]`` if it did at the limit"""
        obs, reward, terminated, truncated, info = self.env.step(action)
        self._elapsed += 1
        if self._elapsed < self.max_episode_steps:
            return obs, reward, terminated, truncated, info
        if terminated:
            info = _marked(info, "was_terminated", truncated=True)
        return obs, reward, False, True, info


class ManualReset(gymnasium.Wrapper, gymnasium.utils.RecordConstructorArgs):
    """
    Ends an episode on request: with a key, a foot switch, or from another thread.

    The step during which the request arrives is truncated, not terminated, because the task is not
    over. Observations, actions and rewards are unchanged.

    :param env: of any kind
    :param wanted: function that is called after every step and returns whether to end, or its name
        ``"package.module.function"``; default: only :meth:`request` ends. ``env.spec`` records a
        name, but not a function, which other processes may lack.
    :raises ParameterError: if there is no function of that name
    """

    def __init__(self, env: gymnasium.Env, wanted: Callable[[], bool] | str | None = None) -> None:
        name = wanted if isinstance(wanted, str) else None
        gymnasium.utils.RecordConstructorArgs.__init__(self, wanted=name)
        gymnasium.Wrapper.__init__(self, env)
        self._wanted = function_of(wanted) if isinstance(wanted, str) else wanted
        self._requested = threading.Event()

    def request(self) -> None:
        """End the episode with the current or the next step. Any thread may call this."""
        self._requested.set()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        self._requested.clear()
        return self.env.reset(seed=seed, options=options)

    def step(self, action: Any) -> Step:
        """:return: as the environment, with ``info["manual_reset"]`` if an end was requested"""
        obs, reward, terminated, truncated, info = self.env.step(action)
        if self._requested.is_set() or (self._wanted is not None and self._wanted()):
            self._requested.clear()
            return obs, reward, terminated, True, info | {"manual_reset": True}
        return obs, reward, terminated, truncated, info

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_requested": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._requested = threading.Event()


def _marked(info: dict[str, Any], name: str, truncated: bool) -> dict[str, Any]:
    """:return: with this entry, and the flag of rl_zoo3's ``TimeLimit`` corrected, if present"""
    info = info | {name: True}
    if "TimeLimit.truncated" in info:
        info["TimeLimit.truncated"] = truncated
    return info


class Limit(NamedTuple):
    """
    :param layer: class of the wrapper
    :param steps: after which it truncates an episode
    """

    layer: str
    steps: int

    def __str__(self) -> str:
        return f"{self.steps} steps of {self.layer}"


def limits_of(env: gymnasium.Env) -> list[Limit]:
    """:return: the limits of all wrappers (``TimeLimit``, ``InfiniteHorizon``), outermost first"""
    layer, limits = env, []
    while isinstance(layer, gymnasium.Wrapper):
        limits += own_limit(layer, "_max_episode_steps")
        layer = layer.env
    return limits


def own_limit(layer: Any, *names: str) -> list[Limit]:
    """
    :param names: of the attribute, the first that exists counts
    :return: the limit of this layer alone; empty if it has none
    """
    for name in names:
        steps = vars(layer).get(name)
        if isinstance(steps, int) and 0 < steps < _NONE:
            return [Limit(type(layer).__name__, steps)]
    return []


def step_limit_of(env: gymnasium.Env) -> int | None:
    """
    :return: the smallest of all layers (``TimeLimit``, ``InfiniteHorizon``); without any, the
        registered one
    """
    if limits := limits_of(env):
        return min(limit.steps for limit in limits)
    registered = getattr(env.spec, "max_episode_steps", None) or 0
    # Gymnasium writes -1 for "none, whatever is registered".
    return registered if registered > 0 else None


def chosen_limit(wrapper: str, env: gymnasium.Env, max_episode_steps: int | None) -> int:
    """
    :param wrapper: name of the wrapper that needs a limit
    :param max_episode_steps: its argument; None: the environment's own limit
    :raises ParameterError: unless it is a positive integer, or if the environment has no limit
    """
    limit = step_limit_of(env) if max_episode_steps is None else max_episode_steps
    if limit is None:
        raise ParameterError(
            f"{wrapper} cannot tell after how many steps {env} cuts an episode. "
            f"Pass {wrapper}(env, max_episode_steps=...)."
        )
    if isinstance(limit, bool) or not isinstance(limit, int) or limit < 1:
        raise ParameterError(
            f"{wrapper}(max_episode_steps={limit!r}): max_episode_steps must be a positive whole "
            "number, or None for the environment's own limit."
        )
    return limit
