"""
The time and memory of a diagnosis against the number of recordings.

    python benchmarks/diagnosis_cost.py
    python benchmarks/diagnosis_cost.py --systems pendulum --recordings 10 30 --budgets quick
    python benchmarks/diagnosis_cost.py --report-only

The data are recordings of 200 steps of a pendulum and a double pendulum on MuJoCo's engine with dry
friction, diagnosed with the full catalogue. Each row is a fresh process: first with an empty
compilation cache, then with the cache of the first one. Starting Python and making the data do not
count. Processor seconds are the sum over all cores and hardly depend on other load. Memory is the
peak resident size of the process. A straight line is fitted to the seconds by relative errors; the
table of lines has its coefficients, its largest deviation, and the exponent between the two largest
numbers of recordings, which is 1 where the cost is linear. Finished rows are kept.
"""

import argparse
import dataclasses
import resource
import shutil
import time
from collections.abc import Iterable

import numpy as np
import pandas as pd
from hidden_cases import nominal_twin, nothing, recorded
from independent_rigs import Planted
from runs import CACHE, RESULTS, arguments_of, fresh_process, resume, seconds_since_start

RECORDINGS = (10, 30, 100, 300, 1000)
BUDGETS = ("quick", "full")
#: systems, and the dry friction at their first joint [N m]
SYSTEMS = {"pendulum": 0.05, "double_pendulum": 0.05}
NOISE = "1 %"
#: target for the seconds of ten recordings, compilation included
TARGETS = {"quick": 15.0, "full": 60.0}
# Two numbers always lie on a line.
_FEWEST = 3
_LINES = ("system", "budget", "cache")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument("--systems", nargs="*", default=list(SYSTEMS), choices=SYSTEMS)
    parser.add_argument("--recordings", nargs="*", type=int, default=list(RECORDINGS))
    parser.add_argument("--budgets", nargs="*", default=list(BUDGETS), choices=BUDGETS)
    parser.add_argument("--report-only", action="store_true")
    arguments = arguments_of(parser, worker)
    if not arguments.report_only:
        wanted = [
            (system, budget, n)
            for n in arguments.recordings
            for system in arguments.systems
            for budget in arguments.budgets
        ]
        resume("diagnosis_cost", ("system", "budget", "recordings"), wanted, cold_and_warm, jobs=1)
    table = pd.read_csv(RESULTS / "diagnosis_cost.csv")
    print(table.to_string(index=False, float_format="%.3g"))
    lines = straight_lines(table)
    lines.to_csv(RESULTS / "diagnosis_cost_lines.csv", index=False, float_format="%.3g")
    print(lines.to_string(index=False, float_format="%.3g"))
    figure(table)


def cold_and_warm(system: str, budget: str, n: int) -> list[dict]:
    """Run the same diagnosis in two processes; the second has the cache of the first."""
    folder = CACHE / "cost"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    return [
        {"cache": cache} | fresh_process(__file__, system, budget, n, cache=folder)
        for cache in ("empty", "warm")
    ]


def worker(system: str, budget: str, n: int) -> dict:
    planted = Planted("coulomb_friction", 0, {"tau_c": SYSTEMS[system]})
    case = dataclasses.replace(nothing(system, NOISE, recordings=n), planted=(planted,))
    data, _ = recorded(case, seed=n)
    twin = nominal_twin(system)
    simulated, busy = seconds_since_start(), time.process_time()
    from sb3_hds import diagnose

    found = diagnose(twin, data, budget=budget, progress=False)
    return {
        "seconds": seconds_since_start() - simulated,
        "processor_seconds": time.process_time() - busy,
        "peak_memory_MiB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "verdict": found.verdict,
        "named": " ".join(f"{f.effect}.{f.where['name']}" for f in found.findings),
    }


def straight_lines(table: pd.DataFrame) -> pd.DataFrame:
    """Fit a straight line for each system, budget and state of the compilation cache."""
    rows = []
    for label, own in table.groupby(list(_LINES), sort=False):
        own = own.sort_values("recordings")
        row = dict(zip(_LINES, label, strict=True)) | fitted(own["recordings"], own["seconds"])
        ten = own.loc[own["recordings"] == 10, "seconds"]
        if row["cache"] == "empty" and len(ten):
            row["target_seconds"] = TARGETS[row["budget"]]
            row["reached"] = "yes" if ten.iloc[0] <= row["target_seconds"] else "no"
        rows.append(row)
    return pd.DataFrame(rows)


def fitted(recordings: Iterable[float], seconds: Iterable[float]) -> dict[str, float]:
    """
    :return: seconds that do not depend on the number of recordings, those of a hundred, the largest
        relative distance from this line, and the exponent between the last two numbers
    """
    n, t = (np.array(list(x), float) for x in (recordings, seconds))
    if len(n) < _FEWEST:
        return {}
    matrix = np.stack([np.ones_like(n), n], 1)
    fixed, each = np.linalg.lstsq(matrix / t[:, None], np.ones_like(t), rcond=None)[0]
    return {
        "fixed_seconds": float(fixed),
        "seconds_per_hundred": float(100.0 * each),
        "largest_deviation": float(np.max(np.abs((fixed + each * n) / t - 1.0))),
        "exponent": float(np.log(t[-1] / t[-2]) / np.log(n[-1] / n[-2])),
    }


def figure(table: pd.DataFrame) -> None:
    """Seconds against recordings."""
    from matplotlib.figure import Figure

    systems = list(dict.fromkeys(table["system"]))
    drawing = Figure(figsize=(4.2 * len(systems), 3.4), layout="constrained")
    panels = drawing.subplots(1, len(systems), squeeze=False, sharey=True)[0]
    for panel, system in zip(panels, systems, strict=True):
        for budget, colour in zip(BUDGETS, ("#7fa6cc", "#27496d"), strict=True):
            for cache, line in (("empty", "o-"), ("warm", "o:")):
                own = (table["system"] == system) & (table["budget"] == budget)
                rows = table[own & (table["cache"] == cache)].sort_values("recordings")
                label = f"{budget}, {cache} cache"
                panel.loglog(rows["recordings"], rows["seconds"], line, color=colour, label=label)
        panel.set_title(system.replace("_", " "))
        panel.set_xlabel("recordings of 200 steps")
    panels[0].set_ylabel("seconds")
    panels[0].legend(frameon=False, fontsize=8)
    drawing.savefig(RESULTS / "diagnosis_cost.png", dpi=150)


if __name__ == "__main__":
    main()
