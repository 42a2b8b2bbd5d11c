"""What the benchmarks compute from their tables, and what they keep between runs."""

import pandas as pd
import sim_to_real


def runs_of(cell, seeds, methods=("wrong_twin", "ceiling", "randomised", "hds")):
    """The wrong twin gets 0, the ceiling 100; HDS closes 0.2, 0.6 and 0.9 of it."""
    returns = {"wrong_twin": [0.0], "ceiling": [100.0], "randomised": [50.0]}
    returns["hds"] = [20.0, 60.0, 90.0]
    rows = [
        (cell, method, seed, 0 if len(returns[method]) == 1 else episodes, value)
        for seed in range(seeds)
        for method in methods
        for episodes, value in zip(sim_to_real.STEPS, returns[method], strict=False)
    ]
    return pd.DataFrame(rows, columns=["cell", "method", "seed", "episodes", "return"])


def test_a_median_leaves_out_cells_that_have_not_run_yet():
    table = pd.concat([runs_of("light", 3), runs_of("heavy", 3, ("wrong_twin", "ceiling"))])
    found = sim_to_real.over_cells(table, ["light", "heavy"], n_draws=10)
    found = found.set_index(["method", "episodes"])
    assert found.loc[("hds", 10), ["closed", "cells"]].tolist() == [0.9, 1]
    assert found.loc[("randomised", 0), ["closed", "cells"]].tolist() == [0.5, 1]


def test_a_median_of_what_nobody_has_run_is_left_out():
    table = runs_of("light", 2, ("wrong_twin", "ceiling"))
    assert sim_to_real.over_cells(table, ["light"], n_draws=10).empty


def test_seeds_that_have_not_run_yet_do_not_count():
    table = runs_of("light", 3)
    table = table[(table["method"] != "hds") | (table["seed"] == 0)]
    found = sim_to_real.over_cells(table, ["light"], n_draws=10).set_index(["method", "episodes"])
    assert found.loc[("hds", 10), "closed"] == 0.9


def test_a_report_without_any_gap_says_what_is_missing(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(sim_to_real, "RESULTS", tmp_path)
    runs_of("light", 1, ("wrong_twin",)).to_csv(tmp_path / "sim_to_real.csv", index=False)
    sim_to_real.report()
    assert "wrong twin and the ceiling" in capsys.readouterr().out
