"""Arguments, data, twins and output files of the commands on measured data."""

import argparse
import json
import shlex
import sys
from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

from sb3_hds.cli.arguments import names, positions, settings, with_options
from sb3_hds.errors import (
    ModelFileError,
    NoTwinError,
    ParameterError,
    TrajectoryError,
    first_names,
)

if TYPE_CHECKING:
    from sb3_hds.core import Trajectories, Twin
    from sb3_hds.data.overview import ChannelCandidates
    from sb3_hds.twins.mujoco import Matching, MechanismTwin

_SUFFIXES = (".xml", ".mjcf", ".urdf")
#: settings of ``--set`` that are arguments of ``from_mujoco``; all others are parameters
_OPTIONS = ("dt", "integrator", "observe", "payload", "masses")
#: options of the command line for models only
MODEL_OPTIONS = ("actuators", "ignore", "lock")
# Behind names of columns that are known to be commands.
_COMMAND = " command"
_COLUMNS = """Say what the columns mean in a yml file, --columns map.yml:

    time: NAME                               # or {column: NAME, unit: ms}, or dt: SECONDS
    obs: [NAME, {column: NAME, unit: deg}]   # in the order of 'sb3-hds twins'
    actions: [NAME]

'sb3-hds columns FILE' prints what is in a log, and such a map to start from."""


def add_arguments(command: argparse.ArgumentParser, *, twin_required: bool = True) -> None:
    """
    :param command: to which ``--twin`` or ``--model``, ``--data``, ``--columns``, ``--correct`` and
        ``--set`` are added, and the options of models
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
    add_set(command)
    add_model_options(command)


def add_set(command: argparse.ArgumentParser) -> None:
    """:param command: to which ``--set`` is added"""
    command.add_argument(
        "--set",
        nargs="*",
        default=[],
        metavar="NAME:VALUE",
        help="parameters and options of the twin: mass:0.3 observe:q driven:true",
    )


def add_model_options(command: argparse.ArgumentParser) -> None:
    """:param command: to which ``--actuators``, ``--ignore`` and ``--lock`` are added"""
    command.add_argument(
        "--actuators",
        nargs="+",
        default=[],
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
    command.add_argument(
        "--lock",
        nargs="*",
        default=[],
        metavar="JOINT[:POSITION]",
        help="joints of a model that stand still, such as a gripper's, or quoted patterns: "
        "'*_finger_*', at the reference position or at another one [rad] or [m]: finger:0.02",
    )


def twin_and_data(given: argparse.Namespace) -> "tuple[Twin, Trajectories]":
    """
    The twin that ``--twin`` or ``--model`` names, and the data.

    :raises ParameterError: for options of a model without one
    """
    if given.model is not None:
        return _model_and_data(given)
    refuse_model_options(given)
    return twin_of(given), data_of(given, given.columns)


def refuse_model_options(given: argparse.Namespace) -> None:
    """:raises ParameterError: for options of a model, where there is none"""
    for option in MODEL_OPTIONS:
        if getattr(given, option):
            raise ParameterError(f"--{option} is about a model file: name one with --model.")


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


def twin_called(name: str, values: Mapping[str, Any], model_options: Any = None) -> "Twin":
    """
    The twin of a name, a ``module:Name`` of the current folder too, or a file.

    :param model_options: parsed options of a model
    """
    from sb3_hds.twins import get

    if name.endswith(_SUFFIXES):
        options = {} if model_options is None else _model_options(model_options)
        return _twin_of_model(name, values, options)
    if model_options is not None:
        refuse_model_options(model_options)
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
    :param model_options: ``actuators``, ``ignore`` and ``lock``
    """
    from sb3_hds.twins import from_mujoco

    options = {name: given[name] for name in _OPTIONS if name in given}
    values = {
        name: float(value) if isinstance(value, int) else value
        for name, value in given.items()
        if name not in options
    }
    try:
        made: Any = from_mujoco(path, **options, **model_options)
    except (ModelFileError, ParameterError) as error:
        raise type(error)(with_options(str(error), MODEL_OPTIONS, _OPTIONS)) from error
    return made.with_parameters(**values)


def _model_and_data(given: argparse.Namespace) -> "tuple[MechanismTwin, Trajectories]":
    """
    The twin of ``--model``, at the interval of the data, and the data in the order of its signals.

    :raises TrajectoryError: for signals of the twin that the log lacks by name, with the remedy
    """
    from sb3_hds.data.overview import channel_candidates

    own = settings("--set", given.set)
    make = partial(_twin_of_model, given.model, model_options=_model_options(given))
    files = given.data[0] if len(given.data) == 1 else given.data
    named = channel_candidates(files, given.columns)
    if named is None:
        data = data_of(given, given.columns)
        return make({"dt": data.dt} | own), data
    twin, found = _matched(make, own, named)
    if found.without:
        raise TrajectoryError(
            f"The log has no columns of {', '.join(found.without)}. If they stand still in the "
            f"data, {_locking(found)}. Otherwise name their columns in the map that 'sb3-hds "
            "columns FILE --model MODEL' prints."
        )
    if found.missing:
        raise TrajectoryError(
            f"No column of the log has the name of {first_names([x for x, _ in found.missing])}. "
            "Correct this map, in which NAME stands for a column that was not found (velocities "
            f"may be left out), and pass it with --columns:\n\n{_map_of(twin, found, named)}"
        )
    data = data_of(given, named.chosen(found.obs, _commands(found, named)))
    for sentence in (*named.guessed, *filter(None, [found.renamed])):
        print(sentence)
    return make({"dt": data.dt, "observe": twin.observed} | own), data


def map_for_model(given: argparse.Namespace, path: str) -> str:
    """
    :param given: with the options of a model
    :param path: of the log
    :return: a map of the columns of the log, in the order of the twin of ``--model``
    """
    from sb3_hds.data.overview import channel_candidates

    make = partial(_twin_of_model, given.model, model_options=_model_options(given))
    named = channel_candidates(path, {"records": given.records, "skip": given.skip})
    if named is None:
        raise TrajectoryError(f"'{path}' was written by Trajectories.save: it has no names.")
    twin, found = _matched(make, settings("--set", given.set), named)
    return "\n".join([*(f"# {x}" for x in [found.renamed] if x), _map_of(twin, found, named)])


def _matched(
    make: Any, own: Mapping[str, Any], named: "ChannelCandidates"
) -> "tuple[MechanismTwin, Matching]":
    """Match the log to the twin; without velocities in it, only positions are observed."""
    from sb3_hds.twins.mujoco import match

    columns = [entry.name for entry in named.observed]
    columns += [f"{entry.name}{_COMMAND}" for entry in named.commanded]
    twin = make(own)
    found = match(twin, columns)
    velocities = {c.name for c in twin.channels if c.name.endswith("_velocity")}
    unseen = bool(velocities) and velocities <= {name for name, _ in found.missing}
    if unseen and any(found.obs) and "observe" not in own:
        twin = make({**own, "observe": "q"})
        found = match(twin, columns)
    return twin, found


def _commands(found: "Matching", named: "ChannelCandidates") -> list[str]:
    """Names of entries for the actuators; empty where there is none."""
    suffix = _COMMAND if named.commanded else ""
    return [(name or "").removesuffix(suffix) for name in found.actions]


def _map_of(twin: "MechanismTwin", found: "Matching", named: "ChannelCandidates") -> str:
    """A map of columns for a twin: what was found by name, and guesses."""
    from sb3_hds.data.overview import Suggestion, suggested_map
    from sb3_hds.data.wording import listed

    near = dict(found.missing)

    def line(name: str, column: str, missing: str, placed: str) -> Suggestion:
        if column:
            return Suggestion(name, column)
        options = [option.removesuffix(_COMMAND) for option in near.get(missing, ())]
        if len(options) == 1:
            return Suggestion(name, options[0], "a guess")
        words = f"{' or '.join(options)}?" if options else "by its place" if placed else ""
        return Suggestion(name, "" if options else placed, words)

    sizes = len(named.observed), len(named.commanded)
    in_order = sizes == (len(twin.channels), len(twin.actuators)) and not any(found.obs)
    at = [entry.name for entry in (*named.observed, *named.commanded)] if in_order else []
    at += [""] * (len(twin.channels) + len(twin.actuators) - len(at))
    channels = zip(twin.channels, found.obs, at, strict=False)
    actuators = zip(twin.actuators, _commands(found, named), at[len(twin.channels) :], strict=True)
    text = suggested_map(
        named,
        [line(c.name, column or "", c.name, place) for c, column, place in channels],
        [line(a.name, column, f"{a.name} (command)", place) for a, column, place in actuators],
    )
    unused = [name.removesuffix(_COMMAND) for name in (() if in_order else found.unused)]
    others = [name for name in unused if name not in named.rest.wanted]
    lines = [f"# other columns: {listed(others)}"] if others else []
    if found.without:
        lines.append(f"# Joints without columns: if they stand still, {_locking(found)}")
    return "\n".join([text, *lines])


def _locking(found: "Matching") -> str:
    return f"pass --lock {' '.join(map(shlex.quote, found.without))}"


def _model_options(given: argparse.Namespace) -> dict[str, Any]:
    found: dict[str, Any] = {"ignore": names(given.ignore), "lock": positions(given.lock)}
    if given.actuators:
        kind, *gains = given.actuators
        found["actuators"] = {"kind": kind, **settings("--actuators", gains)}
    return found
