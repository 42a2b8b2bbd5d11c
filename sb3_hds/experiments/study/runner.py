"""
Studies: algorithms, environments and seeds, each run by RL Zoo in a process of its own.

A run is written in a folder of its own and moved, when it is complete, to where the zoo would have
put it. What is there is complete; what is not is run, from its last checkpoint on, however often a
study is killed.
"""

import contextlib
import json
import os
import platform
import secrets
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from functools import partial
from pathlib import Path
from typing import NamedTuple

from sb3_hds.core.trajectories.storage import write_bytes
from sb3_hds.errors import StudyError
from sb3_hds.experiments.cluster import Share, on_cluster
from sb3_hds.experiments.study.definition import Command, Run, Study, zoo_command

#: file that marks a complete run, and says what it was
MARK = "study.json"

#: table of steps and seconds in the folder of a run
CLOCK = "clock.csv"
_RUNNING, _FAILED, _LOCK, _CHECKPOINTS = ".running", ".failed", ".lock", ".checkpoints"
# Characters of an error that are shown.
_SHOWN = 600


class Done(NamedTuple):
    """
    :param complete: runs that were there before, or are now
    :param failed: runs that ended with an error, and its last lines
    """

    complete: tuple[Run, ...]
    failed: tuple[tuple[Run, str], ...]


class Progress(NamedTuple):
    """
    :param state: ``"complete"``, ``"running"``, ``"failed"`` or ``"waiting"``
    :param steps: made so far
    :param seconds: since it began
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
    Run what is not complete. Called again after it was killed, it goes on.

    :param folder: the zoo's folder of logs, made where there is none; with Ray, one that all nodes
        share
    :param jobs: runs at a time; default: as many as there are cores, or as the cluster has room for
    :param memory: that a run may need [GiB]: no more run at a time than fit into what is free
    :param command: starts a run; default: :func:`zoo_command`
    :param tell: is called with a line for each run that ends
    :param ray: address of a Ray cluster that runs them, or ``"auto"``; default: this machine
    :param cpus: of a run, where Ray runs it
    :param gpus: of a run, likewise; may be a fraction
    :raises StudyError: if another study is at work in that folder, if it has a run of the same
        name with other settings, or if there is no such cluster
    """
    root = Path(folder).resolve()
    root.mkdir(parents=True, exist_ok=True)
    one = partial(_executed, study=study, root=root, command=command or zoo_command(study))
    with _alone(root):
        waiting = [run for run in study.runs if not is_complete(study, run, root)]
        shutil.rmtree(root / _RUNNING, ignore_errors=True)
        complete = {run.place for run in study.runs} - {run.place for run in waiting}
        failed: list[tuple[Run, str]] = []
        ended = (
            _on_this_machine(one, waiting, _at_a_time(jobs, memory))
            if ray is None
            else on_cluster(one, waiting, ray, Share(cpus, gpus, memory), jobs)
        )
        for left, (run, error) in zip(reversed(range(len(waiting))), ended, strict=True):
            if error is None:
                complete.add(run.place)
            else:
                failed.append((run, error))
            what = "complete" if error is None else f"failed: {error[-_SHOWN:]}"
            tell(f"{time.strftime('%H:%M:%S')} {run}: {what} ({left} to go)")
    return Done(tuple(run for run in study.runs if run.place in complete), tuple(failed))


def _on_this_machine(
    one: Callable[[Run], str | None], runs: Sequence[Run], at_a_time: int
) -> Iterator[tuple[Run, str | None]]:
    """:return: runs as they end, and their errors"""
    with ThreadPoolExecutor(at_a_time) as pool:
        waited = {pool.submit(one, run): run for run in runs}
        for future in as_completed(waited):
            yield waited[future], future.result()


def is_complete(study: Study, run: Run, folder: Path) -> bool:
    """
    :return: whether a run is there
    :raises StudyError: if there is one of the same name with other settings
    """
    mark = folder / run.place / MARK
    if not mark.exists():
        if (folder / run.place).exists():
            raise StudyError(
                f"'{folder / run.place}' is not of a study. Choose another folder for this one."
            )
        return False
    told, wanted = json.loads(mark.read_text())["settings"], study.settings(run)
    if told != wanted:
        differing = ", ".join(key for key in wanted if told.get(key) != wanted[key])
        raise StudyError(
            f"'{folder / run.place}' was run with another {differing}. Choose another folder, or "
            "remove that one."
        )
    return True


def progress_of(study: Study, folder: str | os.PathLike[str]) -> list[Progress]:
    """:return: of each run, in their order"""
    root, found = Path(folder), []
    for run in study.runs:
        if is_complete(study, run, root):
            found.append(Progress(run, "complete", *_last_of(root / run.place / CLOCK)))
        elif begun := sorted(_scratch(root, run).parent.glob(f"{_scratch(root, run).name}.*")):
            found.append(Progress(run, "running", *_last_of(begun[-1] / CLOCK)))
        else:
            state = "failed" if _error_file(root, run).exists() else "waiting"
            found.append(Progress(run, state, 0, 0.0))
    return found


def seconds_to_go(study: Study, progress: Sequence[Progress], jobs: int) -> float | None:
    """
    By the mean of what complete runs of the same algorithm in the same environment took, or of all.

    :param jobs: runs at a time
    :return: [s]; None before a run is complete
    """
    took: dict[tuple[str, str], list[float]] = {}
    for one in progress:
        if one.state == "complete":
            took.setdefault((one.run.label, one.run.env), []).append(one.seconds)
    if not took:
        return None
    everything = [seconds for some in took.values() for seconds in some]
    left = 0.0
    for one in progress:
        if one.state != "complete":
            known = took.get((one.run.label, one.run.env), everything)
            left += max(0.0, sum(known) / len(known) - one.seconds)
    return left / jobs


def _at_a_time(jobs: int | None, memory: float) -> int:
    cores = os.cpu_count() or 1
    wanted = cores if jobs is None else jobs
    free = _free_memory()
    return max(1, wanted if free is None else min(wanted, int(free / memory)))


def _free_memory() -> float | None:
    """[GiB]; None where the system does not say it."""
    with contextlib.suppress(OSError):
        for line in Path("/proc/meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) / 2**20
    return None


@contextlib.contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """A lock that the system gives back when this process ends, however it does."""
    with (folder / _LOCK).open("w") as file:
        try:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except ImportError:  # Windows: whoever starts two has been asked not to
            pass
        except OSError as error:
            raise StudyError(f"Another study is at work in '{folder}'. Wait for it.") from error
        yield


def _executed(run: Run, study: Study, root: Path, command: Command) -> str | None:
    """:return: None, or the last lines of an error"""
    if not (root / _LOCK).exists():
        return (
            f"{platform.node()} does not see '{root}': a cluster needs a folder that all of its "
            "nodes share."
        )
    if is_complete(study, run, root):
        return None
    # A name of its own: the process of a study that was killed may take a moment to end.
    scratch = _scratch(root, run).with_name(f"{_scratch(root, run).name}.{secrets.token_hex(4)}")
    logs, clock = scratch / "logs", scratch / CLOCK
    logs.mkdir(parents=True)
    checkpoint = root / _CHECKPOINTS / _name_of(run)
    words = list(command(run, logs, clock, checkpoint))
    begun = time.time()
    # It ends when this process does: its standard input is a pipe from here.
    pipe, said = subprocess.PIPE, subprocess.STDOUT
    with (
        (scratch / "output.txt").open("wb") as output,
        subprocess.Popen(words, stdin=pipe, stdout=output, stderr=said) as process,
    ):
        code = process.wait()
    found = sorted((logs / run.algo).glob(f"{run.env_name}_*"))
    if code or not found:
        error = (scratch / "output.txt").read_text(errors="replace")
        _error_file(root, run).parent.mkdir(parents=True, exist_ok=True)
        write_bytes(_error_file(root, run), error.encode())
        shutil.rmtree(scratch, ignore_errors=True)
        return error.strip() or f"it ended with {code} and wrote nothing"
    if clock.exists():
        clock.replace(found[0] / CLOCK)
    told = {
        "settings": study.settings(run),
        "command": words,
        "begun": begun,
        "seconds": time.time() - begun,
        "machine": {"cpu": _processor(), "cores": os.cpu_count(), "system": platform.platform()},
        "versions": _versions(),
    }
    write_bytes(found[0] / MARK, json.dumps(told, indent=1).encode())
    target = root / run.place
    target.parent.mkdir(parents=True, exist_ok=True)
    # On a cluster, a node that was given up for lost may have been faster.
    if not (target / MARK).exists():
        found[0].rename(target)
    shutil.rmtree(scratch, ignore_errors=True)
    shutil.rmtree(checkpoint, ignore_errors=True)
    _error_file(root, run).unlink(missing_ok=True)
    return None


def _name_of(run: Run) -> str:
    return f"{run.label}-{run.env_name}_{run.seed + 1}"


def _scratch(root: Path, run: Run) -> Path:
    return root / _RUNNING / _name_of(run)


def _error_file(root: Path, run: Run) -> Path:
    return root / _FAILED / f"{_name_of(run)}.txt"


def _last_of(clock: Path) -> tuple[int, float]:
    """Steps and seconds of the last whole line."""
    rows = (
        [line.split(",") for line in clock.read_text().splitlines()[1:]] if clock.exists() else []
    )
    whole = [row for row in rows if len(row) == 2 and all(row)]
    return (int(whole[-1][0]), float(whole[-1][1])) if whole else (0, 0.0)


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
