"""
Execution of a study: RL Zoo runs each algorithm, environment and seed in its own process.

A run writes to its own folder, which is moved to the zoo's place once the run is complete. So runs
found there are complete; all others are run, from their last checkpoint on, however often a study
is killed.
"""

import contextlib
import json
import os
import platform
import secrets
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

from sb3_hds.core.trajectories.storage import write_bytes
from sb3_hds.errors import StudyError
from sb3_hds.experiments.cluster import Share, on_cluster, on_this_machine
from sb3_hds.experiments.study.definition import Command, Run, Study, zoo_command

#: file that marks a complete run, with its settings
MARK = "study.json"

#: table of steps and times in the folder of a run
CLOCK = "clock.csv"
_RUNNING, _FAILED, _LOCK, _CHECKPOINTS = ".running", ".failed", ".lock", ".checkpoints"
# Files in which the zoo records its command.
_TOLD = ("args.yml", "command.txt")
# Characters to show of an error.
_SHOWN = 600


class Done(NamedTuple):
    """
    Outcome of a study.

    :param complete: runs that are complete, from before or now
    :param failed: runs that ended with an error, and the error
    """

    complete: tuple[Run, ...]
    failed: tuple[tuple[Run, str], ...]


class Progress(NamedTuple):
    """
    Progress of one run.

    :param state: ``"complete"``, ``"running"``, ``"failed"`` or ``"waiting"``
    :param steps: so far
    :param seconds: since the training began
    """

    run: Run
    state: str
    steps: int
    seconds: float


def run_study(
    study: Study,
    folder: str | os.PathLike[str],
    *,
    jobs: int | None = None,
    memory: float = 2.0,
    command: Command | None = None,
    tell: Callable[[str], None] = print,
    ray: str | None = None,
    cpus: float = 1.0,
    gpus: float = 0.0,
) -> Done:
    """
    Run what is not complete. Call it again to resume an interrupted study.

    :param folder: the zoo's log folder, created if missing; with Ray, one that all nodes share
    :param jobs: parallel runs; default: one per core, or as many as the cluster has resources for
    :param memory: per run [GiB]; limits the number of parallel runs to what fits into free memory
    :param command: makes the command of a run; default: :func:`zoo_command`
    :param tell: called with a line for each run that ends
    :param ray: address of a Ray cluster, or ``"auto"``; default: run on this machine
    :param cpus: cores per run, with Ray
    :param gpus: GPUs per run, with Ray; may be a fraction
    :raises StudyError: if another study is running in that folder, if it has a run of the same name
        with other settings, or if there is no such cluster
    """
    root = Path(folder).resolve()
    root.mkdir(parents=True, exist_ok=True)
    one = partial(
        _run_one,
        study=study,
        root=root,
        shown=os.fspath(folder),
        command=command or zoo_command(study),
    )
    with _locked(root):
        waiting = [run for run in study.runs if not is_complete(study, run, root)]
        shutil.rmtree(root / _RUNNING, ignore_errors=True)
        complete = {run.place for run in study.runs} - {run.place for run in waiting}
        failed: list[tuple[Run, str]] = []
        ended = (
            on_this_machine(one, waiting, jobs, memory)
            if ray is None
            else on_cluster(one, waiting, ray, Share(cpus, gpus, memory), jobs)
        )
        for remaining, (run, error) in zip(reversed(range(len(waiting))), ended, strict=True):
            if error is None:
                complete.add(run.place)
            else:
                failed.append((run, error))
            what = "complete" if error is None else f"failed: {error[-_SHOWN:]}"
            tell(f"{time.strftime('%H:%M:%S')} {run}: {what} ({remaining} to go)")
    return Done(tuple(run for run in study.runs if run.place in complete), tuple(failed))


def is_complete(study: Study, run: Run, folder: Path) -> bool:
    """
    :return: whether a run is complete
    :raises StudyError: if its folder has other settings, or is not of a study
    """
    mark = folder / run.place / MARK
    if not mark.exists():
        if (folder / run.place).exists():
            raise StudyError(
                f"'{folder / run.place}' does not belong to a study. Choose another folder."
            )
        return False
    stored, wanted = json.loads(mark.read_text())["settings"], study.settings(run)
    if stored != wanted:
        differing = ", ".join(key for key in wanted if stored.get(key) != wanted[key])
        raise StudyError(
            f"'{folder / run.place}' was run with different {differing}. Choose another folder, or "
            "remove that one."
        )
    return True


def progress_of(study: Study, folder: str | os.PathLike[str]) -> list[Progress]:
    """:return: progress of all runs, in order"""
    root, found = Path(folder), []
    for run in study.runs:
        if is_complete(study, run, root):
            found.append(Progress(run, "complete", *_last_line_of(root / run.place / CLOCK)))
        elif begun := sorted(_scratch(root, run).parent.glob(f"{_scratch(root, run).name}.*")):
            found.append(Progress(run, "running", *_last_line_of(begun[-1] / CLOCK)))
        else:
            state = "failed" if _error_file(root, run).exists() else "waiting"
            found.append(Progress(run, state, 0, 0.0))
    return found


def seconds_to_go(study: Study, progress: Sequence[Progress], jobs: int) -> float | None:
    """
    Estimate the remaining time from the mean duration of complete runs of the same algorithm and
    environment, or else of all.

    :param jobs: parallel runs
    :return: [s]; None before any run is complete
    """
    durations: dict[tuple[str, str], list[float]] = {}
    for one in progress:
        if one.state == "complete":
            durations.setdefault((one.run.label, one.run.env), []).append(one.seconds)
    if not durations:
        return None
    everything = [seconds for some in durations.values() for seconds in some]
    left = 0.0
    for one in progress:
        if one.state != "complete":
            known = durations.get((one.run.label, one.run.env), everything)
            left += max(0.0, sum(known) / len(known) - one.seconds)
    return left / jobs


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """A lock that the system releases when this process ends, in whatever way."""
    with (folder / _LOCK).open("w") as file:
        try:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except ImportError:  # no locks on Windows
            pass
        except OSError as error:
            raise StudyError(f"Another study is running in '{folder}'. Wait for it.") from error
        yield


def _run_one(run: Run, study: Study, root: Path, shown: str, command: Command) -> str | None:
    """
    Run one run; return its error, or None.

    :param shown: the folder of the study, as the user wrote it
    """
    if not (root / _LOCK).exists():
        return (
            f"{platform.node()} cannot access '{root}': a cluster needs a folder that all of its "
            "nodes share."
        )
    if is_complete(study, run, root):
        return None
    # A unique name: a process of a killed study may take a moment to exit.
    scratch = _scratch(root, run).with_name(f"{_scratch(root, run).name}.{secrets.token_hex(4)}")
    logs, clock = scratch / "logs", scratch / CLOCK
    logs.mkdir(parents=True)
    checkpoint = root / _CHECKPOINTS / _name_of(run)
    words = list(command(run, logs, clock, checkpoint))
    begun = time.time()
    # The run exits when its standard input closes, so it ends with this process.
    with (
        (scratch / "output.txt").open("wb") as output,
        subprocess.Popen(
            words, stdin=subprocess.PIPE, stdout=output, stderr=subprocess.STDOUT
        ) as process,
    ):
        code = process.wait()
    found = sorted((logs / run.algo).glob(f"{run.env_name}_*"))
    if code or not found:
        error = (scratch / "output.txt").read_text(errors="replace")
        _error_file(root, run).parent.mkdir(parents=True, exist_ok=True)
        write_bytes(_error_file(root, run), error.encode())
        shutil.rmtree(scratch, ignore_errors=True)
        return error.strip() or f"it exited with {code} and wrote nothing"
    if clock.exists():
        clock.replace(found[0] / CLOCK)
    # The scratch folder vanishes, and other machines have other paths.
    paths = dict.fromkeys(map(str, (logs, scratch, root)), shown) | {sys.executable: "python"}
    for file in (found[0] / run.env_name / name for name in _TOLD):
        if file.exists():
            write_bytes(file, _replaced(file.read_text(), paths).encode())
    mark = {
        "settings": study.settings(run),
        "command": [_replaced(word, paths) for word in words],
        "begun": begun,
        "seconds": time.time() - begun,
        "machine": {"cpu": _processor(), "cores": os.cpu_count(), "system": platform.platform()},
        "versions": _versions(),
    }
    write_bytes(found[0] / MARK, json.dumps(mark, indent=1).encode())
    target = root / run.place
    target.parent.mkdir(parents=True, exist_ok=True)
    # On a cluster, a node that was given up as lost may have completed the run.
    if not (target / MARK).exists():
        found[0].rename(target)
    shutil.rmtree(scratch, ignore_errors=True)
    shutil.rmtree(checkpoint, ignore_errors=True)
    _error_file(root, run).unlink(missing_ok=True)
    return None


def _replaced(text: str, names: Mapping[str, str]) -> str:
    for path, name in names.items():
        text = text.replace(path, name)
    return text


def _name_of(run: Run) -> str:
    return f"{run.label}-{run.env_name}_{run.seed + 1}"


def _scratch(root: Path, run: Run) -> Path:
    return root / _RUNNING / _name_of(run)


def _error_file(root: Path, run: Run) -> Path:
    return root / _FAILED / f"{_name_of(run)}.txt"


def _last_line_of(clock: Path) -> tuple[int, float]:
    """Steps and seconds of the last complete line."""
    rows = (
        [line.split(",") for line in clock.read_text().splitlines()[1:]] if clock.exists() else []
    )
    complete = [row for row in rows if len(row) == 2 and all(row)]
    return (int(complete[-1][0]), float(complete[-1][1])) if complete else (0, 0.0)


def _processor() -> str:
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def _versions() -> dict[str, str]:
    from importlib.metadata import PackageNotFoundError, version

    found = {"python": platform.python_version()}
    for name in ("sb3-hds", "rl_zoo3", "stable-baselines3", "sbx-rl", "jax", "gymnasium", "mujoco"):
        with contextlib.suppress(PackageNotFoundError):
            found[name] = version(name)
    return found
