"""Several processes tune in one study, and one of them dies."""

import os
import pwd
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from cases import each
from small_models import small
from stable_baselines3.common.env_util import make_vec_env

optuna = pytest.importorskip("optuna")
pytest.importorskip("rl_zoo3")
from optuna.trial import TrialState, create_trial  # noqa: E402

from rl_zoo_plugin import storages  # noqa: E402
from rl_zoo_plugin.pruning import TrialEvaluations  # noqa: E402
from sb3_hds.algos.twin.config import Refinements  # noqa: E402

DONE = (TrialState.COMPLETE, TrialState.PRUNED)
WORKERS, TRIALS = 4, 12
# Between heartbeats [s]: a busy machine may delay one for seconds.
INTERVAL = 5
ZOO = Path(sys.executable).with_name("rl_zoo3")
TUNED = ("--env", "Pendulum-v1", "-optimize", "--no-optim-plots", "--eval-episodes", "1")


# ------------------------------------------------------------------------- storages
def begun(path: str, interval: int = 60):
    """A study with one trial that runs, and its storage."""
    storage = storages.Journal(path, interval)
    study = optuna.create_study(study_name="a", storage=storage, load_if_exists=True)
    trial = study.ask()
    trial.suggest_float("x", 0.0, 1.0)
    return study, storage, trial


def states_of(study) -> list[str]:
    return [trial.state.name for trial in study.trials]


def test_a_stale_trial_fails_and_its_values_are_queued_once(tmp_path, monkeypatch):
    path = str(tmp_path / "journal.log")
    study, storage, trial = begun(path)
    storage.record_heartbeat(trial._trial_id)
    now = time.time()

    monkeypatch.setattr(storages.time, "time", lambda: now + 119.0)
    storages.shared(path, "a")
    assert states_of(study) == ["RUNNING"]
    monkeypatch.setattr(storages.time, "time", lambda: now + 121.0)
    for _ in range(2):
        storages.shared(path, "a")
    assert states_of(study) == ["FAIL", "WAITING"]
    assert study.ask().suggest_float("x", 0.0, 1.0) == trial.params["x"]


def test_a_database_of_sqlite_has_heartbeats_too(tmp_path, monkeypatch):
    monkeypatch.setenv("SB3_HDS_HEARTBEAT", "1")
    url = f"sqlite:///{tmp_path / 'study.db'}"
    study = optuna.create_study(study_name="a", storage=storages.shared(url, "a"))
    dead, alive = study.ask(), study.ask()
    for trial in (dead, alive):
        study._storage.record_heartbeat(trial._trial_id)

    time.sleep(3.2)  # its clock counts whole seconds
    study._storage.record_heartbeat(alive._trial_id)
    storages.shared(url, "a")

    assert states_of(study) == ["FAIL", "RUNNING", "WAITING"]


def test_a_trial_that_has_failed_and_one_without_any_heartbeat_are_left_alone(tmp_path):
    path = str(tmp_path / "journal.log")
    study, storage, trial = begun(path, interval=1)
    study.tell(trial, state=TrialState.FAIL)
    storage.record_heartbeat(trial._trial_id)
    study.ask()  # by a process that records none

    storages.shared(path, "a")

    assert states_of(study) == ["FAIL", "RUNNING"]


@each("0", "soon", "-1")
def test_a_wrong_interval_is_refused(given, monkeypatch, tmp_path):
    monkeypatch.setenv("SB3_HDS_HEARTBEAT", given)
    with pytest.raises(ValueError, match=f"number of seconds .* got '{given}'"):
        storages.shared(str(tmp_path / "journal.log"), None)
    assert storages.shared(None, None) is None


# --------------------------------------------------------------------------- pruning
def learn_in_trial(name, study, **changes):
    """Eight steps, evaluated twice, and as often before them if the algorithm plans."""
    env = make_vec_env("Pendulum-v1")
    callback = TrialEvaluations(env, study.ask(), n_eval_episodes=1, eval_freq=4)
    return small(name, train_freq=4, **changes).learn(8, callback=callback), callback


@pytest.mark.parametrize("name", ["hds", "pods"])
def test_planned_algorithms_are_evaluated_as_often_before_the_first_step_as_after_it(name):
    study = optuna.create_study(pruner=optuna.pruners.NopPruner())

    learn_in_trial(name, study, pretrain_epochs=6)

    # After three and six epochs, then after four and eight steps.
    assert sorted(study.trials[0].intermediate_values) == [1, 2, 3, 4]


def test_evaluations_that_an_early_end_of_the_pretraining_leaves_out_keep_their_numbers(
    monkeypatch,
):
    study = optuna.create_study(pruner=optuna.pruners.NopPruner())
    # No gain is enough to go on after two epochs.
    monkeypatch.setattr("sb3_hds.algos.twin.algorithm._FEWEST_EPOCHS", 2)
    monkeypatch.setitem(Refinements.__init__.__kwdefaults__, "least_gain", 1e9)

    learn_in_trial("hds", study, pretrain_epochs=6)

    assert sorted(study.trials[0].intermediate_values) == [3, 4]


@each(("hds", 0), ("droq", 4))
def test_a_bad_trial_is_pruned_at_its_first_evaluation(name, steps_made):
    study = optuna.create_study(pruner=optuna.pruners.ThresholdPruner(lower=0.0))

    model, callback = learn_in_trial(name, study)

    assert callback.is_pruned and set(study.trials[0].intermediate_values) == {1}
    # One that plans is pruned before it has acted.
    assert model.num_timesteps == steps_made


@pytest.mark.expensive
def test_the_zoo_prunes_a_planned_algorithm_while_it_plans(journal, tmp_path):
    study = optuna.create_study(
        study_name="a", storage=storages.shared(journal, "a"), direction="maximize"
    )
    # None is better: the best return of Pendulum-v1 is 0.
    best = dict.fromkeys(range(1, 9), 0.0)
    study.add_trial(create_trial(value=0.0, intermediate_values=best))
    planned = ("pretrain_epochs:8", "horizon:8", "gradient_steps:4", "n_random_plans:1")
    study_of = ("--storage", journal, "--study-name", "a", "--n-trials", "1", "-n", "40")
    logs = tmp_path / "evaluations"
    options = ("--n-evaluations", "4", "--n-startup-trials", "1", "--optimization-log-path", logs)

    command = (ZOO, "train", "--algo", "hds", *TUNED, *study_of, *options, "-params", *planned)
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)

    assert done.returncode == 0, done.stderr[-4000:]
    assert states_of(study) == ["COMPLETE", "PRUNED"]
    assert set(study.trials[1].intermediate_values) == {1}
    (written,) = logs.glob("*/evaluations.npz")
    assert np.load(written)["timesteps"].tolist() == [0]


# -------------------------------------------------------------------- several workers
def postgres_commands() -> Path | None:
    found = sorted(Path("/usr/lib/postgresql").glob("*/bin/initdb"))
    on_path = shutil.which("initdb")
    return found[-1].parent if found else Path(on_path).parent if on_path else None


@pytest.fixture
def database():
    """The URL of a PostgreSQL server of its own, which refuses to run as root."""
    commands, user = postgres_commands(), None
    if commands is None or find_spec("psycopg") is None:
        pytest.skip("needs PostgreSQL and psycopg")
    folder = Path(tempfile.mkdtemp(prefix="sb3_hds_postgres_"))
    if os.getuid() == 0:
        known = {entry.pw_name for entry in pwd.getpwall()}
        user = next((name for name in ("postgres", "nobody") if name in known), None)
        if user is None:
            pytest.skip("PostgreSQL does not run as root, and there is no other user")
        shutil.chown(folder, user)
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "user": user}
    quiet |= {"cwd": folder}
    data = folder / "data"
    initialise = (commands / "initdb", "-D", data, "-A", "trust", "-U", "tuner", "--no-sync")
    subprocess.run(initialise, check=True, **quiet)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    serve = (commands / "postgres", "-D", data, "-k", folder, "-h", "127.0.0.1", "-p", port, "-F")
    with subprocess.Popen(serve, **quiet) as server:
        try:
            ready = (commands / "pg_isready", "-h", "127.0.0.1", "-p", port)
            deadline = time.monotonic() + 60.0
            while subprocess.run(ready, **quiet).returncode and time.monotonic() < deadline:
                time.sleep(0.1)
            yield f"postgresql+psycopg://tuner@127.0.0.1:{port}/postgres"
        finally:
            server.send_signal(signal.SIGINT)
    shutil.rmtree(folder)


@pytest.fixture
def journal(tmp_path):
    return str(tmp_path / "study" / "journal.log")


@pytest.mark.expensive
def test_workers_that_start_together_on_an_empty_database_do_not_disturb_each_other(database):
    together = threading.Barrier(6)

    def start(_):
        together.wait()
        return storages.shared(database, "a")

    with ThreadPoolExecutor(6) as pool:
        opened = list(pool.map(start, range(6)))

    optuna.create_study(study_name="a", storage=opened[0])
    assert all(storage.get_all_studies() for storage in opened)


@pytest.mark.expensive
def test_one_worker_tunes_in_a_file_of_sqlite(tmp_path):
    url = f"sqlite:///{tmp_path / 'study.db'}"
    Worker(tmp_path, "only", url, "--n-trials", "2").ends_well()
    study = optuna.load_study(study_name="a", storage=url)
    assert len(study.get_trials(states=DONE)) == 2


class Worker:
    """``rl_zoo3 train -optimize`` in a process of its own."""

    def __init__(self, folder: Path, name: str, storage: str, *options: str) -> None:
        self.log = folder / f"{name}.txt"
        command = (ZOO, "train", "--algo", "openloop")
        command += (*TUNED, "--storage", storage, "--study-name", "a", "-n", "10000")
        command += ("--n-evaluations", "2", "-f", folder / name, *options)
        environ = os.environ | {"SB3_HDS_HEARTBEAT": str(INTERVAL)}
        with self.log.open("w") as output:
            self.process = subprocess.Popen(
                command, cwd=folder, env=environ, stdout=output, stderr=subprocess.STDOUT
            )

    def said(self) -> str:
        return self.log.read_text()

    def ends_well(self) -> None:
        assert self.process.wait(300) == 0, self.said()[-4000:]


@pytest.mark.expensive
@pytest.mark.parametrize("storage", ["journal", "database"])
def test_one_of_four_workers_is_killed_and_no_trial_is_lost_or_counted_twice(
    storage, request, tmp_path
):
    url = request.getfixturevalue(storage)
    each_of_them = ("--n-trials", str(TRIALS // WORKERS))
    workers = [Worker(tmp_path, f"worker{i}", url, *each_of_them) for i in range(WORKERS)]
    victim, *others = workers

    deadline = time.monotonic() + 300.0
    while "steps after" not in victim.said() and time.monotonic() < deadline:
        time.sleep(0.02)
    time.sleep(0.5)
    victim.process.kill()
    victim.process.wait()
    for worker in others:
        worker.ends_well()
    time.sleep(2 * INTERVAL + 1)  # then the trial is stale
    last = Worker(tmp_path, "last", url, "--max-total-trials", str(TRIALS))
    last.ends_well()

    opened = storages.shared(url, "a")
    study = optuna.load_study(study_name="a", storage=opened)
    counted = Counter(trial.state for trial in study.trials)
    assert counted == Counter({state: counted[state] for state in DONE}) + Counter(
        {TrialState.FAIL: 1}
    )
    assert sum(counted[state] for state in DONE) == TRIALS
    (lost,) = study.get_trials(states=(TrialState.FAIL,))
    (again,) = (t for t in study.trials if t.system_attrs.get("failed_trial") == lost.number)
    assert again.state in DONE and again.params.items() >= lost.params.items()
    # Each was finished by one process.
    finished = [
        number
        for worker in (*workers, last)
        for number in worker.said().replace(" pruned", " finished").split("] Trial ")[1:]
        if " finished" in number
    ]
    numbers = sorted(int(text.split()[0]) for text in finished)
    assert numbers == sorted(t.number for t in study.trials if t.state in DONE)
