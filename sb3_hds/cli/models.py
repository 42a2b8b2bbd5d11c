"""A robot's model file: its options, its twin, and the columns of its joints in a log."""

import argparse
import shlex
import warnings
from collections.abc import Callable, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

from sb3_hds.cli.arguments import names, positions, settings, with_options
from sb3_hds.errors import ModelFileError, ParameterError, TrajectoryError, first_names

if TYPE_CHECKING:
    from sb3_hds.core import Trajectories, Twin
    from sb3_hds.data.overview import ChannelCandidates
    from sb3_hds.twins.mujoco import Matching, MechanismTwin

#: settings of ``--set`` that are arguments of ``from_mujoco``; all others are parameters
_SETTINGS = ("dt", "integrator", "observe", "payload", "masses")
#: options of the command line for models only
OPTIONS = ("actuators", "ignore", "lock")
# Joints that move less [rad] or [m] stand still.
_STILL = 0.005
# Behind names of columns that are known to be commands.
_COMMAND = " command"
_SCALED = "a current: add the torque constant times the gear ratio [N m/A] as scale"


def add_options(command: argparse.ArgumentParser) -> None:
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


def refuse_options(given: argparse.Namespace) -> None:
    """:raises ParameterError: for options of a model, where there is none"""
    for option in OPTIONS:
        if getattr(given, option):
            raise ParameterError(
                f"--{option} is about a model file: name one, as in --model robot.urdf."
            )


def twin_of_model(
    path: str, values: Mapping[str, Any], given: argparse.Namespace | None = None
) -> "MechanismTwin":
    """
    :param path: of an MJCF or URDF file
    :param values: settings of ``--set``
    :param given: the options of a model; None: none
    """
    from sb3_hds.twins import from_mujoco

    own = {name: values[name] for name in _SETTINGS if name in values}
    changed = {
        name: float(value) if isinstance(value, int) else value
        for name, value in values.items()
        if name not in own
    }
    try:
        made: Any = from_mujoco(path, **own, **({} if given is None else _options(given)))
    except (ModelFileError, ParameterError) as error:
        raise type(error)(with_options(str(error), OPTIONS, _SETTINGS)) from error
    return made.with_parameters(**changed)


def model_and_data(
    given: argparse.Namespace, load: Callable[[Any], "Trajectories"]
) -> "tuple[MechanismTwin, Trajectories]":
    """
    The twin of ``--model``, at the interval of the data, and the data in the order of its signals.

    :param load: the data, with a map of columns
    :raises TrajectoryError: for signals of the twin that the log lacks by name, with the remedy
    """
    from sb3_hds.data.overview import channel_candidates

    own = settings("--set", given.set)
    make = partial(twin_of_model, given.model, given=given)
    files = given.data[0] if len(given.data) == 1 else given.data
    named = channel_candidates(files, given.columns)
    if named is None:
        data = load(given.columns)
        return make({"dt": data.dt} | own), data
    twin, found = _matched(make, own, named)
    data = _loaded(load, twin, found, named)
    return make({"dt": data.dt, "observe": twin.observed} | own), data


def data_by_name(
    given: argparse.Namespace, twin: "Twin", load: Callable[[Any], "Trajectories"]
) -> "Trajectories | None":
    """
    The data in the order of the signals of a robot's twin in a file of ``--json`` or ``--write``.

    :return: None for another twin, or data that need no map
    :raises TrajectoryError: for signals of the twin that the log lacks by name, with the remedy
    """
    from sb3_hds.core.twin import plant_of
    from sb3_hds.data.load import first_log
    from sb3_hds.data.overview import channel_candidates
    from sb3_hds.twins.mujoco import MechanismTwin, match

    plant = plant_of(twin)
    if not isinstance(plant, MechanismTwin):
        return None
    log = first_log(given.data, None)
    if log is None or (log.columns is not None and log.columns.obs is not None):
        return None
    named = channel_candidates(given.data)
    return named and _loaded(load, plant, match(plant, _names_in(named)), named)


def _loaded(
    load: Callable[[Any], "Trajectories"],
    twin: "MechanismTwin",
    found: "Matching",
    named: "ChannelCandidates",
) -> "Trajectories":
    """The data in the order of the signals, or the error that leads there."""
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
    data = load(named.chosen(map(str, found.obs), _commands(found, named)))
    for sentence in (*named.guessed, *found.remarks):
        print(sentence)
    _check_locked(load, twin, found, named)
    return data


def _check_locked(
    load: Callable[[Any], "Trajectories"],
    twin: "MechanismTwin",
    found: "Matching",
    named: "ChannelCandidates",
) -> None:
    """Warn of locked joints that are elsewhere in the log, or move."""
    import numpy as np

    pairs = zip(twin.mechanism.locked, found.locked, strict=True)
    known = {x: locked for locked, x in pairs if x is not None and len(locked[1]) == 1}
    if not known:
        return
    with warnings.catch_warnings():
        # Those of the same rows have been shown.
        warnings.simplefilter("ignore")
        data = load(named.chosen(known, []))
    seen = np.concatenate([data.episode(i)[0] for i in range(len(data))])
    for (name, (at,)), x in zip(known.values(), seen.T, strict=True):
        low, high, middle = x.min(), x.max(), np.median(x)
        remedy = f"stands at {middle:.3g} in the data: --lock {name}:{middle:.3g}"
        if high - low > _STILL:
            remedy = f"moves from {low:.3g} to {high:.3g} in the data"
        if max(high - low, abs(middle - at)) > _STILL:
            warnings.warn(f"{name} is locked at {at:g}, but {remedy}.", stacklevel=2)


def map_for_model(given: argparse.Namespace, path: str) -> str:
    """
    :param given: with the options of a model
    :param path: of the log
    :return: a map of the columns of the log, in the order of the twin of ``--model``
    """
    from sb3_hds.data.overview import channel_candidates

    make = partial(twin_of_model, given.model, given=given)
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

    columns, twin = _names_in(named), make(own)
    found = match(twin, columns)
    velocities = {c.name for c in twin.channels if c.name.endswith("_velocity")}
    unseen = bool(velocities) and velocities <= {name for name, _ in found.missing}
    if unseen and any(found.obs) and "observe" not in own:
        twin = make({**own, "observe": "q"})
        found = match(twin, columns)
    return twin, found


def _names_in(named: "ChannelCandidates") -> list[str]:
    """Names of entries, with a word behind those of commands."""
    commands = [f"{entry.name}{_COMMAND}" for entry in named.commanded]
    return [*(entry.name for entry in named.observed), *commands]


def _commands(found: "Matching", named: "ChannelCandidates") -> list[str]:
    """Names of entries for the actuators; empty where there is none."""
    suffix = _COMMAND if named.commanded else ""
    return [(name or "").removesuffix(suffix) for name in found.actions]


def _map_of(twin: "MechanismTwin", found: "Matching", named: "ChannelCandidates") -> str:
    """A map of columns for a twin: what was found by name, and guesses."""
    from sb3_hds.data.overview import Suggestion, suggested_map
    from sb3_hds.data.wording import listed
    from sb3_hds.twins.mujoco.names.words import is_current

    near = dict(found.missing)

    def line(name: str, column: str, missing: str, placed: str) -> Suggestion:
        if column:
            return Suggestion(name, column, _SCALED if is_current(column) else "")
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


def _options(given: argparse.Namespace) -> dict[str, Any]:
    found: dict[str, Any] = {"ignore": names(given.ignore), "lock": positions(given.lock)}
    if given.actuators:
        kind, *gains = given.actuators
        found["actuators"] = {"kind": kind, **settings("--actuators", gains)}
    return found
