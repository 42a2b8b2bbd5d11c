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
from stable_baselines3.common.env_util import make_vec_env

from sb3_hds import HDS

pytestmark = pytest.mark.skipif(find_spec("rl_zoo3") is None, reason="needs the extra 'zoo'")

CONSOLE = (str(Path(sys.executable).with_name("rl_zoo3")),)
MODULE = (sys.executable, "-m")
# Small plans: these tests ask whether a command works, not how well the algorithm learns.
QUICK = ("n_rollouts:8", "pretrain_epochs:1", "horizon:8", "gradient_steps:4", "n_random_plans:1")
N_STEPS, EVAL_FREQ, SAVE_FREQ = 300, 100, 150


class Zoo:
    """A folder to work in, and the commands in it."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.logs = folder, folder / "logs" / "hds"
        # One compilation cache for all processes: they compile the same functions.
        own = {"SB3_HDS_CACHE": str(folder / "cache"), "MPLBACKEND": "Agg", "COLUMNS": "200"}
        self.environ = {**os.environ, **own}

    def run(self, *words: str, **environ: str) -> subprocess.CompletedProcess:
        return subprocess.run(
            words,
            cwd=self.folder,
            env={**self.environ, **environ},
            text=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            timeout=400,
        )

    def succeeds(self, *words: str, **environ: str) -> str:
        done = self.run(*words, **environ)
        assert done.returncode == 0, done.stdout[-6000:]
        return done.stdout

    def fails(self, *words: str, **environ: str) -> str:
        done = self.run(*words, **environ)
        assert done.returncode != 0, done.stdout[-6000:]
        return done.stdout


def train(*options: str) -> tuple[str, ...]:
    return ("--algo", "hds", "--env", "Pendulum-v1", "--seed", "0", "-f", "logs", *options)


def saved_hyperparameters(run: Path) -> dict:
    tag, _, entries = (run / "Pendulum-v1" / "config.yml").read_text().partition("\n")
    assert tag == "!!python/object/apply:collections.OrderedDict"
    return dict(yaml.safe_load(entries)[0])


@pytest.fixture(scope="module")
def zoo(tmp_path_factory) -> Zoo:
    return Zoo(tmp_path_factory.mktemp("zoo"))


@pytest.fixture(scope="module")
def trained(zoo) -> Path:
    """The folder of a run by the console command, shared by the tests that come after it."""
    schedule = ("-n", str(N_STEPS), "--eval-freq", str(EVAL_FREQ), "--save-freq", str(SAVE_FREQ))
    evaluation = ("--n-eval-envs", "2", "--eval-episodes", "2")
    changes = ("--env-kwargs", "g:9.8", "-params", "train_freq:2", *QUICK)
    shown = ("-P", "--tensorboard-log", "curves")
    zoo.succeeds(*CONSOLE, "train", *train(*schedule, *evaluation, *shown, *changes))
    return zoo.logs / "Pendulum-v1_1"


def test_a_run_folder_holds_what_the_zoo_always_writes(trained):
    checkpoints = {f"rl_model_{step}_steps.zip" for step in (SAVE_FREQ, 2 * SAVE_FREQ)}
    expected = {"0.monitor.csv", "best_model.zip", "evaluations.npz", "Pendulum-v1.zip"}
    # Those of the command line replace those of the file.
    used = saved_hyperparameters(trained)

    assert (used["policy"], used["train_freq"], used["n_rollouts"]) == ("MlpPolicy", 2, 8)
    assert expected | checkpoints <= {path.name for path in trained.iterdir()}
    assert {"args.yml", "config.yml"} <= {path.name for path in (trained / "Pendulum-v1").iterdir()}


def test_arguments_of_the_environment_reach_the_twin(trained):
    spec = gym.spec("Pendulum-v1")
    # As the zoo builds it, see ExperimentManager.create_envs.
    env = make_vec_env(lambda **kwargs: spec.make(**kwargs), env_kwargs={"g": 9.8})

    model = HDS.load(trained / "Pendulum-v1.zip", env=env)

    # Pendulum-v1's own default is 10.0 m/s2.
    assert model.twin.values["gravity"] == 9.8
    assert "env_kwargs\n    - g: 9.8" in (trained / "Pendulum-v1" / "args.yml").read_text()


def test_a_timestep_is_a_step_of_the_environment_and_nothing_else(trained):
    with open(trained / "0.monitor.csv") as file:
        episodes = list(csv.DictReader(line for line in file if not line.startswith("#")))

    # Pendulum-v1 ends an episode after 200 steps, so 300 steps hold one that is complete.
    assert [int(episode["l"]) for episode in episodes] == [200]
    # 100, 200, 300: on_step has been called once per step, or the evaluations would lie elsewhere.
    evaluations = np.load(trained / "evaluations.npz")
    assert evaluations["timesteps"].tolist() == [EVAL_FREQ, 2 * EVAL_FREQ, N_STEPS]
    assert evaluations["results"].shape == (3, 2)


@pytest.mark.expensive
def test_the_module_goes_on_from_a_saved_agent_without_the_start_up_line(zoo, trained):
    zoo.succeeds(
        *(*MODULE, "rl_zoo_plugin", "train"),
        *train("-n", str(N_STEPS), "--eval-freq", str(EVAL_FREQ), "--eval-episodes", "2"),
        *("-i", str(trained / "Pendulum-v1.zip"), "--env-kwargs", "g:9.8", "-params", *QUICK),
        SB3_HDS_NO_ZOO="1",
    )

    evaluations = zoo.logs / "Pendulum-v1_2" / "evaluations.npz"
    assert np.load(evaluations)["timesteps"][-1] == N_STEPS


def test_enjoy_shows_the_best_agent_in_a_window_and_the_zoo_draws_curves(zoo, trained):
    agent = ("--algo", "hds", "--env", "Pendulum-v1", "-f", "logs", "--exp-id", "1", "--load-best")

    output = zoo.succeeds(*CONSOLE, "enjoy", *agent, "-n", "202", SDL_VIDEODRIVER="dummy")

    assert "Episode Reward" in output
    assert list(zoo.folder.glob("curves/Pendulum-v1/HDS_1/events.out.tfevents.*"))


@pytest.mark.expensive
def test_our_environments_train_in_subprocesses_and_are_filmed(zoo):
    agent = ("--algo", "hds", "--env", "sb3_hds/PayloadPendulum-v0", "--seed", "0", "-f", "payload")
    schedule = ("-n", "200", "--eval-freq", "-1", "--vec-env", "subproc")

    zoo.succeeds(*MODULE, "rl_zoo3.train", *agent, *schedule, "-params", "n_envs:2", *QUICK)
    run = zoo.folder / "payload" / "hds" / "sb3_hds-PayloadPendulum-v0_1"
    assert {"0.monitor.csv", "1.monitor.csv"} <= {path.name for path in run.iterdir()}

    zoo.succeeds(*MODULE, "rl_zoo3.record_video", *agent, "-n", "30", "-o", "videos")
    assert list(zoo.folder.glob("videos/*.mp4"))


@pytest.mark.expensive
def test_optuna_trials_are_stored_and_one_of_them_can_be_trained(zoo):
    study = ("--storage", "study/journal.log", "--study-name", "hds", "-params", *QUICK)
    budget = ("-n", "200", "--n-trials", "3", "--n-evaluations", "1", "--eval-episodes", "1")

    output = zoo.succeeds(
        *CONSOLE, "train", *train("-optimize", *budget, "--no-optim-plots", "-f", "tuned"), *study
    )
    assert "Number of finished trials:  3" in output

    # The zoo takes trial 0 for no trial at all.
    output = zoo.succeeds(
        *CONSOLE, "train", *train("--trial-id", "1", "-n", "100", "-f", "chosen"), *study
    )
    assert "Loading from Optuna study" in output
    [run] = (zoo.folder / "chosen" / "hds").glob("Pendulum-v1_*")
    varied = {name for name in saved_hyperparameters(run) if name.startswith("policy_kwargs.")}
    assert varied == {"policy_kwargs.net_arch", "policy_kwargs.activation_fn"}


@pytest.mark.expensive
def test_a_gait_is_searched_and_replayed(zoo):
    agent = ("--algo", "openloop", "--env", "Pendulum-v1", "-f", "gaits")
    short = ("population_size:3", "n_resets:1", "horizon:20", "n_elites:2", "n_envs:2")

    zoo.succeeds(
        *CONSOLE,
        *("train", *agent, "--seed", "0", "-n", "800", "--eval-freq", "400"),
        *("--eval-episodes", "1", "-params", *short),
    )
    output = zoo.succeeds(*CONSOLE, "enjoy", *agent, "--no-render", "-n", "400")

    run = zoo.folder / "gaits" / "openloop" / "Pendulum-v1_1"
    assert {"Pendulum-v1.zip", "best_model.zip"} <= {path.name for path in run.iterdir()}
    assert "2 Episodes" in output and "Mean reward" in output


@pytest.mark.expensive  # two processes each; HDS, above, goes the same way
@pytest.mark.parametrize("algo", ["gsde_sac", "bro", "td7"])
def test_model_free_algorithms_are_trained_and_replayed(zoo, algo):
    agent = ("--algo", algo, "--env", "Pendulum-v1", "-f", "brief")
    budget = ("--seed", "0", "-n", "200", "--eval-freq", "-1")
    few = ("learning_starts:50", "train_freq:50", "gradient_steps:2", "batch_size:16")
    narrow = "policy_kwargs:dict(net_arch=[8])"

    zoo.succeeds(*CONSOLE, "train", *agent, *budget, "-params", *few, narrow)
    output = zoo.succeeds(*CONSOLE, "enjoy", *agent, "--no-render", "-n", "200")

    assert (zoo.folder / "brief" / algo / "Pendulum-v1_1" / "Pendulum-v1.zip").is_file()
    assert "1 Episodes" in output and "Mean reward" in output


@pytest.mark.expensive
def test_a_trial_that_diverges_does_not_end_the_search(zoo):
    (zoo.folder / "huge.py").write_text(
        "import gymnasium as gym\n"
        "def make(**given):\n"
        "    env = gym.make('Pendulum-v1', **given)\n"
        "    return gym.wrappers.TransformReward(env, lambda reward: 1e37 * reward)\n"
        "gym.register('Huge-v0', make, max_episode_steps=200)\n"
    )
    agent = ("--algo", "droq", "--env", "Huge-v0", "--gym-packages", "huge", "-f", "huge")
    budget = ("-n", "400", "--n-trials", "2", "--n-evaluations", "1", "--n-startup-trials", "2")
    path = os.pathsep.join((str(zoo.folder), os.environ.get("PYTHONPATH", "")))

    output = zoo.run(*CONSOLE, "train", *agent, "-optimize", *budget, PYTHONPATH=path).stdout

    assert "an update diverged" in output and "Trial 1 pruned" in output, output[-3000:]


def test_an_unknown_key_in_a_yml_file_is_named_with_the_one_that_was_meant(zoo):
    entry = {"n_timesteps": 100, "policy": "MlpPolicy", "n_rolouts": 8}
    (zoo.folder / "typo.yml").write_text(yaml.dump({"Pendulum-v1": entry}))

    output = zoo.fails(*CONSOLE, "train", *train("--conf-file", "typo.yml"), "-f", "typo")

    assert "HDS has no hyperparameter 'n_rolouts'. Did you mean 'n_rollouts'?" in output
    assert not list(zoo.folder.glob("typo/**/*.zip"))


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ((*CONSOLE, "train", *train()), "invalid choice: 'hds'"),
        ((*MODULE, "rl_zoo_plugin", "trian"), "Unknown command 'trian'"),
    ],
)
def test_without_the_hook_the_zoo_is_as_it_was_and_the_module_names_its_commands(zoo, words, told):
    assert told in zoo.fails(*words, SB3_HDS_NO_ZOO="1")
