"""Fresh processes, and runs and tables that survive an interruption."""

import fcntl
import hashlib
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
#: what may be thrown away: compiled programs, and models that several runs start from
CACHE = Path(__file__).parent / ".cache"


def fresh_process(script: str, *arguments: Any, cache: Path | None = None) -> dict[str, Any]:
    """
    Run a benchmark's worker in a process of its own.

    The worker finds the moment of its start [s since the epoch] in ``BENCHMARK_START`` and prints
    one line of JSON last.

    :param cache: where compiled programs are kept; None: nowhere, the worker compiles everything
    :raises RuntimeError: with the worker's last lines, if it failed
    """
    folder = nullcontext(cache) if cache else tempfile.TemporaryDirectory()
    with folder as kept:
        surroundings = os.environ | {
            "SB3_HDS_CACHE": str(kept),
            "JAX_COMPILATION_CACHE_DIR": str(kept) if cache else "",
            "BENCHMARK_START": repr(time.time()),
        }
        command = [sys.executable, script, "--worker", *map(str, arguments)]
        done = subprocess.run(command, env=surroundings, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"{' '.join(command)} failed:\n{done.stderr[-3000:]}")
    return json.loads(done.stdout.strip().splitlines()[-1])


@contextmanager
def others_waiting() -> Iterator[None]:
    """Of workers that run at a time, one measures; the others import and compile meanwhile."""
    CACHE.mkdir(exist_ok=True)
    with open(CACHE / "measuring.lock", "w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def code_version(*roots: Path) -> str:
    """:return: of all Python sources under these folders: what code that is not changed keeps"""
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
    """Write ``results/NAME.csv``, by a temporary name; rows of other runs with the same keys go."""
    RESULTS.mkdir(exist_ok=True)
    table, path = pd.DataFrame(rows), RESULTS / f"{name}.csv"
    temporary = path.with_suffix(".tmp")
    table.to_csv(temporary, index=False, float_format="%.6g")
    temporary.replace(path)
    return table


class InterruptedRun:
    """
    What the training of a model of SB3 leaves at each mark, until it is through.

    :param folder: of this run alone
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def rows(self) -> list[dict[str, Any]]:
        """:return: of the marks that it came to; empty: of none"""
        path = self.folder / "rows.json"
        return json.loads(path.read_text()) if path.exists() else []

    def model(self, algorithm: type, env: str) -> Any:
        """:return: as it was at its last mark"""
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
    work: Callable[..., list[dict[str, Any]]],
    jobs: int,
    through: Callable[[tuple[Any, ...], list[dict[str, Any]]], bool] = lambda run, rows: True,
) -> None:
    """
    Add to ``results/NAME.csv`` what is not in it yet. A run that fails is reported and left out.

    :param keys: columns that tell runs apart
    :param wanted: their values, run by run
    :param work: from these values to the run's rows
    :param jobs: how many runs at a time
    :param through: of a run and its rows that are there, whether it is at its end; what one that is
        not comes to takes the place of its rows
    """
    path = RESULTS / f"{name}.csv"
    rows = pd.read_csv(path).to_dict("records") if path.exists() else []
    before: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
    for row in rows:
        before.setdefault(tuple(row[key] for key in keys), []).append(row)
    done, lock = {run for run, its in before.items() if through(run, its)}, Lock()

    def one(run: tuple[Any, ...]) -> None:
        label = ", ".join(map(str, run))
        try:
            found = work(*run)
        except RuntimeError as error:
            print(f"{label}: {error}", file=sys.stderr, flush=True)
            return
        with lock:
            rows[:] = [row for row in rows if tuple(row[key] for key in keys) != run]
            rows.extend(dict(zip(keys, run, strict=True)) | row for row in found)
            save(rows, name)
        print(f"{time.strftime('%H:%M:%S')} {label}", file=sys.stderr, flush=True)

    with ThreadPoolExecutor(jobs) as pool:
        list(pool.map(one, [run for run in wanted if run not in done]))
