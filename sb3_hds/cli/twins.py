"""``sb3-hds twins``: the catalogue of twins, and their checks."""

import argparse

from sb3_hds.cli import listing
from sb3_hds.cli.settings import settings


def add_arguments(command: argparse.ArgumentParser) -> None:
    """:param command: to which the arguments are added"""
    command.add_argument(
        "words",
        nargs="*",
        metavar="WORD",
        help="list only those that mention all of these; or 'check "
        "NAME', for one of your own 'check module:Name': is it finite, consistent, mechanical?",
    )
    command.add_argument(
        "--set",
        nargs="*",
        default=[],
        metavar="NAME:VALUE",
        help="parameters and options of the twin that is checked: mass:0.3 observe:q",
    )


def run(given: argparse.Namespace) -> int:
    """:return: 1 where a check failed, else 0"""
    from sb3_hds.errors import ParameterError

    if given.words[:1] != ["check"]:
        if given.set:
            raise ParameterError(
                "--set changes the twin that is checked: twins check NAME --set ..."
            )
        listing.twins(given.words)
        return 0
    if len(given.words) != 2:
        raise ParameterError(
            "Name one twin, as in 'sb3-hds twins check Pendulum' or 'sb3-hds twins check "
            f"my_module:MyTwin', got '{' '.join(given.words)}'."
        )
    from sb3_hds.cli.measured import twin_called
    from sb3_hds.twins import check

    found = check(twin_called(given.words[1], settings("--set", given.set)))
    print(found)
    return 0 if found.ok else 1
