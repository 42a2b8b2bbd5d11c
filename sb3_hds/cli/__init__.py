"""
``sb3-hds``: diagnosis of a simulation and robustness of a policy, from the command line.

    sb3-hds diagnose --twin PendulumReal --data 'logs/*.csv' --columns map.yml --report out.html
    sb3-hds diagnose --twin my_module:MyTwin --data 'logs/*.csv' --columns map.yml
    sb3-hds diagnose --twin LinearAxis --set observe:q mass:95 --data log.mat --columns map.yml
    sb3-hds diagnose --model ur10.urdf --data bag.db3 --write corrected.xml
    sb3-hds columns log.csv > map.yml
    sb3-hds audit --data 'logs/*.csv' --columns map.yml
    sb3-hds calibrate --twin LinearAxis --data log.mat --columns map.yml --write axis.json
    sb3-hds robustness --algo openloop --model model.zip --env Swimmer-v5
    sb3-hds export model.zip policy.onnx --c policy.h
    sb3-hds run policy.onnx --env Pendulum-v1 --rate 20
    sb3-hds study run study.yml
    sb3-hds effects friction
    sb3-hds twins
    sb3-hds twins check my_module:MyTwin
"""

import argparse
import os
import signal
import sys
import warnings
from collections.abc import Sequence
from typing import Any

_INTERRUPTED = "sb3-hds: interrupted"


def main(arguments: Sequence[str] | None = None) -> int:
    """
    :param arguments: of the command line; default: ``sys.argv[1:]``
    :return: 0 on any verdict; 1 for invalid input, with a message of one line, or if a twin
        fails its check; 130 when interrupted
    :raises SystemExit: with 2, for an unknown command or option
    """
    if arguments is None:
        signal.signal(signal.SIGINT, _stop)
    try:
        return _run(parser().parse_args(arguments))
    except KeyboardInterrupt:
        print(_INTERRUPTED, file=sys.stderr)
        return 130


def _stop(*_: Any) -> None:
    """Exit at once: JAX callbacks swallow exceptions, and one raised during an import breaks it."""
    for stream in (sys.stdout, sys.stderr):
        # A progress bar may have hidden the cursor.
        print("\x1b[?25h" if stream.isatty() else "", end="", file=stream, flush=True)
    print(_INTERRUPTED, file=sys.stderr, flush=True)
    os._exit(130)


def _run(given: argparse.Namespace) -> int:
    from sb3_hds.errors import SB3HDSError

    try:
        with warnings.catch_warnings():
            warnings.showwarning = _warn
            # They address programmers, not users.
            warnings.simplefilter("ignore", DeprecationWarning)
            return given.run(given) or 0
    except BrokenPipeError:
        return 0
    except (SB3HDSError, OSError, ImportError) as error:
        print(f"sb3-hds: {error}", file=sys.stderr)
        return 1


def _warn(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    file: Any = None,
    line: str | None = None,
) -> None:
    """Print a warning as one line, without the source line that raised it."""
    print(f"warning: {' '.join(str(message).split())}", file=sys.stderr)


def parser() -> argparse.ArgumentParser:
    """:return: the parser of ``sb3-hds`` and its commands"""
    from sb3_hds.cli import calibrate, catalogue, deployment, diagnose, logs, study
    from sb3_hds.cli.arguments import Parser, Version

    top = Parser(
        prog="sb3-hds",
        description="Diagnose a simulation with measured data; test how robust a policy is.",
    )
    top.add_argument("--version", action=Version)
    commands = top.add_subparsers(dest="command", required=True, metavar="command")
    for name, add, explained in (
        ("diagnose", diagnose.add_arguments, "name the cause, from measured data"),
        ("audit", logs.add_audit, "find defects in measured data"),
        ("calibrate", calibrate.add_arguments, "estimate parameters of a twin from measured data"),
        ("robustness", deployment.add_robustness, "return under noise, failed sensors and pushes"),
        ("columns", logs.add_columns, "list the signals of a log, with a map to start from"),
        ("export", deployment.add_export, "export a policy as an ONNX file or a C header"),
        ("run", deployment.add_run, "run an exported policy in real time and record it"),
        ("study", study.add_arguments, "run algorithms on environments over seeds, and report"),
        ("effects", catalogue.add_effects, "list the candidate effects, with units"),
        ("twins", catalogue.add_twins, "list the twins with their parameters, or check one"),
    ):
        add(commands.add_parser(name, help=explained))
    return top
