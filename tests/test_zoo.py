"""The commands of an unmodified ``rl_zoo3``, each as a user types it, in a process of its own."""

import csv
import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import yaml
from cases import each
from stable_baselines3.common.env_util import make_vec_env

from sb3_hds import HDS

pytestmark = [
    pytest.mark.expensive,
    pytest.mark.skipif(find_spec("rl_zoo3") is None, reason="needs the extra 'zoo'"),
]

CONSOLE = (str(Path(sys.executable).with_name("rl_zoo3")),)
MODULE = (sys.executable, "-m")
# Small plans: these tests ask whether a command works, not how well the algorithm learns.
QUICK = ("n_rollouts:8", "pretrain_epochs:1", "horizon:8", "gradient_steps:4", "n_random_plans:1")
QUICK += ("refit_freq:0",)
FEW = ("learning_starts:50", "train_freq:50", "gradient_steps:2", "batch_size:16")


class Zoo:
    """A folder to work in, and the commands in it."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        # One compilation cache for all processes: they compile the same functions.
        own = {"SB3_HDS_CACHE": str(folder / "cache"), "MPLBACKEND": "Agg", "COLUMNS": "200"}
        self.environ = {**os.environ, **own}

    def succeeds(self, *words: str, **environ: str) -> str:
        into = {"text": True, "stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
        where = {"cwd": self.folder, "env": {**self.environ, **environ}}
        done = subprocess.run(words, timeout=500, **into, **where)
        assert done.returncode == 0, done.stdout[-6000:]
        return done.stdout


def of(algo: str, *options: str, env: str = "Pendulum-v1") -> tuple[str, ...]:
    return ("--algo", algo, "--env", env, "--seed", "0", *options)


def files_in(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def hyperparameters_in(folder: Path) -> dict:
    tag, _, entries = (folder / "Pendulum-v1" / "config.yml").read_text().partition("\n")
    assert tag == "!!python/object/apply:collections.OrderedDict"
    return dict(yaml.safe_load(entries)[0])


@pytest.fixture(scope="module")
def zoo(tmp_path_factory) -> Zoo:
    return Zoo(tmp_path_factory.mktemp("zoo"))


@pytest.fixture(scope="module")
def trained(zoo) -> Path:
    """The folder of a run by the console command."""
    schedule = ("-n", "300", "--eval-freq", "100", "--save-freq", "150")
    shown = ("--n-eval-envs", "2", "--eval-episodes", "2", "-P", "--tensorboard-log", "curves")
    changes = ("--env-kwargs", "g:9.8", "-params", "train_freq:150", *QUICK)
    zoo.succeeds(*CONSOLE, "train", *of("hds", "-f", "logs"), *schedule, *shown, *changes)
    return zoo.folder / "logs" / "hds" / "Pendulum-v1_1"


def test_a_run_folder_holds_what_the_zoo_always_writes_of_steps_of_the_environment(trained):
    checkpoints = {f"rl_model_{step}_steps.zip" for step in (150, 300)}
    # Those of the command line replace those of the file.
    used = hyperparameters_in(trained)
    assert (used["policy"], used["train_freq"], used["n_rollouts"]) == ("MlpPolicy", 150, 8)
    assert {"best_model.zip", "Pendulum-v1.zip"} | checkpoints <= files_in(trained)
    assert {"args.yml", "config.yml"} <= files_in(trained / "Pendulum-v1")
    with open(trained / "0.monitor.csv") as file:
        episodes = list(csv.DictReader(line for line in file if not line.startswith("#")))
    # An episode has 200 steps.
    assert [int(episode["l"]) for episode in episodes] == [200]
    evaluations = np.load(trained / "evaluations.npz")
    assert evaluations["timesteps"].tolist() == [100, 200, 300]
    assert evaluations["results"].shape == (3, 2)


def test_arguments_of_the_environment_reach_the_twin(trained):
    spec = gym.spec("Pendulum-v1")
    # As the zoo builds it, see ExperimentManager.create_envs.
    env = make_vec_env(lambda **kwargs: spec.make(**kwargs), env_kwargs={"g": 9.8})

    model = HDS.load(trained / "Pendulum-v1.zip", env=env)

    # Pendulum-v1's own default is 10.0 m/s2.
    assert model.twin.values["gravity"] == 9.8
    assert "env_kwargs\n    - g: 9.8" in (trained / "Pendulum-v1" / "args.yml").read_text()


def test_the_best_agent_is_shown_in_a_window_beside_curves_and_trained_on(zoo, trained):
    best = ("-f", "logs", "--exp-id", "1", "--load-best", "-n", "202")

    output = zoo.succeeds(*CONSOLE, "enjoy", *of("hds"), *best, SDL_VIDEODRIVER="dummy")

    assert "Episode Reward" in output
    assert list(zoo.folder.glob("curves/Pendulum-v1/HDS_1/events.out.tfevents.*"))
    # Without the start-up line.
    zoo.succeeds(
        *(*MODULE, "rl_zoo_plugin", "train", *of("hds", "-f", "logs"), "-n", "100"),
        *("--eval-freq", "100", "--eval-episodes", "1", "-i", str(trained / "Pendulum-v1.zip")),
        *("--env-kwargs", "g:9.8", "-params", *QUICK),
        SB3_HDS_NO_ZOO="1",
    )
    evaluations = trained.with_name("Pendulum-v1_2") / "evaluations.npz"
    assert np.load(evaluations)["timesteps"][-1] == 100


def test_our_environments_train_in_subprocesses_and_are_filmed(zoo):
    agent = of("hds", "-f", "payload", env="sb3_hds/PayloadPendulum-v0")
    schedule = ("-n", "200", "--eval-freq", "-1", "--vec-env", "subproc")

    zoo.succeeds(*MODULE, "rl_zoo3.train", *agent, *schedule, "-params", "n_envs:2", *QUICK)
    run = zoo.folder / "payload" / "hds" / "sb3_hds-PayloadPendulum-v0_1"
    assert {"0.monitor.csv", "1.monitor.csv"} <= files_in(run)

    zoo.succeeds(*MODULE, "rl_zoo3.record_video", *agent, "-n", "30", "-o", "videos")
    assert list(zoo.folder.glob("videos/*.mp4"))


def test_optuna_trials_are_stored_and_one_of_them_can_be_trained(zoo):
    study = ("--storage", "study/journal.log", "--study-name", "droq")
    budget = ("-n", "60", "--n-trials", "2", "--n-evaluations", "1", "--eval-episodes", "1")

    output = zoo.succeeds(
        *(*CONSOLE, "train", *of("droq", "-f", "tuned"), "-optimize"),
        *(*budget, "--no-optim-plots", *study),
    )
    assert "Number of finished trials:  2" in output

    # The zoo takes trial 0 for no trial at all.
    output = zoo.succeeds(
        *(*CONSOLE, "train", *of("droq", "-f", "chosen"), "--trial-id", "1", "-n", "20", *study)
    )
    assert "Loading from Optuna study" in output
    used = hyperparameters_in(zoo.folder / "chosen" / "droq" / "Pendulum-v1_1")
    assert "policy_kwargs.net_arch" in used


@each(
    ("openloop", ("population_size:3", "n_resets:1", "horizon:20", "n_elites:2", "n_envs:2")),
    ("td7", (*FEW, "policy_kwargs:dict(net_arch=[8])")),
)
def test_other_algorithms_are_trained_and_replayed(algo, params, zoo):
    agent = of(algo, "-f", "brief", "-n", "200")

    zoo.succeeds(*CONSOLE, "train", *agent, "--eval-freq", "-1", "-params", *params)
    output = zoo.succeeds(*CONSOLE, "enjoy", *agent, "--no-render")

    assert "Pendulum-v1.zip" in files_in(zoo.folder / "brief" / algo / "Pendulum-v1_1")
    assert "1 Episodes" in output and "Mean reward" in output
