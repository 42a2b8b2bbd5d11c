"""The step limits in a stack of wrappers."""

from typing import Any, NamedTuple

import gymnasium

from sb3_hds.errors import ParameterError

# Gymnasium writes -1 for "no limit", and vectorised simulators the largest int32.
_NONE = 2**31 - 1


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
    spec = env.spec
    # Gymnasium writes -1 for "none, whatever is registered".
    return (
        spec.max_episode_steps if spec is not None and (spec.max_episode_steps or 0) > 0 else None
    )


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
