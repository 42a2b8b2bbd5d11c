"""Arguments, data, twins and output files of the commands on measured data."""

import argparse
import json
import sys
from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

from sb3_hds.cli.arguments import names, settings
from sb3_hds.errors import NoTwinError, ParameterError, TrajectoryError

if TYPE_CHECKING:
    from sb3_hds.core import Trajectories, Twin
    from sb3_hds.twins.mujoco import MechanismTwin

_SUFFIXES = (".xml", ".mjcf", ".urdf")
#: settings of ``--set`` that are arguments of ``from_mujoco``; all others are parameters
_OPTIONS = ("dt", "integrator", "observe", "payload", "masses")
_COLUMNS = """Say what the columns mean in a yml file, --columns map.yml:

    time: NAME                               # or {column: NAME, unit: ms}, or dt: SECONDS
    obs: [NAME, {column: NAME, unit: deg}]   # in the order of 'sb3-hds twins'
    actions: [NAME]

'sb3-hds columns FILE' prints what is in a log, and such a map to start from."""


def add_arguments(command: argparse.ArgumentParser, *, twin_required: bool = True) -> None:
    """
    :param command: to which ``--twin`` or ``--model``, ``--data``, ``--columns``, ``--correct`` and
        ``--set`` are added, and for models ``--actuators`` and ``--ignore``
    :param twin_required: whether the command needs a twin
    """
    either = command.add_mutually_exclusive_group(required=twin_required)
    either.add_argument(
        "--twin",
        help="name or environment id, see 'sb3-hds twins'; module:Name for one of your own; or a "
        "file that --json or --write wrote, for the extended or calibrated twin in it",
    )
    either.add_argument(
        "--model",
        metavar="FILE",
        help="MJCF or URDF file of a robot, simulated at the interval of the data; columns of the "
        "log are matched to its joints by name",
    )
    command.add_argument("--data", required=True, nargs="+", help="files, or patterns in quotes")
    command.add_argument("--columns", help="yml file with the meaning of a log's columns")
    command.add_argument(
        "--correct", action="store_true", help="cut and shift the data as their audit proposes"
    )
    command.add_argument(
        "--set",
        nargs="*",
        default=[],
        metavar="NAME:VALUE",
        help="parameters and options of the twin: mass:0.3 observe:q driven:true",
    )
    command.add_argument(
        "--actuators",
        nargs="+",
        metavar="KIND|NAME:VALUE",
        help="actuators of a model without any, such as a URDF: torque (default), or servos whose "
        "commands are targets: 'position kp:20 kv:1.5', 'velocity kv:5'",
    )
    command.add_argument(
        "--ignore",
        nargs="*",
        default=[],
        metavar="NAME",
        help="features of a model to leave out: contacts, equality, fluid, limits, tendons",
    )


def twin_and_data(given: argparse.Namespace) -> "tuple[Twin, Trajectories]":
    """
    The twin that ``--twin`` or ``--model`` names, and the data.

    :raises ParameterError: for options of a model without one
    """
    if given.model is not None:
        return _model_and_data(given)
    for option in ("actuators", "ignore"):
        if getattr(given, option):
            raise ParameterError(f"--{option} is about a model file: name one with --model.")
    return twin_of(given), data_of(given, given.columns)


def data_of(given: argparse.Namespace, columns: Any) -> "Trajectories":
    """Load ``--data``; errors in the map of columns show its yml form."""
    from sb3_hds.data import Trajectories
    from sb3_hds.data.columns import FORM
    from sb3_hds.data.load import WITHOUT_COLUMNS

    files = given.data[0] if len(given.data) == 1 else given.data
    try:
        return Trajectories.load(files, columns=columns)
    except TrajectoryError as error:
        message = str(error)
        for python in (FORM, WITHOUT_COLUMNS):
            if python in message:
                message = message.replace(python, _COLUMNS)
        raise TrajectoryError(message) from error


def twin_of(given: argparse.Namespace) -> "Twin":
    """The twin of ``--twin``, with the settings of ``--set``."""
    return twin_called(given.twin, settings("--set", given.set))


def twin_called(name: str, values: Mapping[str, Any]) -> "Twin":
    """The twin of a name, a ``module:Name`` of the current folder too, or a file."""
    from sb3_hds.twins import get

    if name.endswith(_SUFFIXES):
        return _twin_of_model(name, values, {})
    if name.endswith(".json"):
        return _twin_in(name).with_parameters(**values)
    if ":" in name and "" not in sys.path:
        sys.path.insert(0, "")
    try:
        kind = get(name)
    except NoTwinError as error:
        if ":" in name:
            raise
        message = str(error).partition("\n")[0]
        raise NoTwinError(
            f"{message} 'sb3-hds twins' lists all. For one of your own, pass --twin "
            "module:Name, where module.py in this folder registers Name."
        ) from None
    return kind(**values)


def _twin_in(path: str) -> "Twin":
    """Read the twin in a file that ``--json`` or ``--write`` wrote."""
    from sb3_hds.effects import ALL
    from sb3_hds.twins import from_spec

    with open(path, encoding="utf-8") as file:
        text = file.read()
    try:
        return from_spec(json.loads(text)["twin"], ALL)
    except (json.JSONDecodeError, KeyError, TypeError) as error:
        raise NoTwinError(
            f"{path} holds no twin: it has to be what 'sb3-hds diagnose --json' or 'sb3-hds "
            "calibrate --write' wrote."
        ) from error


def add_write(command: argparse.ArgumentParser) -> None:
    """:param command: to which ``--write`` is added"""
    command.add_argument(
        "--write",
        help="file to write the corrected twin to: .json for --twin; for --model, the corrected "
        "model as .xml (MJCF), or as .urdf if it is one",
    )


def check_targets(given: argparse.Namespace) -> None:
    """
    Fail before the work: check the files of ``--json`` and ``--write``.

    :raises ParameterError: for a model file to write where none was read
    """
    from sb3_hds.core.trajectories.storage import check_target

    write = getattr(given, "write", None)
    for target in filter(None, (given.json, write)):
        check_target(target)
    if write and write.endswith(_SUFFIXES) and given.model is None:
        raise ParameterError(
            f"{write} would be a corrected model file: name the file with --model. A twin "
            "without one is written as .json."
        )


def write_twin(given: argparse.Namespace, twin: "Twin") -> None:
    """Write the file of ``--write``, if given."""
    if not given.write:
        return
    if not given.write.endswith(_SUFFIXES):
        write_json(given.write, {"twin": twin.to_spec()})
        return
    from sb3_hds.twins import write_model

    print(write_model(twin, given.write, given.model))


def write_json(path: str, plain: Mapping[str, Any]) -> None:
    """:param plain: finite numbers only"""
    from sb3_hds.core.trajectories.storage import write_bytes

    write_bytes(path, (json.dumps(plain, indent=1, allow_nan=False) + "\n").encode())


def _twin_of_model(
    path: str, given: Mapping[str, Any], model_options: Mapping[str, Any]
) -> "MechanismTwin":
    """
    :param path: of an MJCF or URDF file
    :param given: settings of ``--set``
    :param model_options: ``actuators`` and ``ignore``
    """
    from sb3_hds.twins import from_mujoco

    options = {name: given[name] for name in _OPTIONS if name in given}
    values = {
        name: float(value) if isinstance(value, int) else value
        for name, value in given.items()
        if name not in options
    }
    made: Any = from_mujoco(path, **options, **model_options)
    return made.with_parameters(**values)


def _model_and_data(given: argparse.Namespace) -> "tuple[MechanismTwin, Trajectories]":
    """
    The twin of ``--model``, at the interval of the data, and the data in the order of its signals.

    :raises TrajectoryError: for signals of the twin that the log lacks by name
    """
    from sb3_hds.data.overview import channel_candidates

    own = settings("--set", given.set)
    make = partial(_twin_of_model, given.model, model_options=_model_options(given))
    files = given.data[0] if len(given.data) == 1 else given.data
    named = channel_candidates(files, given.columns)
    if named is None:
        data = data_of(given, given.columns)
        return make({"dt": data.dt} | own), data
    observed = [entry.name for entry in named.observed]
    commanded = [entry.name for entry in named.commanded]
    observe, found = _matched(make, own, observed, commanded)
    suffix = " command" if commanded else ""
    columns = named.chosen(
        map(str, found.obs), (str(name).removesuffix(suffix) for name in found.actions)
    )
    data = data_of(given, columns)
    for sentence in named.guessed:
        print(sentence)
    return make({"dt": data.dt} | observe | own), data


def _matched(
    make: Any, own: Mapping[str, Any], observed: list[str], commanded: list[str]
) -> tuple[dict[str, Any], Any]:
    """Match the log to the twin; without velocities in it, only positions are observed."""
    from sb3_hds.twins.mujoco import match

    columns = [*observed, *(f"{name} command" for name in commanded)]
    twin = make(own)
    found = match(twin, columns)
    observe: dict[str, Any] = {}
    lacking = [name for name, _ in found.missing]
    if lacking and all(name.endswith("_velocity") for name in lacking) and "observe" not in own:
        observe = {"observe": "q"}
        found = match(make({**own, **observe}), columns)
    try:
        found.check()
    except TrajectoryError as error:
        raise TrajectoryError(
            f"{error} In the map of columns, give each the name of its joint: obs: [{{column: "
            f"NAME, name: {twin.channels[0].name}}}, ...], actions: [{{column: NAME, name: "
            f"{twin.actuators[0].name if twin.actuators else 'NAME'}}}, ...]."
        ) from None
    return observe, found


def _model_options(given: argparse.Namespace) -> dict[str, Any]:
    found: dict[str, Any] = {"ignore": names(given.ignore)}
    if given.actuators:
        kind, *gains = given.actuators
        found["actuators"] = {"kind": kind, **settings("--actuators", gains)}
    return found
