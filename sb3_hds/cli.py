"""
``sb3-hds``: what is wrong with a simulation, and how robust a policy is, from the command line.

    sb3-hds diagnose --twin PendulumReal --data 'logs/*.csv' --columns map.yml --report out.html
    sb3-hds diagnose --twin my_module:MyTwin --data 'logs/*.csv' --columns map.yml
    sb3-hds diagnose --twin LinearAxis --set observe:q mass:95 --data log.mat --columns map.yml
    sb3-hds robustness --algo openloop --model model.zip --env Swimmer-v5
    sb3-hds effects
    sb3-hds twins
"""

import argparse
import dataclasses
import functools
import importlib
import io
import json
import sys
import warnings
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sb3_hds.core import Parameter, Trajectories, Twin
    from sb3_hds.experiments import PolicyGain
    from sb3_hds.sysid import Diagnosis

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

_COLUMNS = """Say what the columns mean in a yml file, --columns map.yml:

    time: NAME                               # or {column: NAME, scale: 0.001}, or dt: SECONDS
    obs: [NAME, {column: NAME, scale: 1.0}]  # in the order of 'sb3-hds twins'
    actions: [NAME]"""

_FURTHER = {"sign_flip": " So may all of a joint: the direction of position and velocity at once."}
_OF_A_TWIN = (
    "A parameter of the twin has another value than believed: each one of 'sb3-hds twins' that "
    "--calibrate does not name. Always a candidate; --effects does not take it."
)


def main(arguments: Sequence[str] | None = None) -> int:
    """
    :param arguments: as on the command line; default: those of this process
    :return: 0 on any verdict; 1 where the question makes no sense, with one line on why
    """
    given = parser().parse_args(arguments)
    from sb3_hds.errors import SB3HDSError

    try:
        with warnings.catch_warnings():
            warnings.showwarning = _warn
            # Meant for programmers.
            warnings.simplefilter("ignore", DeprecationWarning)
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


def _warn(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    file: Any = None,
    line: str | None = None,
) -> None:
    """One line, without the code that warns."""
    print(f"warning: {' '.join(str(message).split())}", file=sys.stderr)


def parser() -> argparse.ArgumentParser:
    """:return: what the command understands"""
    every = argparse.ArgumentParser(
        prog="sb3-hds",
        description="What a simulation gets wrong, and what a policy endures.",
    )
    commands = every.add_subparsers(dest="command", required=True)
    ask = commands.add_parser("diagnose", help="name the cause, from measured data")
    ask.add_argument(
        "--twin",
        required=True,
        help="name or environment id, see 'sb3-hds twins'; module:Name for one of your own; or the "
        "file that --json wrote, for the twin that was extended there",
    )
    ask.add_argument("--data", required=True, nargs="+", help="files, or patterns in quotes")
    ask.add_argument("--columns", help="yml file: what the columns of a log mean")
    ask.add_argument(
        "--correct", action="store_true", help="cut and shift the data where their audit says so"
    )
    ask.add_argument(
        "--set",
        nargs="*",
        default=[],
        metavar="NAME:VALUE",
        help="parameters and options of the twin: mass:0.3 observe:q driven:true",
    )
    ask.add_argument("--calibrate", nargs="*", default=[], help="parameters that are not believed")
    ask.add_argument("--effects", nargs="*", help="candidates; default: all, see 'sb3-hds effects'")
    ask.add_argument("--budget", choices=("full", "quick"), default="full")
    ask.add_argument("--seed", type=int, default=0)
    ask.add_argument("--report", help="HTML page to write")
    ask.add_argument("--json", help="JSON file to write")
    worth = ask.add_argument_group("what it buys", "policies from both twins, on the real system")
    worth.add_argument("--env", help="id of the real system")
    worth.add_argument("--env-kwargs", nargs="*", default=[], metavar="NAME:VALUE", help="of it")
    worth.add_argument("--algo", default="hds", help="id in the zoo; default: hds")
    worth.add_argument("--policies", type=int, default=5, help="trained in each twin; default: 5")
    worth.add_argument("--policy-budget", type=int, default=0, help="steps of training in a twin")
    worth.add_argument("--episodes", type=int, default=20, help="for each policy; default: 20")
    worth.add_argument(
        "--hyperparams", nargs="*", default=[], metavar="NAME:VALUE", help="of the algorithm"
    )
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
    from sb3_hds.data import audit
    from sb3_hds.effects import ALL
    from sb3_hds.sysid import diagnose

    _check_targets(given)
    twin = _twin(given.twin, _settings("--set", given.set))
    measure = None if given.env is None else _policy_question(given, twin)
    files = given.data[0] if len(given.data) == 1 else given.data
    data = _loaded(files, given.columns)
    corrections: tuple[str, ...] = ()
    if given.correct:
        checked = audit(data, channels=twin.channels)
        corrections, data = checked.corrections, checked.corrected(data)
    found = diagnose(
        twin,
        data,
        effects=ALL if given.effects is None else _names(given.effects),
        calibrate=_names(given.calibrate),
        seed=given.seed,
        budget=given.budget,
        progress=sys.stderr.isatty(),
    )
    found = dataclasses.replace(found, caveats=(*corrections, *found.caveats))
    print(found)
    plain, gain = found.to_dict(), None
    if measure is not None and found.twin.values == found.believed.values:
        print("The twin is left as it was, so there are no policies to compare.")
    elif measure is not None:
        measured = measure(found)
        print(measured)
        plain["policy_gain"] = gain = measured.to_dict()
    if given.json:
        text = json.dumps(plain, indent=1, allow_nan=False) + "\n"
        write_bytes(given.json, text.encode())
    if given.report:
        print(f"The report is {found.to_html(given.report, gain)}.")


def _loaded(files: str | Sequence[str], columns: str | None) -> "Trajectories":
    """What is wrong with the map of columns is said in yml."""
    from sb3_hds.data import Trajectories
    from sb3_hds.data.columns import FORM
    from sb3_hds.data.load import WITHOUT_COLUMNS
    from sb3_hds.errors import TrajectoryError

    try:
        return Trajectories.load(files, columns=columns)
    except TrajectoryError as error:
        told = str(error)
        for python in (FORM, WITHOUT_COLUMNS):
            if python in told:
                told = told.replace(python, _COLUMNS)
        raise TrajectoryError(told) from error


def _names(words: Sequence[str]) -> list[str]:
    """Words that blanks or commas separate."""
    return [name for word in words for name in word.split(",") if name]


def _twin(name: str, settings: dict[str, Any]) -> "Twin":
    """A module that registers it, or the file of a diagnosis, may lie in the current folder."""
    from sb3_hds.errors import NoTwinError
    from sb3_hds.twins import get

    if name.endswith(".json"):
        return _extended(name).with_parameters(**settings)
    if ":" in name and "" not in sys.path:
        sys.path.insert(0, "")
    try:
        kind = get(name)
    except NoTwinError as error:
        if ":" in name:
            raise
        told = str(error).partition("\n")[0]
        raise NoTwinError(
            f"{told} 'sb3-hds twins' lists what there is. One of your own is --twin module:Name, "
            "where module.py in this folder registers Name."
        ) from None
    return kind(**settings)


def _extended(path: str) -> "Twin":
    """The twin that a diagnosis has extended, from the file that ``--json`` wrote."""
    from sb3_hds.effects import ALL
    from sb3_hds.errors import NoTwinError
    from sb3_hds.twins import from_spec

    with open(path, encoding="utf-8") as file:
        text = file.read()
    try:
        return from_spec(json.loads(text)["twin"], ALL)
    except (json.JSONDecodeError, KeyError, TypeError) as error:
        raise NoTwinError(
            f"{path} holds no twin: it has to be what 'sb3-hds diagnose --json' wrote."
        ) from error


def _check_targets(given: argparse.Namespace) -> None:
    """What would fail after minutes fails now."""
    from sb3_hds.core.storage import check_target

    for target in filter(None, (given.report, given.json)):
        check_target(target)
    if given.report:
        from sb3_hds.sysid.report import check_installed

        check_installed()


def _policy_question(
    given: argparse.Namespace, twin: "Twin"
) -> "Callable[[Diagnosis], PolicyGain]":
    """How policies are compared, once there is a diagnosis; what makes no sense is refused now."""
    import gymnasium

    from sb3_hds.errors import ParameterError
    from sb3_hds.experiments import measure_policy_gain
    from sb3_hds.experiments.policy_gain import check_question

    arguments = _settings("--hyperparams", given.hyperparams)
    try:
        env = gymnasium.make(given.env, **_settings("--env-kwargs", given.env_kwargs))
    except (gymnasium.error.Error, TypeError) as error:
        raise ParameterError(f"{given.env} cannot be made: {error}") from None
    algorithm, size = _algorithm(given.algo), (given.policy_budget, given.policies, given.episodes)
    check_question(twin, env, algorithm, *size, arguments)
    return lambda found: measure_policy_gain(
        found,
        env,
        algorithm,
        budget=given.policy_budget,
        seeds=given.policies,
        n_episodes=given.episodes,
        progress=sys.stderr.isatty(),
        **arguments,
    )


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


def _settings(option: str, texts: Sequence[str]) -> dict[str, Any]:
    """Numbers, truth values and words, by name."""
    from sb3_hds.errors import ParameterError

    found: dict[str, Any] = {}
    for text in texts:
        name, colon, value = text.partition(":")
        if not (name and colon and value):
            raise ParameterError(f"{option} takes NAME:VALUE, got '{text}'.")
        found[name] = _value(value)
    return found


def _value(text: str) -> bool | int | float | str:
    if text.lower() in ("true", "false"):
        return text.lower() == "true"
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text


def _effects(given: argparse.Namespace) -> None:
    from sb3_hds.effects import ALL

    _show(
        ("effect", "acts on", "parameters", "what it is"),
        [
            (
                effect.name,
                effect.slot,
                ", ".join(map(_sized, effect.parameters.items())),
                effect.explanation + _FURTHER.get(effect.name, ""),
            )
            for effect in ALL
        ]
        + [("parameter.NAME", "twin", "its own [unit]", _OF_A_TWIN)],
    )
    print(
        "Units at joints are those of a rotary joint; for a slider, read N and m in place of N m "
        "and rad."
    )


def _sized(parameter: "tuple[str, Parameter]") -> str:
    name, known = parameter
    switch = (known.unit, known.null, known.upper) == ("1", 0.0, 1.0) and known.scale == 1.0
    return "on or off" if switch else f"{name} [{known.unit}]"


def _twins(given: argparse.Namespace) -> None:
    import inspect
    import re

    from sb3_hds.twins import make, names

    rows = []
    for name in names():
        twin = make(name)
        explained = (inspect.getdoc(type(twin)) or "").partition("\n\n")[0].replace("\n", " ")
        described = ", ".join(
            f"{key} {value:g} {twin.parameters[key].unit}" for key, value in twin.values.items()
        )
        options = " ".join(f"{key}:{value}" for key, value in twin.to_spec()["options"].items())
        rows.append(
            (
                f"{name}\n{twin.env_id or ''}".strip(),
                re.sub(r":\w+:`([^`]*)`", r"\1", explained),
                f"{described}\noptions: {options}",
            )
        )
    _show(("twin, environment", "what it is", "parameters and options, for --set"), rows)


def _show(columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Column, Table

    table = Table(*(Column(name, overflow="fold") for name in columns), show_lines=True)
    for row in rows:
        # Units in brackets are no markup.
        table.add_row(*(escape(str(cell)) for cell in row))
    Console(width=None if sys.stdout.isatty() else 120).print(table)


if __name__ == "__main__":
    sys.exit(main())
