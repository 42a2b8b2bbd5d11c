"""Which twin an algorithm plans in, and whether it can."""

import warnings
from typing import Any

from sb3_hds import effects, twins
from sb3_hds.core import Twin
from sb3_hds.errors import NoTwinError, RewardError


def check_reward(twin: Twin) -> None:
    """
    :raises RewardError: if planning has nothing to climb in this twin
    """
    base = getattr(twin, "base", twin)
    surrogate = type(base).planning_reward is not Twin.planning_reward
    if not surrogate and type(base).reward is Twin.reward:
        raise RewardError(
            f"{twin.name} has no reward: it simulates a system without a task. Implement `reward`."
        )
    if not surrogate and not base.reward_has_gradient:
        raise RewardError(
            f"The reward of {twin.name} is flat almost everywhere, so its gradient tells nothing. "
            "Implement `planning_reward`: a smooth surrogate that is best where the reward is best."
        )


def required(twin: Twin | None, spec: dict[str, Any] | None) -> Twin:
    """
    :param spec: of a saved twin that is not registered here
    :return: the twin
    :raises NoTwinError: if there is none
    """
    if twin is not None:
        return twin
    way_out = "" if spec else "Set an environment that has one (set_env). "
    raise NoTwinError(
        f"This model has no twin to plan in. {way_out}"
        "Load it with one: load(path, env=env, twin=...)."
    )


def twin_from_spec(spec: dict[str, Any]) -> Twin | None:
    """:return: the twin that a file describes, or None, with a warning, if it is not registered"""
    try:
        return twins.from_spec(spec, effects.ALL)
    except NoTwinError as error:
        warnings.warn(
            f"The model can predict but not train, because its twin '{spec['twin']}' is not "
            f"registered here. Register it, or load with twin=... ({str(error).splitlines()[0]})"
        )
        return None
