"""How long a step of an environment is."""

import numbers

import gymnasium


def interval_of(env: gymnasium.Env, error: type[Exception]) -> float:
    """
    :param error: raised where the environment does not tell
    :return: the control interval [s]
    """
    inner = env.unwrapped
    for owner in (inner, getattr(inner, "twin", None)):
        for name in ("dt", "tau"):
            if isinstance(value := getattr(owner, name, None), numbers.Real):
                return float(value)
    raise error(
        f"{inner} does not say how long a step is: it has no attribute dt. Pass dt=SECONDS."
    )
