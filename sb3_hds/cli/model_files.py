"""Twins from model files, and logs matched to them by the names of joints."""

import argparse
from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

from sb3_hds.cli.columns import loaded
from sb3_hds.cli.settings import names, settings

if TYPE_CHECKING:
    from sb3_hds.core import Trajectories
    from sb3_hds.twins.mujoco import MechanismTwin

SUFFIXES = (".xml", ".mjcf", ".urdf")
#: settings of ``--set`` that say how the twin is made; all others are parameters
_OPTIONS = ("dt", "integrator", "observe", "payload", "masses")


def add_arguments(command: argparse.ArgumentParser) -> None:
    """:param command: to which ``--actuators`` and ``--ignore`` are added, beside ``--model``"""
    command.add_argument(
        "--actuators",
        nargs="+",
        metavar="KIND|NAME:VALUE",
        help="of a model that names none, as a URDF: torque (the default), or 'position kp:20 "
        "kv:1.5', 'velocity kv:5', whose commands are targets",
    )
    command.add_argument(
        "--ignore",
        nargs="*",
        default=[],
        metavar="NAME",
        help="what the twin of a model may do without: contacts, equality, fluid, limits, tendons",
    )


def twin_of_model(path: str, given: Mapping[str, Any], words: Mapping[str, Any]) -> "MechanismTwin":
    """
    :param path: of an MJCF or URDF file
    :param given: settings of ``--set``
    :param words: ``actuators`` and ``ignore``
    """
    from sb3_hds.twins import from_mujoco

    options = {name: given[name] for name in _OPTIONS if name in given}
    values = {
        name: float(value) if isinstance(value, int) else value
        for name, value in given.items()
        if name not in options
    }
    return from_mujoco(path, **options, **words).with_parameters(**values)


def question(given: argparse.Namespace) -> "tuple[MechanismTwin, Trajectories]":
    """
    The twin that ``--model`` names, at the interval of the data, and the data in its order.

    :raises TrajectoryError: for signals of the twin that the log does not have by name
    """
    from sb3_hds.data.overview import names_in

    own = settings("--set", given.set)
    make = partial(twin_of_model, given.model, words=_words(given))
    files = given.data[0] if len(given.data) == 1 else given.data
    named = names_in(files, given.columns)
    if named is None:
        data = loaded(given, given.columns)
        return make({"dt": data.dt} | own), data
    observed = [entry.name for entry in named.observed]
    commanded = [entry.name for entry in named.commanded]
    observe, found = _matched(make, own, observed, commanded)
    suffix = " command" if commanded else ""
    columns = named.chosen(
        map(str, found.obs), (str(name).removesuffix(suffix) for name in found.actions)
    )
    data = loaded(given, columns)
    for sentence in named.guessed:
        print(sentence)
    return make({"dt": data.dt} | observe | own), data


def _matched(
    make: Any, own: Mapping[str, Any], observed: list[str], commanded: list[str]
) -> tuple[dict[str, Any], Any]:
    """Velocities that a log does not have are not observed, unless ``--set`` says so."""
    from sb3_hds.errors import TrajectoryError
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


def _words(given: argparse.Namespace) -> dict[str, Any]:
    found: dict[str, Any] = {"ignore": names(given.ignore)}
    if given.actuators:
        kind, *gains = given.actuators
        found["actuators"] = {"kind": kind, **settings("--actuators", gains)}
    return found
