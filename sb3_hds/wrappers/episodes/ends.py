"""Terminations and truncations, converted into each other."""

from typing import Any

import gymnasium

from sb3_hds.wrappers.episodes.step_limit import chosen_limit

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


def _told(info: dict[str, Any], name: str, truncated: bool) -> dict[str, Any]:
    """:return: with the old flag of rl_zoo3's ``TimeLimit``, where it is there, set right"""
    marked = info | {name: True}
    if "TimeLimit.truncated" in marked:
        marked["TimeLimit.truncated"] = truncated
    return marked
