"""
What a diagnosis costs against the number of recordings.

    python benchmarks/diagnosis_cost.py
    python benchmarks/diagnosis_cost.py --recordings 10 30 --budgets quick

A pendulum on MuJoCo's engine with dry friction that `diagnose` is not told of, against the whole
catalogue; recordings of 200 steps. One fresh process for each row, nothing compiled beforehand.
Memory is the peak resident size of the process. Finished rows are kept.
"""

import argparse
import json
import resource

import numpy as np
import pandas as pd
from hidden_effects import believed, recorded
from independent_rigs import Planted
from runs import RESULTS, fresh_process, resume, seconds_since_start

RECORDINGS = (10, 30, 100, 300, 1000)
BUDGETS = ("quick", "full")
SYSTEM, NOISE, FRICTION = "pendulum", "1 %", 0.05


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument("--recordings", nargs="*", type=int, default=list(RECORDINGS))
    parser.add_argument("--budgets", nargs="*", default=list(BUDGETS), choices=BUDGETS)
    parser.add_argument("--worker", nargs=2, metavar=("BUDGET", "RECORDINGS"))
    arguments = parser.parse_args()
    if arguments.worker:
        budget, n = arguments.worker
        print(json.dumps({"rows": [worker(budget, int(n))]}))
        return
    wanted = [(budget, n) for n in arguments.recordings for budget in arguments.budgets]
    in_process = lambda *run: fresh_process(__file__, *run)["rows"]  # noqa: E731
    resume("diagnosis_cost", ("budget", "recordings"), wanted, in_process, jobs=1)
    table = pd.read_csv(RESULTS / "diagnosis_cost.csv")
    print(table.to_string(index=False, float_format="%.3g"))
    figure(table)


def worker(budget: str, n: int) -> dict:
    data = recorded(
        SYSTEM,
        [Planted("coulomb_friction", 0, {"tau_c": FRICTION})],
        NOISE,
        np.random.default_rng(n),
        n,
    )
    simulated = seconds_since_start()
    from sb3_hds import diagnose

    found = diagnose(believed(SYSTEM), data, budget=budget, progress=False)
    return {
        "seconds": seconds_since_start() - simulated,
        "peak_memory_MiB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "verdict": found.verdict,
        "named": " ".join(f.effect for f in found.findings),
    }


def figure(table: pd.DataFrame) -> None:
    """Seconds against recordings."""
    from matplotlib.figure import Figure

    drawing = Figure(figsize=(4.5, 3.2), layout="constrained")
    panel = drawing.subplots()
    for budget, colour in zip(BUDGETS, ("#7fa6cc", "#27496d"), strict=True):
        rows = table[table["budget"] == budget].sort_values("recordings")
        panel.loglog(rows["recordings"], rows["seconds"], "o-", color=colour, label=budget)
    panel.set_xlabel("recordings of 200 steps")
    panel.set_ylabel("seconds, compilation included")
    panel.legend(frameon=False)
    drawing.savefig(RESULTS / "diagnosis_cost.png", dpi=150)


if __name__ == "__main__":
    main()
