"""Runs of a study that go on from a checkpoint, and studies on a Ray cluster of two nodes."""

import subprocess
import sys
import time

import numpy as np
import pytest
import yaml
from test_study import writer

from sb3_hds.errors import StudyError
from sb3_hds.experiments.study import Study, progress_of, run_study, zoo_command

PLAN = {
    "algorithms": ["sac"],
    "envs": ["Pendulum-v1"],
    "seeds": 1,
    "budget": {"steps": 400},
    "evaluation": {"every": 100, "episodes": 1},
}


def study_of(folder, **changes):
    (folder / "study.yml").write_text(yaml.safe_dump(PLAN | changes))
    return Study.load(folder / "study.yml")


def steps_in(clock):
    lines = clock.read_text().split()[1:] if clock.exists() else []
    return [0, *(int(line.partition(",")[0]) for line in lines)]


@pytest.mark.expensive
@pytest.mark.parametrize("algo", ["sac", "hds"])
def test_a_run_that_is_killed_goes_on_from_its_checkpoint(algo, tmp_path):
    study, folder = study_of(tmp_path, algorithms=[algo]), tmp_path / "logs"
    code = (
        "from sb3_hds.experiments.study import Study, run_study, zoo_command\n"
        f"study = Study.load({str(tmp_path / 'study.yml')!r})\n"
        f"run_study(study, {str(folder)!r}, command=zoo_command(study, 0.02))\n"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.DEVNULL) as process:
        written = folder / ".checkpoints" / f"{algo}-Pendulum-v1_1"
        deadline = time.monotonic() + 300.0
        while time.monotonic() < deadline and steps_in(written / "clock.csv")[-1] < 100:
            time.sleep(0.05)
        process.kill()
    time.sleep(1.0)
    with np.load(written / "evaluations.npz") as before:
        returns = before["results"]
    reached = steps_in(written / "clock.csv")[-1]
    assert 100 <= reached < 400

    done = run_study(study, folder, command=zoo_command(study, 0.5), tell=lambda _: None)

    assert done.complete == study.runs and not written.exists()
    place = folder / study.runs[0].place
    with np.load(place / "evaluations.npz") as after:
        # Those at step 0 are of planning before the first step.
        assert [t for t in after["timesteps"].tolist() if t] == [100, 200, 300, 400]
        # What had been evaluated is not evaluated again.
        np.testing.assert_array_equal(after["results"][: len(returns)], returns)
    steps = steps_in(place / "clock.csv")
    assert steps == sorted(steps) and reached in steps and steps[-1] >= 400
    assert (place / "before_0.monitor.csv").exists()


# ------------------------------------------------------------------------------ Ray
def test_without_a_cluster_it_is_said_how_to_start_one(tmp_path):
    pytest.importorskip("ray")
    with pytest.raises(StudyError, match="ray start --head"):
        run_study(study_of(tmp_path), tmp_path / "logs", ray="127.0.0.1:1")


@pytest.mark.expensive
def test_a_node_is_lost_and_no_run_is(cluster, tmp_path):
    study = study_of(tmp_path, algorithms=["hds", "droq"], seeds=100)
    ledger, folder, said = tmp_path / "ledger", tmp_path / "logs", []

    def tell(line):
        said.append(line)
        if len(said) == 60:
            cluster.lose_one()

    done = run_study(
        study,
        folder,
        command=writer(ledger, 0.1),
        tell=tell,
        ray=cluster.address,
        memory=0.2,
    )

    assert len(study.runs) == 200 and done.complete == study.runs and not done.failed
    assert len(said) == 200
    for run in study.runs:
        assert (folder / run.place / "progress").read_text() == "0\n1\n2\n3\n4\n"
    # Only what was at work on the node that was lost is made again.
    assert 200 <= ledger.read_text().count("begun") <= 202
    assert {one.state for one in progress_of(study, folder)} == {"complete"}


@pytest.mark.expensive
def test_resources_that_no_node_has_are_refused_and_failures_are_reported(cluster, tmp_path):
    study = study_of(tmp_path, algorithms=["fails", "hds"])
    with pytest.raises(StudyError, match="No node has 64 cores"):
        run_study(study, tmp_path / "logs", ray=cluster.address, cpus=64)

    done = run_study(
        study,
        tmp_path / "logs",
        command=writer(tmp_path / "ledger", 0.0),
        tell=lambda _: None,
        ray=cluster.address,
        memory=0.2,
    )

    assert [run.label for run in done.complete] == ["hds"]
    assert [error for _, error in done.failed] == ["the learner broke"]
