"""Arguments, data, twins and output files of the commands on measured data."""

import argparse
import json
import sys
from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

from sb3_hds.cli import models
from sb3_hds.cli.arguments import settings
from sb3_hds.errors import NoTwinError, ParameterError, TrajectoryError

if TYPE_CHECKING:
    from sb3_hds.core import Trajectories, Twin

_SUFFIXES = (".xml", ".mjcf", ".urdf")
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
    models.add_options(command)


def add_set(command: argparse.ArgumentParser) -> None:
    """:param command: to which ``--set`` is added"""
    command.add_argument(
        "--set",
        nargs="*",
        default=[],
        metavar="NAME:VALUE",
        help="parameters and options of the twin: mass:0.3 observe:q driven:true",
    )


def twin_and_data(given: argparse.Namespace) -> "tuple[Twin, Trajectories]":
    """
    The twin that ``--twin`` or ``--model`` names, and the data.

    :raises ParameterError: for options of a model without one
    """
    if given.model is not None:
        return models.model_and_data(given, partial(data_of, given))
    models.refuse_options(given)
    twin, load = twin_of(given), partial(data_of, given)
    named = models.data_by_name(given, twin, load) if given.columns is None else None
    return twin, load(given.columns) if named is None else named


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


def twin_called(
    name: str, values: Mapping[str, Any], given: argparse.Namespace | None = None
) -> "Twin":
    """
    The twin of a name, a ``module:Name`` of the current folder too, or a file.

    :param given: the options of a model; None: none
    :raises ParameterError: for options of a model without one
    """
    from sb3_hds.twins import get

    if name.endswith(_SUFFIXES):
        return models.twin_of_model(name, values, given)
    if given is not None:
        models.refuse_options(given)
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
