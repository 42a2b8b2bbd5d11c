"""
The time until a first policy, compared with an earlier version and with SBX's SAC.

    git worktree add /tmp/before COMMIT
    python benchmarks/start_up.py --before /tmp/before --rounds 3
    python benchmarks/start_up.py --table

Pendulum-v1, default arguments, seed 0. Cold: a fresh process with an empty compilation cache. Warm:
a fresh process with the cache of the cold one. The programs alternate, so that a slow moment of the
machine affects all; the table has the smallest of the rounds, in seconds of wall time and of
processor time, which depends less on other load. Columns, each counted from the end of the one
before:

- `base`: the interpreter and `import jax, stable_baselines3`
- `imports`, `construct`: ours, or SBX's
- `first_plan`: to the end of the first planning epoch; for SBX, of the first update
- `epoch_ms`: the shortest epoch

`weights` is a hash of the networks after the first epochs: equal where the numbers are the same.
The commands of `sb3-hds` are timed in the same way.
"""

import argparse
import hashlib
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pandas as pd
from runs import RESULTS, arguments_of, fresh_process, save

HERE = Path(__file__).parent.parent
COMMANDS = ("--help", "effects")
N_EPOCHS = 20
_STEPS_OF_SBX = 110
_MARKS = ("base", "imports", "construct", "first_plan")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("--before", help="checkout of the state before")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--only", nargs="*", default=["ours", "before", "sbx"])
    parser.add_argument("--table", action="store_true")
    arguments = arguments_of(parser, worker)
    if not arguments.table:
        checkouts = {"ours": HERE, "sbx": HERE}
        if arguments.before:
            checkouts["before"] = Path(arguments.before).resolve()
        rows: list[dict[str, Any]] = []
        for number in range(arguments.rounds):
            for who in [each for each in arguments.only if each in checkouts]:
                rows += [row | {"round": number} for row in measured(who, checkouts[who])]
                save(rows, "start_up")
    report()


def worker(who: str, checkout: str, cache: str) -> dict[str, Any]:
    os.environ.pop("JAX_COMPILATION_CACHE_DIR", None)
    os.environ["SB3_HDS_CACHE"] = cache
    sys.path.insert(0, checkout)
    return sbx() if who == "sbx" else hds()


def measured(who: str, checkout: Path) -> list[dict[str, Any]]:
    """:return: a cold start and a warm one, and the commands"""
    rows = []
    with tempfile.TemporaryDirectory() as kept:
        for state in ("cold", "warm"):
            found = fresh_process(__file__, who, checkout, kept)
            rows.append({"who": who, "state": state, **found})
            print(rows[-1], file=sys.stderr, flush=True)
    if who != "sbx":
        rows += [{"who": who, "state": each, **timed(each, checkout)} for each in COMMANDS]
    return rows


def timed(command: str, checkout: Path) -> dict[str, float]:
    """:return: seconds of a command of ``sb3-hds``"""
    before, begin = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    subprocess.run(
        [sys.executable, "-m", "sb3_hds.cli", command],
        env=os.environ | {"PYTHONPATH": str(checkout)},
        check=True,
        stdout=subprocess.DEVNULL,
    )
    wall, after = time.perf_counter() - begin, resource.getrusage(resource.RUSAGE_CHILDREN)
    used = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return {"command_s": wall, "command_cpu_s": used}


class Marks:
    """Seconds between moments, of wall time and of the processor."""

    def __init__(self) -> None:
        self.found: dict[str, Any] = {}
        # Includes the start of the interpreter.
        self._wall = float(os.environ["BENCHMARK_START"]), 0.0

    def mark(self, name: str) -> None:
        now, used = time.time(), time.process_time()
        wall, cpu = self._wall
        self.found |= {f"{name}_s": now - wall, f"{name}_cpu_s": used - cpu}
        self._wall = now, used


def hds() -> dict[str, Any]:
    marks = Marks()
    import jax
    import stable_baselines3  # noqa: F401

    marks.mark("base")
    compiled = counter(jax)
    from sb3_hds import HDS

    marks.mark("imports")
    model = HDS("Pendulum-v1", seed=0)
    marks.mark("construct")
    model.learn(0, callback=lambda *_: model.n_pretrained < 1)
    jax.block_until_ready(model.policy.networks)
    marks.mark("first_plan")
    seconds = []
    for _ in range(N_EPOCHS):
        begin, used = time.perf_counter(), time.process_time()
        model.run_epoch(model.gradient_steps)
        jax.block_until_ready(model.policy.networks)
        seconds.append((time.perf_counter() - begin, time.process_time() - used))
    wall, cpu = (1e3 * min(each) for each in zip(*seconds, strict=True))
    leaves = jax.tree.leaves(model.policy.networks)
    digest = hashlib.blake2b(b"".join(jax.device_get(leaf).tobytes() for leaf in leaves))
    return marks.found | {
        "epoch_ms": wall,
        "epoch_cpu_ms": cpu,
        "weights": digest.hexdigest()[:8],
        "compiled": compiled(),
    }


def sbx() -> dict[str, Any]:
    marks = Marks()
    import jax
    import stable_baselines3  # noqa: F401

    marks.mark("base")
    compiled = counter(jax)
    from sbx import SAC

    marks.mark("imports")
    model = SAC("MlpPolicy", "Pendulum-v1", seed=0)
    marks.mark("construct")
    model.learn(_STEPS_OF_SBX)
    marks.mark("first_plan")
    return marks.found | {"compiled": compiled()}


def counter(jax: Any) -> Callable[[], int]:
    """:return: function that returns how many programs were compiled, cached ones not counted"""
    counts = {"backend_compile_duration": 0, "cache_hits": 0}

    def count(event: str, *_: Any, **__: Any) -> None:
        name = event.split("/")[-1]
        if name in counts:
            counts[name] += 1

    jax.monitoring.register_event_duration_secs_listener(count)
    jax.monitoring.register_event_listener(count)
    return lambda: counts["backend_compile_duration"] - counts["cache_hits"]


def report() -> None:
    rows = pd.read_csv(RESULTS / "start_up.csv")
    numbers = rows.select_dtypes("number").columns.difference(["round"])
    least = rows.groupby(["who", "state"])[list(numbers)].min()
    for kind in ("", "_cpu"):
        parts = [f"{mark}{kind}_s" for mark in _MARKS]
        least[f"own{kind}_s"] = least[parts[1]] + least[parts[2]]
        least[f"total{kind}_s"] = least[parts].sum(axis=1, min_count=len(parts))
    print(least.T.to_string(float_format="%.3f"))
    save(summary(least), "start_up_summary")
    if {"ours", "before"} <= set(least.index.levels[0]):
        print("\nours, as a share of before:")
        print((least.loc["ours"] / least.loc["before"]).T.to_string(float_format="%.2f"))


def summary(least: pd.DataFrame) -> list[dict[str, Any]]:
    """:return: one row for each start, for the docs"""
    starts = {"before": "before", "ours": "now", "sbx": "SBX SAC"}
    return [
        {
            "version": name,
            "start": state,
            "own imports and construction [s]": row["own_s"],
            "first plan or update after construction [s]": row["first_plan_s"],
            "total [s]": row["total_s"],
            "processor [s]": row["total_cpu_s"],
            "programs compiled": row["compiled"],
            "epoch [ms]": row["epoch_ms"],
        }
        for who, name in starts.items()
        for state in ("cold", "warm")
        if (who, state) in least.index
        for row in [least.loc[(who, state)]]
    ]


if __name__ == "__main__":
    main()
