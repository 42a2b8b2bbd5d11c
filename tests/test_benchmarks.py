"""What the benchmarks compute from their tables, and what they keep between runs."""

import hardware
import hds_parts
import numpy as np
import pandas as pd
import pytest
import runs
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


def test_a_median_leaves_out_cells_and_seeds_that_have_not_run_yet():
    light, heavy = runs_of("light", 3), runs_of("heavy", 3, ("wrong_twin", "ceiling"))
    light = light[(light["method"] != "hds") | (light["seed"] == 0)]
    found = sim_to_real.over_cells(pd.concat([light, heavy]), ["light", "heavy"], n_draws=10)
    found = found.set_index(["method", "episodes"])
    assert found.loc[("hds", 10), ["closed", "cells"]].tolist() == [0.9, 1]
    assert found.loc[("randomised", 0), ["closed", "cells"]].tolist() == [0.5, 1]
    assert sim_to_real.over_cells(heavy, ["heavy"], n_draws=10).empty


def test_leads_are_those_of_equal_seeds_after_as_many_steps():
    table = runs_of("light", 2)
    sac = table[table["method"] == "hds"].assign(method="sac")
    sac["return"] += [-5.0, -5.0, -5.0, -5.0, 1.0, -5.0]
    found = sim_to_real.seed_by_seed(pd.concat([table, sac]))
    assert found.to_numpy().tolist() == [["sac", 6, 1, -1.0]]
    assert sim_to_real.seed_by_seed(table).empty


def test_a_code_version_is_that_of_what_is_written_in_the_files(tmp_path):
    inner = tmp_path / "inner"
    inner.mkdir()
    seen = []
    for name, text in (("learner.py", "rate = 1"), ("notes.txt", "-"), ("learner.py", "rate = 2")):
        (inner / name).write_text(text)
        seen.append(runs.code_version(tmp_path))
    (inner / "learner.py").rename(tmp_path / "learner.py")
    seen.append(runs.code_version(tmp_path))

    assert seen[0] == seen[1] and len(set(seen)) == 3


def test_a_pretrained_model_of_other_code_is_not_used(monkeypatch):
    before = hardware.kept_at("Pendulum", 0, {"randomisation": 1.0})
    monkeypatch.setattr(hardware, "code_version", lambda root: "another")
    assert hardware.kept_at("Pendulum", 0, {"randomisation": 1.0}) != before


def test_the_twin_of_euler_steps_is_wrong_in_nothing_but_its_integrator():
    system, twin = hardware.make("euler steps").unwrapped, hardware.data_sheet("euler steps")
    assert twin.name == "Pendulum"
    assert twin.values == {name: getattr(system, name) for name in twin.values}
    assert (system.friction, system.drag, system.delay, system.noise) == (0.0, 0.0, 0.0, 0.0)


def parts_of(returns):
    rows = [(variant, seed, x) for variant, own in returns.items() for seed, x in enumerate(own)]
    return pd.DataFrame(rows, columns=["variant", "seed", "return"])


def test_the_parts_of_hds_close_a_share_of_the_gap_over_seeds_that_have_both_ends():
    rows = parts_of({"as it is": [5.0, 15.0, 99.0], "wrong twin": [0.0, 10.0], "ceiling": [10, 30]})
    found = hds_parts.closed(rows, rows)
    assert found["as it is"] == pytest.approx(10.0 / 30.0)
    assert (found["wrong twin"], found["ceiling"]) == (0.0, 1.0)
    assert hds_parts.closed(rows, rows[rows["variant"] != "ceiling"]) == {}


def test_a_figure_shows_every_variant():
    variants = hds_parts.VARIANTS["beta"]
    rows = parts_of({variant: np.arange(2.0) for variant in variants})
    rows["gradient_norm"] = rows["derivative_worst"] = 1.0

    drawing = hds_parts.FIGURES["beta"](rows)

    drawing.canvas.draw()
    assert {tick.get_text() for tick in drawing.axes[0].get_xticklabels()} == set(variants)


def test_a_run_that_was_stopped_before_its_end_is_made_again_in_place(monkeypatch, tmp_path):
    monkeypatch.setattr(runs, "RESULTS", tmp_path)
    half, whole = ({"seed": seed, "mark": mark} for seed, mark in ((0, 1), (1, 2)))
    runs.save([half, whole], "table")
    asked = []

    def work(seed):
        asked.append(seed)
        return [{"mark": 1}, {"mark": 2}]

    at_its_end = lambda run, rows: rows[-1]["mark"] == 2  # noqa: E731
    runs.resume("table", ("seed",), [(0,), (1,)], work, 1, at_its_end)

    assert asked == [0]
    found = pd.read_csv(tmp_path / "table.csv")
    assert found.to_dict("list") == {"seed": [1, 0, 0], "mark": [2, 1, 2]}
