"""``sb3-hds study``."""

import argparse
import os
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sb3_hds.experiments.study import Study


def add_arguments(command: argparse.ArgumentParser) -> None:
    """:param command: ``sb3-hds study``"""
    parts = command.add_subparsers(dest="part", required=True, metavar="part")
    for name, explained in (
        ("run", "run what is not complete; resumes after an interruption"),
        ("status", "print a table of the runs and the remaining time"),
        ("report", "write an HTML page with figures"),
    ):
        part = parts.add_parser(name, help=explained)
        part.add_argument(
            "study", metavar="STUDY.yml", help="file with algorithms, envs, seeds and budget"
        )
        part.add_argument(
            "--folder", help="the zoo's log folder; default: logs/ and the name of the study"
        )
        if name != "report":
            part.add_argument("--jobs", type=int, help="parallel runs; default: one per core")
        if name == "run":
            part.add_argument(
                "--memory", type=float, default=2.0, help="memory per run [GiB]; default: 2"
            )
            part.add_argument(
                "--checkpoint",
                type=float,
                default=5.0,
                metavar="MINUTES",
                help="interval between checkpoints of a run; 0: none; default: 5",
            )
            part.add_argument(
                "--ray", metavar="ADDRESS", help="run on the Ray cluster at this address, or auto"
            )
            part.add_argument(
                "--cpus", type=float, default=1.0, help="cores per run, with --ray; default: 1"
            )
            part.add_argument(
                "--gpus",
                type=float,
                default=0.0,
                help="GPUs per run, with --ray; may be a fraction",
            )
        if name == "report":
            part.add_argument(
                "--html", help="page to write; default: report.html in the log folder"
            )
    command.set_defaults(run=run)


def run(given: argparse.Namespace) -> int:
    """:return: 1 if a run failed, else 0"""
    from sb3_hds.experiments.study import Study

    study = Study.load(given.study)
    folder = Path(given.folder or Path("logs") / study.name)
    return {"run": _run, "status": _status, "report": _report}[given.part](study, folder, given)


def _run(study: "Study", folder: Path, given: argparse.Namespace) -> int:
    from sb3_hds.experiments.study import run_study, zoo_command

    done = run_study(
        study,
        folder,
        jobs=given.jobs,
        memory=given.memory,
        command=zoo_command(study, given.checkpoint),
        ray=given.ray,
        cpus=given.cpus,
        gpus=given.gpus,
    )
    print(f"{len(done.complete)} of {len(study.runs)} runs are complete in {folder}")
    return 1 if done.failed else 0


def _status(study: "Study", folder: Path, given: argparse.Namespace) -> int:
    from rich.console import Console
    from rich.table import Table

    from sb3_hds.experiments.study import progress_of, seconds_to_go

    progress = progress_of(study, folder)
    table = Table("algorithm", "environment", "seed", "state", "steps", "wall time", box=None)
    for row in progress:
        share = f"{row.steps:,}" + (f" of {study.steps:,}" if isinstance(study.steps, int) else "")
        run = row.run
        table.add_row(run.label, run.env, str(run.seed), row.state, share, _time(row.seconds))
    Console().print(table)
    complete = sum(row.state == "complete" for row in progress)
    remaining = seconds_to_go(study, progress, given.jobs or os.cpu_count() or 1)
    to_go = "" if remaining is None else f", about {_time(remaining)} to go"
    print(f"{complete} of {len(progress)} runs are complete{to_go}")
    return 0


def _report(study: "Study", folder: Path, given: argparse.Namespace) -> int:
    from sb3_hds.experiments.study import write_report

    written = write_report(study, folder, given.html or folder / "report.html")
    print(f"{written.page}: {written.n_runs} runs and {len(written.figures)} figure files")
    return 0


def _time(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}"
