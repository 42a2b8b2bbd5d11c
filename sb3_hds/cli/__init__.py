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
    :param arguments: as on the command line; default: those of this process
    :return: 0 on any verdict; 1 for invalid input, with one line on why, or where a twin fails its
        check; 130 when interrupted
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
    """End at once: an exception gets lost in a callback of JAX, and breaks the import of one."""
    for stream in (sys.stdout, sys.stderr):
        # A progress bar has hidden the cursor.
        print("\x1b[?25h" if stream.isatty() else "", end="", file=stream, flush=True)
    print(_INTERRUPTED, file=sys.stderr, flush=True)
    os._exit(130)


def _run(given: argparse.Namespace) -> int:
    from sb3_hds.cli import (
        audit,
        calibrate,
        columns,
        diagnose,
        export,
        listing,
        robustness,
        study,
        twins,
    )
    from sb3_hds.cli import run as run_file
    from sb3_hds.errors import SB3HDSError

    try:
        with warnings.catch_warnings():
            warnings.showwarning = _warn
            # Meant for programmers.
            warnings.simplefilter("ignore", DeprecationWarning)
            code = {
                "columns": columns.run,
                "audit": audit.run,
                "calibrate": calibrate.run,
                "diagnose": diagnose.run,
                "export": export.run,
                "robustness": robustness.run,
                "run": run_file.run,
                "study": study.run,
                "effects": listing.run_effects,
                "twins": twins.run,
            }[given.command](given)
            return code or 0
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
    """One line, without the code that warns."""
    print(f"warning: {' '.join(str(message).split())}", file=sys.stderr)


def parser() -> argparse.ArgumentParser:
    """:return: what the command understands"""
    from sb3_hds.cli import audit, calibrate, columns, export, measured, study, twins
    from sb3_hds.cli import run as run_file
    from sb3_hds.cli.parsing import Parser, Version

    every = Parser(
        prog="sb3-hds",
        description="Diagnose a simulation with measured data; test how robust a policy is.",
    )
    every.add_argument("--version", action=Version)
    commands = every.add_subparsers(dest="command", required=True, metavar="command")
    ask = commands.add_parser("diagnose", help="name the cause, from measured data")
    measured.add_arguments(ask)
    ask.add_argument(
        "--calibrate",
        nargs="*",
        default=[],
        help="parameters of which the nominal value is not trusted",
    )
    ask.add_argument("--effects", nargs="*", help="candidates; default: all, see 'sb3-hds effects'")
    ask.add_argument("--budget", choices=("full", "quick"), default="full")
    ask.add_argument("--seed", type=int, default=0)
    ask.add_argument("--report", help="HTML page to write")
    ask.add_argument("--animate", help="MP4 film to write: measured and predicted motion")
    ask.add_argument("--json", help="JSON file to write")
    measured.add_write(ask)
    design = ask.add_argument_group("what to record next", "commands that decide what is open")
    design.add_argument("--next", metavar="FILE", help="CSV or NPZ file of commands to write")
    design.add_argument("--limits", metavar="FILE", help="yml file: what the machine may do")
    design.add_argument("--recordings", type=int, default=1, help="to design; default: 1")
    design.add_argument("--seconds", type=float, default=10.0, help="of each; default: 10")
    gain = ask.add_argument_group("policy gain", "policies from both twins, on the real system")
    gain.add_argument("--env", help="id of the real system")
    gain.add_argument("--env-kwargs", nargs="*", default=[], metavar="NAME:VALUE", help="of it")
    gain.add_argument("--algo", default="hds", help="id in the zoo; default: hds")
    gain.add_argument("--policies", type=int, default=5, help="trained in each twin; default: 5")
    gain.add_argument("--policy-budget", type=int, default=0, help="steps of training in a twin")
    gain.add_argument("--episodes", type=int, default=20, help="for each policy; default: 20")
    gain.add_argument(
        "--hyperparams", nargs="*", default=[], metavar="NAME:VALUE", help="of the algorithm"
    )
    audit.add_arguments(commands.add_parser("audit", help="find defects of measured data"))
    calibrate.add_arguments(
        commands.add_parser("calibrate", help="estimate parameters of a twin from measured data")
    )
    shake = commands.add_parser("robustness", help="return under noise, failed sensors, pushes")
    shake.add_argument(
        "--algo", required=True, help="id in the zoo, ours or rl_zoo3's, or a class: sbx.SAC"
    )
    shake.add_argument("--model", required=True, help="file that the algorithm saved")
    shake.add_argument("--env", required=True, help="environment id")
    shake.add_argument("--env-kwargs", nargs="*", default=[], metavar="NAME:VALUE")
    shake.add_argument(
        "--env-wrapper",
        nargs="*",
        default=[],
        metavar="CLASS",
        help="as trained, the one next to the environment first: package.Wrapper, or with "
        "arguments as in yml, 'package.Wrapper: {cutoff: 4.0}'",
    )
    shake.add_argument("--episodes", type=int, default=20, help="for each perturbation")
    shake.add_argument("--encoders", choices=("own", "observation"), default="own")
    shake.add_argument("--vecnormalize", help="vecnormalize.pkl of the training")
    shake.add_argument("--push", type=float, default=5.0, help="force on the torso [N]")
    shake.add_argument("--csv", help="table to write")
    columns.add_arguments(
        commands.add_parser("columns", help="list what is in a log, with a map to start from")
    )
    export.add_arguments(
        commands.add_parser("export", help="write a policy as ONNX, or as a header of C")
    )
    run_file.add_arguments(
        commands.add_parser("run", help="act by an exported policy, in real time, and record it")
    )
    study.add_arguments(
        commands.add_parser("study", help="run algorithms on environments, with seeds, and report")
    )
    known = commands.add_parser("effects", help="list the candidates, with units and explanations")
    known.add_argument(
        "words",
        nargs="*",
        metavar="WORD",
        help="list only those that mention all of these",
    )
    twins.add_arguments(
        commands.add_parser(
            "twins", help="list the simulations, with their parameters, or check one"
        )
    )
    return every
