"""Policies, their algorithms, and environments in wrappers, as the command line names them."""

import argparse
import warnings
from pathlib import Path
from typing import Any

from sb3_hds.cli.arguments import settings
from sb3_hds.errors import EnvironmentMismatchError, ParameterError, did_you_mean
from sb3_hds.wrappers.by_name import imported

# The classes of rl_zoo3's own ids.
_OF_RL_ZOO = {
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
    :param name: id of ours or of RL Zoo, or the dotted name of a class
    :raises ParameterError: if there is none, or if it cannot load models
    """
    from sb3_hds.algos import ALL

    if name in ALL:
        return ALL[name]
    if name not in _OF_RL_ZOO and "." not in name:
        known = [*ALL, *_OF_RL_ZOO]
        raise ParameterError(
            f"There is no algorithm '{name}'.{did_you_mean(name.lower(), known)} There are: "
            f"{', '.join(known)}; or name a class: sbx.SAC."
        )
    found = imported(_OF_RL_ZOO.get(name, name), "class")
    if not hasattr(found, "load"):
        raise ParameterError(f"'{name}' is {found!r}, which is no algorithm: it loads no model.")
    return found


def load_policy(path: str, algo: str | None) -> Any:
    """
    :param path: of a saved model
    :param algo: as for :func:`algorithm`; None: read from the file
    :raises FileNotFoundError: for a missing file, with the nearest name in its folder
    :raises ParameterError: for a file that holds no model of that algorithm
    """
    from sb3_hds import algos

    kind, file = None if algo is None else algorithm(algo), Path(path)
    if not file.is_file() and not file.with_name(f"{file.name}.zip").is_file():
        beside = [str(found) for found in file.parent.glob("*.zip")]
        raise FileNotFoundError(f"There is no model '{path}'.{did_you_mean(path, beside)}")
    if kind is not None:
        try:
            return kind.load(path)
        except (ValueError, TypeError, KeyError, AttributeError) as error:
            why = str(error).strip().partition("\n")[0]
            raise ParameterError(f"{path} holds no model of {algo}: {why}") from error
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return algos.load_policy(path)
    except ValueError as error:
        raise ParameterError(
            f"{error} Of Stable-Baselines3 or SBX, say which algorithm: --algo sac, --algo "
            "sbx.SAC; the file is then unpickled."
        ) from error


def add_env(command: argparse.ArgumentParser, explained: str, *, required: bool = True) -> None:
    """
    :param command: to which ``--env``, ``--env-kwargs`` and ``--env-wrapper`` are added
    :param explained: help of ``--env``
    """
    command.add_argument("--env", required=required, help=explained)
    command.add_argument("--env-kwargs", nargs="*", default=[], metavar="NAME:VALUE")
    command.add_argument(
        "--env-wrapper",
        nargs="*",
        default=[],
        metavar="CLASS",
        help="wrappers of the training, the innermost first: package.Wrapper, or with "
        "arguments as in yml, 'package.Wrapper: {cutoff: 4.0}'",
    )


def bare_environment(given: argparse.Namespace) -> Any:
    """
    :return: the environment of ``--env`` and ``--env-kwargs``
    :raises ParameterError: for arguments of another form
    :raises EnvironmentMismatchError: if there is no such environment
    """
    import gymnasium

    kwargs = settings("--env-kwargs", given.env_kwargs)
    try:
        return gymnasium.make(given.env, **kwargs)
    except (gymnasium.error.Error, TypeError) as error:
        raise EnvironmentMismatchError(
            f"There is no '{given.env}' with {kwargs}: {error}"
        ) from error


def wrapped(given: argparse.Namespace, env: Any) -> Any:
    """
    :return: the environment in the wrappers of ``--env-wrapper``, the first innermost
    :raises ParameterError: for another form, or a class that cannot be imported
    """
    for wrapper, arguments in map(_wrapper, given.env_wrapper):
        env = wrapper(env, **arguments)
    return env


def _wrapper(text: str) -> tuple[Any, dict[str, Any]]:
    """The class and its arguments, of ``package.Wrapper``, or ``package.Wrapper: {a: 1}``."""
    import yaml

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
    return imported(path, "class"), arguments
