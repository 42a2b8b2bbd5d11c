"""Fresh processes with an empty compilation cache, and tables that survive an interrupted run."""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pandas as pd

RESULTS = Path(__file__).parent / "results"


def fresh_process(script: str, *arguments: Any) -> dict[str, Any]:
    """
    Run a benchmark's worker in a process of its own.

    The worker finds the moment of its start [s since the epoch] in ``BENCHMARK_START`` and prints
    one line of JSON last.

    :raises RuntimeError: with the worker's last lines, if it failed
    """
    with tempfile.TemporaryDirectory() as cache:
        surroundings = os.environ | {
            "SB3_HDS_CACHE": cache,
            "JAX_COMPILATION_CACHE_DIR": "",
            "BENCHMARK_START": repr(time.time()),
        }
        command = [sys.executable, script, "--worker", *map(str, arguments)]
        done = subprocess.run(command, env=surroundings, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"{' '.join(command)} failed:\n{done.stderr[-3000:]}")
    return json.loads(done.stdout.strip().splitlines()[-1])


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
