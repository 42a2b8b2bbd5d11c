"""Classes that the command line names: algorithms and wrappers."""

import importlib
from collections.abc import Sequence
from typing import Any

# Ids that rl_zoo3 has by itself, and where their classes are.
_THEIRS = {
    "a2c": "stable_baselines3.A2C",
    "ddpg": "stable_baselines3.DDPG",
    "dqn": "stable_baselines3.DQN",
    "ppo": "stable_baselines3.PPO",
    "sac": "stable_baselines3.SAC",
    "td3": "stable_baselines3.TD3",
    "ars": "sb3_contrib.ARS",
    "crossq": "sb3_contrib.CrossQ",
    "ppo_lstm": "sb3_contrib.RecurrentPPO",
    "qrdqn": "sb3_contrib.QRDQN",
    "tqc": "sb3_contrib.TQC",
    "trpo": "sb3_contrib.TRPO",
}


def algorithm(name: str) -> Any:
    """
    :param name: id of ours or of RL Zoo, or the path of a class
    :raises ParameterError: if there is none, or if it loads no model
    """
    from sb3_hds.algos import ALL
    from sb3_hds.errors import ParameterError, did_you_mean

    if name in ALL:
        return ALL[name]
    if name not in _THEIRS and "." not in name:
        known = [*ALL, *_THEIRS]
        raise ParameterError(
            f"There is no algorithm '{name}'.{did_you_mean(name.lower(), known)} There are: "
            f"{', '.join(known)}; or name a class: sbx.SAC."
        )
    found = _class_of(_THEIRS.get(name, name))
    if not hasattr(found, "load"):
        raise ParameterError(f"'{name}' is {found!r}, which is no algorithm: it loads no model.")
    return found


def _class_of(path: str) -> Any:
    from sb3_hds.errors import ParameterError

    module, _, name = path.rpartition(".")
    try:
        return getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise ParameterError(f"There is no class '{path}' to import: {error}.") from error


def wrapper(text: str) -> tuple[Any, dict[str, Any]]:
    """
    :param text: ``package.Wrapper``, or ``package.Wrapper: {a: 1}`` as in yml
    :return: the class and its arguments
    :raises ParameterError: for another form, or a class that cannot be imported
    """
    import yaml

    from sb3_hds.errors import ParameterError

    try:
        found = yaml.safe_load(text)
    except yaml.YAMLError:
        found = None
    if isinstance(found, str):
        found = {found: {}}
    path, arguments = "", None
    if isinstance(found, dict) and len(found) == 1 and isinstance(next(iter(found)), str):
        path, arguments = next(iter(found.items()))
        arguments = {} if arguments is None else arguments
    if not isinstance(arguments, dict):
        raise ParameterError(
            "--env-wrapper takes package.Wrapper, or with arguments 'package.Wrapper: {a: 1}', got "
            f"'{text}'."
        )
    return _class_of(path), arguments


def wrapped(wrappers: Sequence[tuple[Any, dict[str, Any]]], env: Any) -> Any:
    """:return: the environment in its wrappers, the first of them next to it"""
    for wrapper, arguments in wrappers:
        env = wrapper(env, **arguments)
    return env
