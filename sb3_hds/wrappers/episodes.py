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
    Turns every end into a truncation, so that learners bootstrap the value of the last state.

    For environments that end for a reason that is not part of the task: an operator, a workspace
    that was left, a limit that is signalled as termination. Rewards are left alone, so where an end
    means failure, the reward must say so, or the learner sees nothing wrong with it.

    :param env: of any kind
    """

    def __init__(self, env: gymnasium.Env) -> None:
        gymnasium.utils.RecordConstructorArgs.__init__(self)
        gymnasium.Wrapper.__init__(self, env)

    def step(self, action: Any) -> Step:
        """:return: as the environment, with ``info["was_terminated"]`` where it said so"""
        obs, reward, terminated, truncated, info = self.env.step(action)
        if terminated:
            return obs, reward, False, True, _told(info, "was_terminated", truncated=True)
        return obs, reward, False, truncated, info


class TruncateToTerminate(gymnasium.Wrapper, gymnasium.utils.RecordConstructorArgs):
    r"""
    Turns every end into a termination: the value of the last state is 0.

    For a task that really is over after its time, such as "as far as possible in ten seconds".
    Values are then functions of time, so add :class:`~sb3_hds.wrappers.TimeAware` outside. Without
    it, one observation has as many values :math:`\sum_{k<n} \gamma^k r` as there are steps
    :math:`n` left.

    Source: Pardo et al., *Time Limits in Reinforcement Learning*, ICML 2018, section 3
    ("time-awareness").

    :param env: of any kind
    """

    def __init__(self, env: gymnasium.Env) -> None:
        gymnasium.utils.RecordConstructorArgs.__init__(self)
        gymnasium.Wrapper.__init__(self, env)

    def step(self, action: Any) -> Step:
        """:return: as the environment, with ``info["was_truncated"]`` where a limit ended it"""
        obs, reward, terminated, truncated, info = self.env.step(action)
        if truncated and not terminated:
            return obs, reward, True, False, _told(info, "was_truncated", truncated=False)
        return obs, reward, terminated, False, info


class InfiniteHorizon(gymnasium.Wrapper, gymnasium.utils.RecordConstructorArgs):
    """
    A task without a time limit: after ``max_episode_steps`` an episode is truncated, not
    terminated.

    Ends before the limit, such as a fall, stay what they are. For environments that count their
    steps themselves and call the last one a termination, and for those that have no limit: a robot
    that walks for ever still has to be put back sometimes. A failure in the very step of the limit
    cannot be distinguished from the limit, and counts as the limit.

    Source: Pardo et al., *Time Limits in Reinforcement Learning*, ICML 2018, section 4
    ("partial-episode bootstrapping").

    :param env: of any kind
    :param max_episode_steps: None: the environment's own limit
    :raises ParameterError: for no positive whole number, or where the environment has no limit
    """

    def __init__(self, env: gymnasium.Env, max_episode_steps: int | None = None) -> None:
        gymnasium.utils.RecordConstructorArgs.__init__(self, max_episode_steps=max_episode_steps)
        gymnasium.Wrapper.__init__(self, env)
        # As Gymnasium's TimeLimit calls it: who looks for limits finds both.
        self._max_episode_steps = chosen_limit("InfiniteHorizon", env, max_episode_steps)
        self._elapsed = 0

    @property
    def max_episode_steps(self) -> int:
        """After how many steps an episode is cut."""
        return self._max_episode_steps

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        self._elapsed = 0
        return self.env.reset(seed=seed, options=options)

    def step(self, action: Any) -> Step:
        """:return: as the environment, with ``info["was_terminated"]`` where the limit was one"""
        obs, reward, terminated, truncated, info = self.env.step(action)
        self._elapsed += 1
        if self._elapsed < self.max_episode_steps:
            return obs, reward, terminated, truncated, info
        if terminated:
            info = _told(info, "was_terminated", truncated=True)
        return obs, reward, False, True, info


class ManualReset(gymnasium.Wrapper, gymnasium.utils.RecordConstructorArgs):
    """
    Ends an episode when asked to: with a key, a foot switch, or from another thread.

    The step during which the request comes is truncated, not terminated, because the task is not
    over. Observations, actions and rewards are
    left alone.

    :param env: of any kind
    :param wanted: asked after every step whether to end, or its name ``"package.module.function"``;
        default: only :meth:`request` ends. In ``env.spec``, a name is remembered and a function is
        not: it may be one that no other process has.
    :raises ParameterError: if there is no function of that name
    """

    def __init__(self, env: gymnasium.Env, wanted: Callable[[], bool] | str | None = None) -> None:
        name = wanted if isinstance(wanted, str) else None
        gymnasium.utils.RecordConstructorArgs.__init__(self, wanted=name)
        gymnasium.Wrapper.__init__(self, env)
        self._wanted = function_of(wanted) if isinstance(wanted, str) else wanted
        self._requested = threading.Event()

    def request(self) -> None:
        """End the episode with the step that is running, or the next one. Any thread may call."""
        self._requested.set()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        self._requested.clear()
        return self.env.reset(seed=seed, options=options)

    def step(self, action: Any) -> Step:
        """:return: as the environment, with ``info["manual_reset"]`` where it was asked to end"""
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


def _told(info: dict[str, Any], name: str, truncated: bool) -> dict[str, Any]:
    """:return: with the old flag of rl_zoo3's ``TimeLimit``, where it is there, set right"""
    marked = info | {name: True}
    if "TimeLimit.truncated" in marked:
        marked["TimeLimit.truncated"] = truncated
    return marked


class Limit(NamedTuple):
    """
    :param layer: class of the wrapper that has it
    :param steps: after which that cuts an episode
    """

    layer: str
    steps: int

    def __str__(self) -> str:
        return f"{self.steps} steps of {self.layer}"


def limits_of(env: gymnasium.Env) -> list[Limit]:
    """:return: of each wrapper with one (``TimeLimit``, ``InfiniteHorizon``), outermost first"""
    layer, limits = env, []
    while isinstance(layer, gymnasium.Wrapper):
        limits += own_limit(layer, "_max_episode_steps")
        layer = layer.env
    return limits


def own_limit(layer: Any, *names: str) -> list[Limit]:
    """
    :param names: of the attribute that holds it, the first one that is there counts
    :return: of this layer alone; empty: it has none
    """
    for name in names:
        steps = vars(layer).get(name)
        if isinstance(steps, int) and 0 < steps < _NONE:
            return [Limit(type(layer).__name__, steps)]
    return []


def step_limit_of(env: gymnasium.Env) -> int | None:
    """
    :return: the least of all layers (``TimeLimit``, ``InfiniteHorizon``), or without those what the
        environment is registered with
    """
    if limits := limits_of(env):
        return min(limit.steps for limit in limits)
    registered = getattr(env.spec, "max_episode_steps", None) or 0
    # Gymnasium writes -1 for "none, whatever is registered".
    return registered if registered > 0 else None


def chosen_limit(wrapper: str, env: gymnasium.Env, max_episode_steps: int | None) -> int:
    """
    :param wrapper: the name of the wrapper that needs a limit
    :param max_episode_steps: what it was given; None: the environment's own
    :raises ParameterError: for no positive whole number, or where the environment has no limit
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
