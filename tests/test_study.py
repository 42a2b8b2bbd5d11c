"""Studies: run, killed, run again, reported."""

import json
import random
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import yaml

from sb3_hds.cli import main
from sb3_hds.errors import StudyError
from sb3_hds.experiments.study import (
    Study,
    progress_of,
    report,
    results_of,
    run_study,
    seconds_to_go,
    write_report,
    zoo_command,
)
from sb3_hds.experiments.study.report import normalized_scores

PLAN = {
    "name": "small",
    "algorithms": ["hds", {"label": "droq_wide", "algo": "droq", "hyperparams": {"tau": 0.1}}],
    "envs": ["Pendulum-v1", {"id": "sb3_hds/PayloadPendulum-v0", "kwargs": {"mass": 2.0}}],
    "seeds": 2,
    "budget": {"steps": 400},
    "evaluation": {"every": 100, "episodes": 3},
}

# What the zoo writes, by a process that takes a moment and ends with its standard input, like the
# zoo's: the runner is tested, not the learner.
WRITER = """
import os, pathlib, sys, threading, time
logs, clock, algo, env, seed, ledger, moment = sys.argv[1:]
def end():
    while os.read(0, 4096): pass
    os._exit(1)
threading.Thread(target=end, daemon=True).start()
name = f"{algo} {env} {seed}"
with open(ledger, "a") as file: file.write("begun " + name + "\\n")
name_of_env = env.replace("/", "-")
folder = pathlib.Path(logs, algo, name_of_env + "_1"); (folder / name_of_env).mkdir(parents=True)
(folder / name_of_env / "command.txt").write_text(" ".join(sys.orig_argv[3:]))
pathlib.Path(clock).write_text("timesteps,seconds\\n0,0.0\\n")
for i in range(5):
    time.sleep(float(moment) / 5)
    with open(folder / "progress", "a") as file: file.write(f"{i}\\n")
with open(clock, "a") as file: file.write("400,2.0\\n")
with open(ledger, "a") as file: file.write("through " + name + "\\n")
if algo == "fails": sys.exit("the learner broke")
"""


def study_of(folder: Path, **changes) -> Study:
    file = folder / "study.yml"
    file.write_text(yaml.safe_dump(PLAN | changes))
    return Study.load(file)


def writer(ledger: Path, moment: float = 0.0):
    def command(run, logs, clock, checkpoint):
        told = [logs, clock, run.algo, run.env, run.seed, ledger, moment]
        return [sys.executable, "-c", WRITER, *map(str, told)]

    return command


def test_a_study_is_the_product_of_its_lists(tmp_path):
    study = study_of(tmp_path)

    assert len(study.runs) == 8 and (study.steps, study.every, study.episodes) == (400, 100, 3)
    assert [str(run.place) for run in study.runs[:3]] == [
        "hds/Pendulum-v1_1",
        "hds/Pendulum-v1_2",
        "hds/sb3_hds-PayloadPendulum-v0_1",
    ]
    assert study.runs[-1].hyperparams == {"tau": 0.1}


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"budgett": 1}, "Did you mean 'budget'"),
        ({"budget": {}}, "lacks 'budget'"),
        ({"budget": {"steps": -3}}, "steps must be a number above 0"),
        ({"budget": {"steps": "many"}}, "steps must be a number above 0, or file"),
        ({"evaluation": {"often": 3}}, "takes every, episodes"),
        ({"algorithms": [{"label": "x"}]}, "lacks 'algo'"),
        ({"algorithms": [{"label": "Wide", "algo": "droq"}]}, "lower case"),
        ({"algorithms": ["droq", {"algo": "droq", "hyperparams": {"tau": 0.1}}]}, "its own label"),
    ],
)
def test_what_a_study_cannot_be_is_refused(changes, why, tmp_path):
    with pytest.raises(StudyError, match=why):
        study_of(tmp_path, **changes)


def test_the_zoo_command_contains_all_settings(tmp_path):
    study = study_of(tmp_path, budget={"steps": 400, "minutes": 0.5})

    words = zoo_command(study)(
        study.runs[-1], *map(tmp_path.joinpath, ("logs", "clock.csv", "last"))
    )

    text = " ".join(words)
    assert "--algo droq --env sb3_hds/PayloadPendulum-v0 --seed 1 -f" in text
    assert "-n 400" in text
    assert "--eval-freq 100 --eval-episodes 3 -params tau:0.1 --env-kwargs mass:2.0" in text
    assert words[4] == "0.5" and words[5].endswith("last") and words[6] == "5.0"


def test_steps_may_be_those_of_the_hyperparameter_file_and_environments_of_one_algorithm(tmp_path):
    own = {"algo": "hds", "envs": ["InvertedPendulum-v5"]}
    study = study_of(tmp_path, algorithms=[own, "droq"], budget={"steps": "file"}, seeds=1)

    words = zoo_command(study)(study.runs[0], *map(tmp_path.joinpath, ("logs", "clock", "last")))

    assert [str(run.place.parent / run.env_name) for run in study.runs] == [
        "hds/InvertedPendulum-v5",
        "droq/Pendulum-v1",
        "droq/sb3_hds-PayloadPendulum-v0",
    ]
    # Without a number, the zoo trains for n_timesteps of the file.
    assert "-n" not in words and study.settings(study.runs[0])["steps"] == "file"


def test_an_interval_between_checkpoints_is_not_negative(tmp_path):
    with pytest.raises(StudyError, match="must be 0 or more, got -1"):
        zoo_command(study_of(tmp_path), -1.0)


def test_runs_are_complete_or_not_there_and_none_is_run_twice(tmp_path):
    study, folder, ledger = study_of(tmp_path), tmp_path / "logs", tmp_path / "ledger"

    first = run_study(study, folder, jobs=3, command=writer(ledger), tell=lambda _: None)
    again = run_study(study, folder, jobs=3, command=writer(ledger), tell=lambda _: None)

    assert first.complete == again.complete == study.runs and not again.failed
    assert ledger.read_text().count("through") == 8
    told = json.loads((folder / "droq_wide" / "Pendulum-v1_2" / "study.json").read_text())
    assert told["settings"]["hyperparams"] == {"tau": 0.1} and told["versions"]["jax"]


def test_a_complete_run_names_the_folder_as_the_user_did_and_no_other_path(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    study = study_of(tmp_path, envs=["Pendulum-v1"], seeds=1)

    run_study(study, "logs/small", command=writer(Path("ledger")), tell=lambda _: None)

    place = tmp_path / "logs" / "small" / "hds" / "Pendulum-v1_1"
    told = json.loads((place / "study.json").read_text())["command"]
    assert told[0] == "python" and told[3:5] == ["logs/small", "logs/small/clock.csv"]
    assert (place / "Pendulum-v1" / "command.txt").read_text().startswith("logs/small ")


def test_a_study_that_is_killed_at_any_moment_goes_on(tmp_path):
    folder, ledger = tmp_path / "logs", tmp_path / "ledger"
    study = study_of(tmp_path)
    code = (
        f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r})\n"
        "import pathlib\n"
        "from sb3_hds.experiments.study import Study, run_study\n"
        f"WRITER = {WRITER!r}\n"
        "def command(run, logs, clock, checkpoint):\n"
        f"    told = [logs, clock, run.algo, run.env, run.seed, {str(ledger)!r}, 0.15]\n"
        "    return [sys.executable, '-c', WRITER, *map(str, told)]\n"
        "print('ready', flush=True)\n"
        f"study = Study.load({str(tmp_path / 'study.yml')!r})\n"
        f"run_study(study, {str(folder)!r}, jobs=2, command=command)\n"
    )
    moments = random.Random(0)

    for _ in range(20):
        with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE) as process:
            assert process.stdout is not None and process.stdout.readline() == b"ready\n"
            time.sleep(moments.uniform(0.0, 0.4))
            process.kill()
    time.sleep(0.3)
    done = run_study(study, folder, jobs=2, command=writer(ledger), tell=lambda _: None)

    assert done.complete == study.runs
    for run in study.runs:
        whole = (folder / run.place / "progress").read_text()
        assert whole == "0\n1\n2\n3\n4\n"
    # Killed between its last line and its move, a run is made again; moved, it never is.
    assert ledger.read_text().count("begun") > 8
    before = ledger.read_text()
    run_study(study, folder, command=writer(ledger), tell=lambda _: None)
    assert ledger.read_text() == before


def test_a_failing_run_is_reported_and_stops_no_other(tmp_path):
    study, said = study_of(tmp_path, algorithms=["fails", "hds"], envs=["Pendulum-v1"]), []

    done = run_study(
        study, tmp_path / "logs", command=writer(tmp_path / "ledger"), tell=said.append
    )

    assert [run.label for run in done.complete] == ["hds"] * 2
    assert [error for _, error in done.failed] == ["the learner broke"] * 2
    assert sum("failed: the learner broke" in line for line in said) == 2
    states = [one.state for one in progress_of(study, tmp_path / "logs")]
    assert states == ["failed", "failed", "complete", "complete"]


def test_folders_that_are_taken_are_refused(tmp_path):
    study, folder = study_of(tmp_path, envs=["Pendulum-v1"]), tmp_path / "logs"
    run_study(study, folder, command=writer(tmp_path / "ledger"), tell=lambda _: None)

    with pytest.raises(StudyError, match="with different steps"):
        run_study(study_of(tmp_path, envs=["Pendulum-v1"], budget={"steps": 500}), folder)
    (tmp_path / "other" / "hds" / "Pendulum-v1_1").mkdir(parents=True)
    with pytest.raises(StudyError, match="does not belong to a study"):
        run_study(study, tmp_path / "other")


def test_time_to_go_is_that_of_runs_like_it(tmp_path):
    study = study_of(tmp_path, envs=["Pendulum-v1"])
    assert seconds_to_go(study, progress_of(study, tmp_path / "logs"), 1) is None
    only = Study(study.name, study.runs[:2], 400, None, 100, 3)
    run_study(only, tmp_path / "logs", command=writer(tmp_path / "ledger"), tell=lambda _: None)

    # Two runs are left; those that are complete took two seconds each.
    assert seconds_to_go(study, progress_of(study, tmp_path / "logs"), 2) == pytest.approx(2.0)


@pytest.fixture
def evaluated(tmp_path, monkeypatch):
    """A study whose runs have evaluations: droq_wide ends at -100, hds at -200, give or take."""
    monkeypatch.setattr(report, "_REPS", 50)
    study, folder = study_of(tmp_path), tmp_path / "logs"
    run_study(study, folder, command=writer(tmp_path / "ledger"), tell=lambda _: None)
    for run in study.runs:
        end = (-100.0 if run.algo == "droq" else -200.0) - 5.0 * run.seed
        curve = np.linspace(-1000.0, end, 4)
        np.savez(
            folder / run.place / "evaluations.npz",
            timesteps=np.arange(100, 500, 100),
            results=curve[:, None] + np.array([[-1.0, 0.0, 1.0]]),
        )
        config = folder / run.place / run.env_name
        (config / "config.yml").write_text(f"- - gamma\n  - 0.98 # {run.label}\n")
    return study, folder


def test_results_are_on_both_axes(evaluated):
    table = results_of(*evaluated)

    assert len(table) == 8 * 4
    last = table[table["timesteps"] == 400]
    assert set(last["return"]) == {-100.0, -105.0, -200.0, -205.0}
    # The clock said 400 steps after 2 s.
    assert set(last["seconds"]) == {2.0} and table["seconds"].min() == pytest.approx(0.5)


def test_scores_are_normalised_in_each_environment(evaluated):
    scores = normalized_scores(results_of(*evaluated))

    assert {label: grid.shape for label, grid in scores.items()} == {
        "droq_wide": (2, 2),
        "hds": (2, 2),
    }
    # From -1000 to -100.
    np.testing.assert_allclose(scores["droq_wide"][:, 0], [1.0, 895.0 / 900.0])
    np.testing.assert_allclose(scores["hds"][:, 1], [800.0 / 900.0, 795.0 / 900.0])


def test_the_report_is_one_page_with_everything(evaluated, tmp_path):
    study, folder = evaluated

    written = write_report(study, folder, tmp_path / "report.html")

    page = written.page.read_text()
    assert written.n_runs == 8 and len(written.figures) == 8
    assert all(path.stat().st_size > 1_000 for path in written.figures)
    assert "http" not in page and page.count("data:image/png;base64,") == 4
    for text in ("-102.5", "gamma", "8 of 8 runs", "droq_wide", "sb3_hds/PayloadPendulum-v0"):
        assert text in page


def test_the_command_tells_its_status_and_reports(evaluated, tmp_path, capsys):
    _, folder = evaluated
    file = str(tmp_path / "study.yml")

    assert main(["study", "status", file, "--folder", str(folder)]) == 0
    assert "8 of 8 runs are complete" in capsys.readouterr().out
    assert main(["study", "report", file, "--folder", str(folder)]) == 0
    assert (folder / "report.html").exists() and "8 runs" in capsys.readouterr().out
    assert main(["study", "report", file, "--folder", str(tmp_path / "empty")]) == 1
    assert "study run first" in capsys.readouterr().err
    assert main(["study", "status", str(tmp_path / "no.yml")]) == 1
    assert "There is no study" in capsys.readouterr().err


@pytest.mark.expensive
def test_the_zoo_runs_a_study(tmp_path):
    study = study_of(
        tmp_path,
        algorithms=["openloop", {"algo": "gsde_sac", "hyperparams": {"learning_starts": 50}}],
        envs=["Pendulum-v1"],
        seeds=2,
        evaluation={"every": 200, "episodes": 2},
    )

    done = run_study(study, tmp_path / "logs", jobs=1)

    assert done.complete == study.runs, done.failed
    table = results_of(study, tmp_path / "logs")
    assert set(table["timesteps"]) == {200, 400} and (table["seconds"] > 0.0).all()
    place = tmp_path / "logs" / "gsde_sac" / "Pendulum-v1_1"
    assert (place / "Pendulum-v1.zip").exists() and (place / "best_model.zip").exists()
    write_report(study, tmp_path / "logs", tmp_path / "report.html")


@pytest.mark.expensive
def test_a_run_ends_when_its_minutes_are_over(tmp_path):
    study = study_of(
        tmp_path, algorithms=["gsde_sac"], envs=["Pendulum-v1"], seeds=1, budget={"minutes": 0.1}
    )

    run_study(study, tmp_path / "logs")

    (one,) = progress_of(study, tmp_path / "logs")
    assert one.state == "complete" and 6.0 <= one.seconds < 60.0
