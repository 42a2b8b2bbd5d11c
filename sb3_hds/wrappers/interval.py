"""The control interval of an environment."""

import numbers
import warnings
from collections.abc import Callable
from typing import Any

import gymnasium


def interval_of(env: gymnasium.Env, error: type[Exception], *, from_fps: bool = False) -> float:
    """
    :param error: type of the exception if the interval is unknown
    :param from_fps: whether to fall back on the rendering rate, with a warning
    :return: the control interval [s]
    """
    inner = env.unwrapped
    return interval_from(
        lambda name: getattr(inner, name, None), str(inner), error, from_fps=from_fps
    )


def interval_from(
    attribute: Callable[[str], Any], env: str, error: type[Exception], *, from_fps: bool
) -> float:
    """
    As :func:`interval_of`.

    :param attribute: returns an attribute of the environment by name, or None
    :param env: its name, for messages
    """
    twin = attribute("twin")
    for value in (*map(attribute, ("dt", "tau")), *(getattr(twin, n, None) for n in ("dt", "tau"))):
        if isinstance(value, numbers.Real) and (seconds := float(value)) > 0.0:
            return seconds
    rate = (attribute("metadata") or {}).get("render_fps")
    if from_fps and rate:
        warnings.warn(
            f"{env} does not say how long a step is; it renders {rate} times a second, so a step "
            f"is assumed to take {1.0 / rate:.4g} s. Pass dt=SECONDS if that is wrong.",
            stacklevel=3,
        )
        return 1.0 / rate
    raise error(f"{env} does not say how long a step is: it has no attribute dt. Pass dt=SECONDS.")
