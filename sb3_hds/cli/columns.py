"""``sb3-hds columns``, and logs read under the map that it prints."""

import argparse
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sb3_hds.core import Trajectories

_COLUMNS = """Say what the columns mean in a yml file, --columns map.yml:

    time: NAME                               # or {column: NAME, unit: ms}, or dt: SECONDS
    obs: [NAME, {column: NAME, unit: deg}]   # in the order of 'sb3-hds twins'
    actions: [NAME]

'sb3-hds columns FILE' prints what is in a log, and such a map to start from."""


def add_arguments(ask: argparse.ArgumentParser) -> None:
    """:param ask: to which the arguments are added"""
    ask.add_argument("file", metavar="FILE", help="a log of any format, or a folder with a bag")
    ask.add_argument("--records", help="where the rows are in a file that nests them: data")
    ask.add_argument("--skip", type=int, help="lines of a text file before its names")


def run(given: argparse.Namespace) -> None:
    """Print valid yml: ``sb3-hds columns log.csv > map.yml``."""
    from pathlib import Path

    from sb3_hds.data.overview import describe

    print(describe(Path(given.file).expanduser(), given.records, given.skip))


def loaded(given: argparse.Namespace, columns: Any) -> "Trajectories":
    """The data of ``--data``; errors in the map of columns are explained in yml."""
    from sb3_hds.data import Trajectories
    from sb3_hds.data.columns import FORM
    from sb3_hds.data.load import WITHOUT_COLUMNS
    from sb3_hds.errors import TrajectoryError

    files: str | Sequence[str] = given.data[0] if len(given.data) == 1 else given.data
    try:
        return Trajectories.load(files, columns=columns)
    except TrajectoryError as error:
        message = str(error)
        for python in (FORM, WITHOUT_COLUMNS):
            if python in message:
                message = message.replace(python, _COLUMNS)
        raise TrajectoryError(message) from error
