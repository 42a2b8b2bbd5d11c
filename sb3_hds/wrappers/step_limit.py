"""After how many steps an environment cuts its episodes."""

import gymnasium

from sb3_hds.errors import ParameterError


def step_limit_of(env: gymnasium.Env) -> int | None:
    """
    :return: the least of all layers (``TimeLimit``, ``InfiniteHorizon``), or without those what the
        environment is registered with
    """
    layer, limits = env, []
    while isinstance(layer, gymnasium.Wrapper):
        if isinstance(limit := vars(layer).get("_max_episode_steps"), int):
            limits.append(limit)
        layer = layer.env
    if limits:
        return min(limits)
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
