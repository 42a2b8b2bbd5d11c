"""The control interval of an environment."""

import numbers
import warnings
from collections.abc import Callable
from typing import Any

import gymnasium


def interval_of(env: gymnasium.Env, error: type[Exception], *, drawn: bool = False) -> float:
    """
    :param error: type of the exception where the interval is unknown
    :param drawn: whether to fall back on the rendering rate, with a warning
    :return: the control interval [s]
    """
    inner = env.unwrapped
    return interval_from(lambda name: getattr(inner, name, None), str(inner), error, drawn=drawn)


def interval_from(
    attribute: Callable[[str], Any], env: str, error: type[Exception], *, drawn: bool
) -> float:
    """
    As :func:`interval_of`.

    :param attribute: of the environment, by name; None where there is none
    :param env: what to call it
    """
    twin = attribute("twin")
    for value in (*map(attribute, ("dt", "tau")), *(getattr(twin, n, None) for n in ("dt", "tau"))):
        if isinstance(value, numbers.Real) and (seconds := float(value)) > 0.0:
            return seconds
    rate = (attribute("metadata") or {}).get("render_fps")
    if drawn and rate:
        warnings.warn(
            f"{env} does not say how long a step is; it is drawn {rate} times a second, so a step "
            f"is taken for {1.0 / rate:.4g} s. Pass dt=SECONDS where that is wrong.",
            stacklevel=3,
        )
        return 1.0 / rate
    raise error(f"{env} does not say how long a step is: it has no attribute dt. Pass dt=SECONDS.")
