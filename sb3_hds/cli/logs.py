"""``sb3-hds columns`` and ``sb3-hds audit``: what a log holds, and its defects."""

import argparse
from pathlib import Path
from typing import Any

from sb3_hds.cli import measured, models
from sb3_hds.errors import ParameterError


def add_columns(command: argparse.ArgumentParser) -> None:
    """:param command: ``sb3-hds columns``"""
    command.add_argument("file", metavar="FILE", help="a log of any format, or a folder with a bag")
    command.add_argument("--records", help="key of the rows in a nested file: data")
    command.add_argument("--skip", type=int, help="lines of a text file before its header")
    command.add_argument(
        "--model",
        metavar="MODEL",
        help="MJCF or URDF file of a robot, for whose joints the map is; with --lock and the like",
    )
    measured.add_set(command)
    models.add_options(command)
    command.set_defaults(run=run_columns)


def run_columns(given: argparse.Namespace) -> None:
    """Print a map of columns as valid yml: ``sb3-hds columns log.csv > map.yml``."""
    from sb3_hds.data.overview import describe

    if given.model is None:
        models.refuse_options(given)
    path = Path(given.file).expanduser()
    suggested = None if given.model is None else models.map_for_model(given, str(path))
    print(describe(path, given.records, given.skip, suggested))


def add_audit(command: argparse.ArgumentParser) -> None:
    """:param command: ``sb3-hds audit``"""
    measured.add_arguments(command, twin_required=False)
    command.add_argument("--json", help="JSON file to write")
    command.set_defaults(run=run_audit)


def run_audit(given: argparse.Namespace) -> None:
    """Report the clock and the defects of the data, before and after corrections."""
    from sb3_hds.data import audit

    measured.check_targets(given)
    without_twin = given.twin is None and given.model is None
    if given.set and without_twin:
        raise ParameterError("--set changes the twin: name one with --twin, or --model.")
    twin, data = (
        (None, measured.data_of(given, given.columns))
        if without_twin
        else measured.twin_and_data(given)
    )
    plain: dict[str, Any] = {}
    if data.report is not None:
        plain["reading"] = data.report.to_dict()
        print(f"{data.report}\n")
    found = audit(data, twin=twin)
    print(found)
    plain |= found.to_dict()
    if given.correct:
        plain["corrections"] = list(found.corrections)
        print("\n" + ("\n".join(found.corrections) or "There is nothing to correct."))
    if given.correct and found.corrections:
        corrected = audit(found.corrected(data), twin=twin)
        plain["corrected"] = corrected.to_dict()
        print(f"\n{corrected}")
    if given.json:
        measured.write_json(given.json, plain)
