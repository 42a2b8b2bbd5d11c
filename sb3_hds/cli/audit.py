"""``sb3-hds audit``."""

import argparse
from typing import Any

from sb3_hds.cli import measured


def add_arguments(command: argparse.ArgumentParser) -> None:
    """:param command: that is to understand them"""
    measured.add_arguments(command, twin_required=False)
    command.add_argument("--json", help="JSON file to write")


def run(given: argparse.Namespace) -> None:
    """Report the clock and the defects of the data, before and after corrections."""
    from sb3_hds.core.trajectories.storage import check_target
    from sb3_hds.data import audit
    from sb3_hds.errors import ParameterError

    if given.json:
        check_target(given.json)
    alone = given.twin is None and given.model is None
    if given.set and alone:
        raise ParameterError("--set changes the twin: name one with --twin, or --model.")
    twin, data = (None, measured.data_of(given)) if alone else measured.question(given)
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
        better = audit(found.corrected(data), twin=twin)
        plain["corrected"] = better.to_dict()
        print(f"\n{better}")
    if given.json:
        measured.write_json(given.json, plain)
