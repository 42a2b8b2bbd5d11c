"""The same diagnosis of many logs, each in a process of its own, here or on a Ray cluster."""

import csv
import io
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from sb3_hds.core.trajectories.storage import write_bytes
from sb3_hds.errors import StudyError
from sb3_hds.experiments.cluster import Share, on_cluster, on_this_machine

_ARGUMENTS, _TABLE = "arguments.json", "verdicts.csv"
# Output files of a diagnosis by option. The page is written last, so it marks a complete one.
_OUTPUT = {"--json": ".json", "--report": ".html"}


class LogVerdict(NamedTuple):
    """
    The diagnosis of one log.

    :param log: its file
    :param verdict: empty if it failed
    :param causes: names and places
    :param error: the last line that it printed, if it failed
    """

    log: str
    verdict: str
    causes: tuple[str, ...]
    error: str = ""

    def __str__(self) -> str:
        return f"{self.log}: {self.error or ' '.join((self.verdict, *self.causes))}"


def diagnose_each(
    logs: Sequence[str],
    arguments: Sequence[str],
    folder: str | os.PathLike[str],
    *,
    jobs: int | None = None,
    memory: float = 4.0,
    ray: str | None = None,
    cpus: float = 2.0,
    tell: Callable[[str], None] = print,
) -> list[LogVerdict]:
    """
    Diagnose each log on its own. Logs whose results are in the folder are skipped, so an
    interrupted call can be repeated.

    :param logs: files; with Ray, seen by all nodes under these names
    :param arguments: of ``sb3-hds diagnose``, apart from data and output files
    :param folder: for a JSON file and a page of each log, and a table of all; created if missing
    :param jobs: parallel diagnoses; default: one per core, or as many as the cluster has room for
    :param memory: per diagnosis [GiB]
    :param ray: address of a Ray cluster, or ``"auto"``; default: this machine
    :param cpus: cores per diagnosis, with Ray
    :param tell: called with a line for each log
    :return: one for each log, in order
    :raises StudyError: if two logs would have files of the same name, if the folder holds results
        of other arguments, or if there is no such cluster
    """
    root = Path(folder).resolve()
    names = _names_of(logs)
    _claim(root, list(arguments))
    waiting = [log for log in logs if not _is_complete(root, names[log])]
    found = {log: _verdict_of(root, log, names[log]) for log in logs if log not in waiting}
    one = partial(_diagnose, names=names, arguments=arguments, root=root, cwd=os.getcwd())
    ended = (
        on_this_machine(one, waiting, jobs, memory)
        if ray is None
        else on_cluster(one, waiting, ray, Share(cpus, 0.0, memory), jobs)
    )
    for remaining, (log, error) in zip(reversed(range(len(waiting))), ended, strict=True):
        found[log] = _verdict_of(root, log, names[log], error)
        tell(f"{time.strftime('%H:%M:%S')} {found[log]} ({remaining} to go)")
    verdicts = [found[log] for log in logs]
    _write_table(root / _TABLE, verdicts)
    return verdicts


def _names_of(logs: Sequence[str]) -> dict[str, str]:
    """Names of output files: those of the logs, with their folders where these differ."""
    paths = [Path(log) for log in logs]
    flat = len({path.stem for path in paths}) == len(paths)
    names = {
        log: path.stem if flat else "_".join(path.with_suffix("").parts).strip(os.sep)
        for log, path in zip(logs, paths, strict=True)
    }
    if len(set(names.values())) < len(names):
        raise StudyError(
            "Some logs differ in nothing but their suffix, so their results would have the same "
            "file names. Diagnose them into different folders."
        )
    return names


def _claim(root: Path, arguments: list[str]) -> None:
    """Make the folder one of these arguments."""
    root.mkdir(parents=True, exist_ok=True)
    path = root / _ARGUMENTS
    if not path.exists():
        write_bytes(path, (json.dumps(arguments) + "\n").encode())
    stored = json.loads(path.read_text(encoding="utf-8"))
    if stored != arguments:
        raise StudyError(
            f"'{root}' holds diagnoses with other arguments ({' '.join(stored)}). Choose another "
            "folder, or remove that one."
        )


def _is_complete(root: Path, name: str) -> bool:
    return all((root / f"{name}{suffix}").exists() for suffix in _OUTPUT.values())


def _diagnose(
    log: str, names: dict[str, str], arguments: Sequence[str], root: Path, cwd: str
) -> str:
    """:return: its error, or an empty string"""
    if not (root / _ARGUMENTS).exists():
        return f"This node cannot access '{root}': a cluster needs a folder that all nodes share."
    command = [sys.executable, "-m", "sb3_hds.cli", "diagnose", *arguments, "--data", log]
    for option, suffix in _OUTPUT.items():
        command += [option, f"{root / names[log]}{suffix}"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=cwd)
    if not done.returncode:
        return ""
    lines = done.stderr.strip().splitlines()
    return lines[-1].removeprefix("sb3-hds: ") if lines else f"it exited with {done.returncode}"


def _verdict_of(root: Path, log: str, name: str, error: str = "") -> LogVerdict:
    if error:
        return LogVerdict(log, "", (), error)
    found: dict[str, Any] = json.loads((root / f"{name}.json").read_text(encoding="utf-8"))
    return LogVerdict(log, found["verdict"], tuple(map(_cause, found["findings"])))


def _cause(finding: dict[str, Any]) -> str:
    effect, where = finding["effect"], finding["where"]
    return effect if where["slot"] == "parameter" else f"{effect}.{where['name']}"


def _write_table(path: Path, found: Sequence[LogVerdict]) -> None:
    text = io.StringIO(newline="")
    rows = csv.writer(text)
    rows.writerow(LogVerdict._fields)
    rows.writerows((one.log, one.verdict, " ".join(one.causes), one.error) for one in found)
    write_bytes(path, text.getvalue().encode())
