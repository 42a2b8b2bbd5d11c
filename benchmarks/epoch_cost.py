"""
The cost of a planning epoch against the number of rollouts, and the parts of a cold start.

    python benchmarks/epoch_cost.py

Pendulum-v1 with default arguments except ``n_rollouts``; one fresh process per row. Memory is the
peak resident size of the process. Planning grows with the number of rollouts, the regression does
not (96 steps of 512 samples): both are timed.
"""

import argparse
import resource
import sys
import time

from runs import RESULTS, arguments_of, fresh_process, save, seconds_since_start

ROLLOUTS = (64, 128, 256, 512, 1024, 2048, 4096, 8192, 16384)
N_EPOCHS = 5


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    arguments_of(parser, worker)
    rows = []
    for n_rollouts in ROLLOUTS:
        print(f"{n_rollouts} rollouts ...", file=sys.stderr, flush=True)
        rows.append({"n_rollouts": n_rollouts, **fresh_process(__file__, n_rollouts)})
        table = save(rows, "epoch_cost")
    print(table.to_string(index=False, float_format="%.3f"))
    figure(table)


def figure(table) -> None:
    """Time of an epoch and of its planning, and memory, against the number of rollouts."""
    from matplotlib.figure import Figure

    drawing = Figure(figsize=(8.0, 3.0), layout="constrained")
    left, right = drawing.subplots(1, 2)
    left.loglog(table["n_rollouts"], table["epoch_ms"], "o-", color="#27496d", label="epoch")
    left.loglog(table["n_rollouts"], table["planning_ms"], "o--", color="#d1495b", label="planning")
    left.set_ylabel("time [ms]")
    left.legend(frameon=False)
    right.semilogx(table["n_rollouts"], table["peak_memory_MiB"], "o-", color="#27496d")
    right.set_ylim(bottom=0.0)
    right.set_ylabel("peak memory of the process [MiB]")
    for panel in (left, right):
        panel.set_xlabel("rollouts in an epoch")
    drawing.savefig(RESULTS / "epoch_cost.png", dpi=150)


def worker(n_rollouts: int) -> dict:
    interpreter = seconds_since_start()
    import jax

    from sb3_hds import HDS

    imported = seconds_since_start()
    model = HDS("Pendulum-v1", n_rollouts=n_rollouts, pretrain_epochs=1, seed=0)
    constructed = seconds_since_start()
    model.learn(0)
    first = seconds_since_start()
    epoch, planning = timed(model, jax, model.gradient_steps), timed(model, jax, 1)
    return {
        "interpreter_s": interpreter,
        "import_s": imported - interpreter,
        "construct_s": constructed - imported,
        "compile_and_first_epoch_s": first - constructed,
        "epoch_ms": 1e3 * epoch,
        "planning_ms": 1e3 * planning,
        "twin_steps_per_epoch": model.twin_timesteps // model.n_pretrained,
        "peak_memory_MiB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }


def timed(model, jax, gradient_steps: int) -> float:
    """:return: seconds of one epoch, the smallest of a few"""
    seconds = []
    for _ in range(N_EPOCHS):
        begin = time.perf_counter()
        model.run_epoch(gradient_steps)
        jax.block_until_ready(model.policy.networks)
        seconds.append(time.perf_counter() - begin)
    return min(seconds)


if __name__ == "__main__":
    main()
