"""
The import time of the package compared with its peers.

    python benchmarks/import_time.py

Each import is a fresh interpreter; the packages alternate within each round, so that a slow moment
affects all. ``ratio`` compares medians to that of gymnasium, which registers the ids of
environments.
"""

import argparse
import subprocess
import sys

import pandas as pd
from runs import save

PEERS = ("numpy", "gymnasium", "sb3_hds", "stable_baselines3", "sbx")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("--rounds", type=int, default=10)
    rounds = parser.parse_args().rounds
    seconds = pd.DataFrame(
        [{peer: seconds_to_import(peer) for peer in PEERS} for _ in range(rounds)]
    )
    rows = [
        {
            "package": peer,
            "min_s": seconds[peer].min(),
            "median_s": seconds[peer].median(),
            "ratio": seconds[peer].median() / seconds["gymnasium"].median(),
            "rounds": rounds,
        }
        for peer in PEERS
    ]
    print(save(rows, "import_time").to_string(index=False, float_format="%.3f"))


def seconds_to_import(package: str) -> float:
    code = (
        f"import time; start = time.perf_counter(); import {package};"
        "print(time.perf_counter() - start)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return float(done.stdout.split()[-1])


if __name__ == "__main__":
    main()
