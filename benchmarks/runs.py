"""Fresh processes, and tables of runs that survive an interruption."""

import argparse
import fcntl
import hashlib
import inspect
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from pathlib import Path
from threading import Lock
from typing import Any

import pandas as pd

RESULTS = Path(__file__).parent / "results"
#: may be deleted: compiled programs, and models that several runs start from
CACHE = Path(__file__).parent / ".cache"


def arguments_of(parser: argparse.ArgumentParser, worker: Callable[..., Any]) -> argparse.Namespace:
    """
    Parse the command line of a benchmark, or act as the worker that `fresh_process` started.

    :param worker: called with the values of ``--worker``, each converted to the type of its
        parameter; its result is printed as one line of JSON
    """
    parameters = inspect.signature(worker).parameters
    names = tuple(name.upper() for name in parameters)
    parser.add_argument("--worker", nargs=len(names), metavar=names, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if not arguments.worker:
        return arguments
    types = [parameter.annotation for parameter in parameters.values()]
    values = [of(value) for of, value in zip(types, arguments.worker, strict=True)]
    print(json.dumps(worker(*values)))
    raise SystemExit


def fresh_process(script: str, *arguments: Any, cache: Path | None = None) -> Any:
    """
    Run a benchmark's worker (`arguments_of`) in a process of its own.

    The environment variable ``BENCHMARK_START`` holds the time at which it was started [s since the
    epoch].

    :param cache: folder of compiled programs; None: the worker compiles everything
    :return: what the worker returned
    :raises RuntimeError: with the last lines of the worker's output, if it failed
    """
    folder = nullcontext(cache) if cache else tempfile.TemporaryDirectory()
    with folder as kept:
        environment = os.environ | {
            "SB3_HDS_CACHE": str(kept),
            "JAX_COMPILATION_CACHE_DIR": str(kept) if cache else "",
            "BENCHMARK_START": repr(time.time()),
        }
        command = [sys.executable, script, "--worker", *map(str, arguments)]
        done = subprocess.run(command, env=environment, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"{' '.join(command)} failed:\n{done.stderr[-3000:]}")
    return json.loads(done.stdout.strip().splitlines()[-1])


@contextmanager
def others_waiting() -> Iterator[None]:
    """Of workers running in parallel, let one measure while the others import and compile."""
    CACHE.mkdir(exist_ok=True)
    with open(CACHE / "measuring.lock", "w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def code_version(*roots: Path) -> str:
    """:return: hash of all Python sources in these folders; unchanged code has the same hash"""
    found = hashlib.sha256()
    for root in roots:
        for path in sorted(root.rglob("*.py")):
            found.update(str(path.relative_to(root)).encode() + b"\0")
            found.update(path.read_bytes() + b"\0")
    return found.hexdigest()[:12]


def seconds_since_start() -> float:
    """:return: wall time since this worker was started, interpreter and imports included [s]"""
    return time.time() - float(os.environ["BENCHMARK_START"])


def save(rows: Sequence[dict[str, Any]], name: str) -> pd.DataFrame:
    """Write ``results/NAME.csv`` by a temporary name. It then holds these rows and no others."""
    RESULTS.mkdir(exist_ok=True)
    table, path = pd.DataFrame(rows), RESULTS / f"{name}.csv"
    temporary = path.with_suffix(".tmp")
    table.to_csv(temporary, index=False, float_format="%.6g")
    temporary.replace(path)
    return table


class InterruptedRun:
    """
    Checkpoints of the training of an SB3 model, one at each mark, until it is complete.

    :param folder: used by this run only
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def rows(self) -> list[dict[str, Any]]:
        """:return: one for each mark that was reached"""
        path = self.folder / "rows.json"
        return json.loads(path.read_text()) if path.exists() else []

    def model(self, algorithm: type, env: str) -> Any:
        """:return: the model at its last mark"""
        import gymnasium

        at = self._at(self.rows())
        model = algorithm.load(at / "model.zip", env=gymnasium.make(env))
        model.load_replay_buffer(at / "buffer.pkl")
        return model

    def keep(self, model: Any, rows: list[dict[str, Any]]) -> None:
        at, before = self._at(rows), self._at(rows[:-1]) if rows[:-1] else None
        model.save(at / "model.zip")
        model.save_replay_buffer(at / "buffer.pkl")
        temporary = self.folder / "rows.tmp"
        temporary.write_text(json.dumps(rows))
        temporary.replace(self.folder / "rows.json")
        if before is not None:
            shutil.rmtree(before, ignore_errors=True)

    def forget(self) -> None:
        shutil.rmtree(self.folder, ignore_errors=True)

    def _at(self, rows: list[dict[str, Any]]) -> Path:
        return self.folder / str(rows[-1]["mark"])


def resume(
    name: str,
    keys: Sequence[str],
    wanted: Iterable[tuple[Any, ...]],
    work: Callable[..., dict[str, Any] | list[dict[str, Any]]],
    jobs: int,
    complete: Callable[[tuple[Any, ...], list[dict[str, Any]]], bool] = lambda run, rows: True,
) -> None:
    """
    Make the runs that ``results/NAME.csv`` lacks. A run that fails is reported and left out.

    :param keys: columns that identify a run
    :param wanted: values of these columns, for each run
    :param work: takes these values and returns the row or the rows of the run
    :param jobs: number of parallel runs
    :param complete: takes a run and its rows in the table, and says whether the run is complete; an
        incomplete run is made again, and replaces its rows
    """
    path = RESULTS / f"{name}.csv"
    rows = pd.read_csv(path).to_dict("records") if path.exists() else []
    before: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
    for row in rows:
        before.setdefault(tuple(row[key] for key in keys), []).append(row)
    done, lock = {run for run, its in before.items() if complete(run, its)}, Lock()

    def one(run: tuple[Any, ...]) -> None:
        label = ", ".join(map(str, run))
        try:
            found = work(*run)
        except RuntimeError as error:
            print(f"{label}: {error}", file=sys.stderr, flush=True)
            return
        with lock:
            rows[:] = [row for row in rows if tuple(row[key] for key in keys) != run]
            found = [found] if isinstance(found, dict) else found
            rows.extend(dict(zip(keys, run, strict=True)) | row for row in found)
            save(rows, name)
        print(f"{time.strftime('%H:%M:%S')} {label}", file=sys.stderr, flush=True)

    with ThreadPoolExecutor(jobs) as pool:
        list(pool.map(one, [run for run in wanted if run not in done]))
