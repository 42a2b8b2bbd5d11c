"""``sb3-hds columns``."""

import argparse


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
