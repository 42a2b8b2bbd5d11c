"""
``sb3-hds``: what is wrong with a simulation, and how robust a policy is, from the command line.

    sb3-hds diagnose --twin PendulumReal --data 'logs/*.csv' --columns map.yml --report out.html
    sb3-hds robustness --algo openloop --model model.zip --env Swimmer-v5
    sb3-hds effects
    sb3-hds twins
"""

import argparse
import functools
import importlib
import io
import json
import sys
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


def main(arguments: Sequence[str] | None = None) -> int:
    """
    :param arguments: as on the command line; default: those of this process
    :return: 0 on any verdict; 1 where the question makes no sense, with one line on why
    """
    given = parser().parse_args(arguments)
    from sb3_hds.errors import SB3HDSError

    try:
        {
            "diagnose": _diagnose,
            "robustness": _robustness,
            "effects": _effects,
            "twins": _twins,
        }[given.command](given)
    except BrokenPipeError:
        return 0
    except (SB3HDSError, OSError, ImportError) as error:
        print(f"sb3-hds: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("sb3-hds: interrupted", file=sys.stderr)
        return 130
    return 0


def parser() -> argparse.ArgumentParser:
    """:return: what the command understands"""
    every = argparse.ArgumentParser(
        prog="sb3-hds",
        description="What a simulation gets wrong, and what a policy endures.",
    )
    commands = every.add_subparsers(dest="command", required=True)
    ask = commands.add_parser("diagnose", help="name the cause, from measured data")
    ask.add_argument("--twin", required=True, help="name or environment id, see 'sb3-hds twins'")
    ask.add_argument("--data", required=True, nargs="+", help="files, or patterns in quotes")
    ask.add_argument("--columns", help="yml file: what the columns of a log mean")
    ask.add_argument("--set", nargs="*", default=[], metavar="NAME:VALUE", help="of the twin")
    ask.add_argument("--calibrate", nargs="*", default=[], help="parameters that are not believed")
    ask.add_argument("--effects", nargs="*", help="candidates; default: all, see 'sb3-hds effects'")
    ask.add_argument("--budget", choices=("full", "quick"), default="full")
    ask.add_argument("--seed", type=int, default=0)
    ask.add_argument("--report", help="HTML page to write")
    ask.add_argument("--json", help="JSON file to write")
    shake = commands.add_parser("robustness", help="return under noise, failed sensors, pushes")
    shake.add_argument(
        "--algo", required=True, help="id in the zoo, ours or rl_zoo3's, or a class: sbx.SAC"
    )
    shake.add_argument("--model", required=True, help="file that the algorithm saved")
    shake.add_argument("--env", required=True, help="environment id")
    shake.add_argument("--env-kwargs", nargs="*", default=[], metavar="NAME:VALUE")
    shake.add_argument(
        "--env-wrapper",
        nargs="*",
        default=[],
        metavar="CLASS",
        help="as trained, the one next to the environment first: package.Wrapper, or with "
        "arguments as in yml, 'package.Wrapper: {cutoff: 4.0}'",
    )
    shake.add_argument("--episodes", type=int, default=20, help="for each perturbation")
    shake.add_argument("--encoders", choices=("own", "observation"), default="own")
    shake.add_argument("--vecnormalize", help="vecnormalize.pkl of the training")
    shake.add_argument("--push", type=float, default=5.0, help="force on the torso [N]")
    shake.add_argument("--csv", help="table to write")
    commands.add_parser("effects", help="list the candidates, with units and explanations")
    commands.add_parser("twins", help="list the simulations, with their parameters")
    return every


def _diagnose(given: argparse.Namespace) -> None:
    from sb3_hds.core.storage import write_bytes
    from sb3_hds.data import Trajectories
    from sb3_hds.effects import ALL
    from sb3_hds.errors import EffectError
    from sb3_hds.sysid import diagnose
    from sb3_hds.twins import make

    known = {effect.name: effect for effect in ALL}
    unknown = [name for name in given.effects or () if name not in known]
    if unknown:
        raise EffectError(
            f"There is no effect {', '.join(unknown)}. There are: {', '.join(known)}."
        )
    twin = make(given.twin, **dict(map(_setting, given.set)))
    files = given.data[0] if len(given.data) == 1 else given.data
    data = Trajectories.load(files, columns=given.columns)
    chosen = ALL if given.effects is None else tuple(known[name] for name in given.effects)
    found = diagnose(
        twin,
        data,
        effects=chosen,
        calibrate=given.calibrate,
        seed=given.seed,
        budget=given.budget,
        progress=sys.stderr.isatty(),
    )
    print(found)
    if given.json:
        text = json.dumps(found.to_dict(), indent=1, allow_nan=False) + "\n"
        write_bytes(given.json, text.encode())
    if given.report:
        print(f"The report is {found.to_html(given.report)}.")


def _robustness(given: argparse.Namespace) -> None:
    import csv

    from sb3_hds.core.storage import write_bytes
    from sb3_hds.experiments import PERTURBATIONS, measure_robustness

    changed = {name: dict(settings) for name, settings in PERTURBATIONS.items()}
    changed["push"]["push"] = given.push
    kwargs = dict(map(_yml_setting, given.env_kwargs))
    wrap = functools.partial(_wrapped, [_wrapper(text) for text in given.env_wrapper])
    found = measure_robustness(
        _algorithm(given.algo).load(given.model),
        functools.partial(_made, given.env, kwargs),
        wrapper=wrap,
        perturbations=changed,
        n_episodes=given.episodes,
        encoders=given.encoders,
        normalize=given.vecnormalize,
        progress=sys.stderr.isatty(),
    )
    print(found)
    if given.csv:
        lines, rows = io.StringIO(), found.to_rows()
        table = csv.DictWriter(lines, list(rows[0]), lineterminator="\n")
        table.writeheader()
        table.writerows(rows)
        write_bytes(given.csv, lines.getvalue().encode())


def _algorithm(name: str) -> Any:
    from sb3_hds.algos import ALL
    from sb3_hds.errors import ParameterError

    if name in ALL:
        return ALL[name]
    if name not in _THEIRS and "." not in name:
        known = ", ".join([*ALL, *_THEIRS])
        raise ParameterError(
            f"There is no algorithm '{name}'. There are: {known}; or name a class: sbx.SAC."
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


def _made(env_id: str, kwargs: dict[str, Any]) -> Any:
    import gymnasium

    from sb3_hds.errors import EnvironmentMismatchError

    try:
        return gymnasium.make(env_id, **kwargs)
    except (gymnasium.error.Error, TypeError) as error:
        raise EnvironmentMismatchError(f"There is no '{env_id}' with {kwargs}: {error}") from error


def _wrapper(text: str) -> tuple[Any, dict[str, Any]]:
    """:return: a class and its arguments, of ``package.Wrapper`` or ``package.Wrapper: {a: 1}``"""
    import yaml

    from sb3_hds.errors import ParameterError

    try:
        found = yaml.safe_load(text)
    except yaml.YAMLError:
        found = None
    entries = list(found.items()) if isinstance(found, dict) else [(found, None)]
    path, arguments = entries[0] if len(entries) == 1 else (None, None)
    arguments = {} if arguments is None else arguments
    if not isinstance(path, str) or not isinstance(arguments, dict):
        raise ParameterError(
            "--env-wrapper takes package.Wrapper, or with arguments 'package.Wrapper: {a: 1}', got "
            f"'{text}'."
        )
    return _class_of(path), arguments


def _wrapped(wrappers: Sequence[tuple[Any, dict[str, Any]]], env: Any) -> Any:
    for wrapper, arguments in wrappers:
        env = wrapper(env, **arguments)
    return env


def _yml_setting(text: str) -> tuple[str, Any]:
    import yaml

    from sb3_hds.errors import ParameterError

    name, colon, value = text.partition(":")
    try:
        if name and colon:
            return name, yaml.safe_load(value)
    except yaml.YAMLError:
        pass
    raise ParameterError(f"--env-kwargs takes NAME:VALUE with a value as in yml, got '{text}'.")


def _setting(text: str) -> tuple[str, float]:
    from sb3_hds.errors import ParameterError

    name, _, value = text.partition(":")
    try:
        return name, float(value)
    except ValueError:
        raise ParameterError(f"--set takes NAME:VALUE with a number, got '{text}'.") from None


def _effects(given: argparse.Namespace) -> None:
    from sb3_hds.effects import ALL

    _show(
        ("effect", "acts on", "parameters", "what it is"),
        [
            (
                effect.name,
                effect.slot,
                ", ".join(f"{name} [{p.unit}]" for name, p in effect.parameters.items()),
                effect.explanation,
            )
            for effect in ALL
        ],
    )


def _twins(given: argparse.Namespace) -> None:
    from sb3_hds.twins import make, names

    rows = []
    for name in names():
        twin = make(name)
        described = ", ".join(
            f"{key} {value:g} {twin.parameters[key].unit}" for key, value in twin.values.items()
        )
        rows.append((name, twin.env_id or "", described))
    _show(("twin", "environment", "parameters"), rows)


def _show(columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(*columns)
    for row in rows:
        table.add_row(*map(str, row))
    Console(width=None if sys.stdout.isatty() else 120).print(table)


if __name__ == "__main__":
    sys.exit(main())
