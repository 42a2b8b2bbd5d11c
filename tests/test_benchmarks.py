"""What benchmarks run, compute from their tables, and save between runs."""

from importlib.util import find_spec
from inspect import signature
from pathlib import Path

import intervals
import model_free
import numpy as np
import pandas as pd
import pytest
import runs
import sim_to_real
from model_free import LENGTHS, ONLY_ON, OURS, PEERS

from rl_zoo_plugin.lazy import parameters_of


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


def test_a_worker_gets_values_of_the_types_of_its_parameters_and_its_result_comes_back(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(
        f"""
import argparse, sys
sys.path.insert(0, {str(Path(runs.__file__).parent)!r})
from runs import arguments_of

def worker(name: str, seed: int, share: float) -> list:
    return [{{name: seed + share}}]

arguments_of(argparse.ArgumentParser(), worker)
"""
    )
    assert runs.fresh_process(str(script), "a, b", 1, 0.5) == [{"a, b": 1.5}]


@pytest.mark.skipif(find_spec("rl_zoo3") is None, reason="needs the extra 'zoo'")
def test_every_setting_of_a_method_is_an_argument_of_its_class():
    for method in (*OURS, *PEERS):
        for env in ONLY_ON.get(method, LENGTHS):
            algorithm, settings = model_free.made_of(env, method)
            known = parameters_of(algorithm) if method in OURS else signature(algorithm).parameters
            assert set(settings) <= set(known), (env, method)
            assert len(model_free.marks(env, method)) > 1


def test_intervals_are_those_of_rliable():
    library = pytest.importorskip("rliable.library")
    metrics = pytest.importorskip("rliable.metrics")
    rng = np.random.default_rng(0)
    ours, theirs = rng.normal(size=5), rng.normal(0.3, 2.0, size=8)
    of_mean = lambda scores: np.array([metrics.aggregate_mean(scores)])  # noqa: E731

    points, limits = library.get_interval_estimates({"ours": ours[:, None]}, of_mean, reps=10_000)

    mean, low, high = intervals.of_mean(ours)
    assert mean == pytest.approx(points["ours"][0])
    # Three standard errors of a 2.5 % quantile of 10,000 draws, in deviations of the mean.
    apart = 3.0 * 2.0 * ours.std() / np.sqrt(5) * np.sqrt(0.025 * 0.975 / 10_000) / 0.0584
    np.testing.assert_allclose([low, high], limits["ours"][:, 0], atol=apart)
    chance = metrics.probability_of_improvement(ours[:, None], theirs[:, None])
    assert intervals.probability_of_improvement(ours, theirs) == pytest.approx(chance)
