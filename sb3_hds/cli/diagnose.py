"""``sb3-hds diagnose``."""

import argparse
import dataclasses
import json
import sys
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from sb3_hds.cli.classes import algorithm
from sb3_hds.cli.settings import names, settings

if TYPE_CHECKING:
    from sb3_hds.core import Trajectories, Twin
    from sb3_hds.experiments import PolicyGain
    from sb3_hds.sysid import Diagnosis

_COLUMNS = """Say what the columns mean in a yml file, --columns map.yml:

    time: NAME                               # or {column: NAME, unit: ms}, or dt: SECONDS
    obs: [NAME, {column: NAME, unit: deg}]   # in the order of 'sb3-hds twins'
    actions: [NAME]

'sb3-hds columns FILE' prints what is in a log, and such a map to start from."""


def run(given: argparse.Namespace) -> None:
    """Load, diagnose, and tell: on the screen, as a page, as JSON."""
    from sb3_hds.core.storage import write_bytes
    from sb3_hds.data import audit
    from sb3_hds.effects import ALL
    from sb3_hds.sysid import diagnose

    _check_targets(given)
    twin = _twin(given.twin, settings("--set", given.set))
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
        effects=ALL if given.effects is None else names(given.effects),
        calibrate=names(given.calibrate),
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


def _twin(name: str, given: dict[str, Any]) -> "Twin":
    """A module that registers it, or the file of a diagnosis, may lie in the current folder."""
    from sb3_hds.errors import NoTwinError
    from sb3_hds.twins import get

    if name.endswith(".json"):
        return _extended(name).with_parameters(**given)
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
    return kind(**given)


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

    arguments = settings("--hyperparams", given.hyperparams)
    try:
        env = gymnasium.make(given.env, **settings("--env-kwargs", given.env_kwargs))
    except (gymnasium.error.Error, TypeError) as error:
        raise ParameterError(f"{given.env} cannot be made: {error}") from None
    learner, size = algorithm(given.algo), (given.policy_budget, given.policies, given.episodes)
    check_question(twin, env, learner, *size, arguments)
    return lambda found: measure_policy_gain(
        found,
        env,
        learner,
        budget=given.policy_budget,
        seeds=given.policies,
        n_episodes=given.episodes,
        progress=sys.stderr.isatty(),
        **arguments,
    )
