"""The agents of the repository load, and do what they did when they were trained."""

import json
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

from sb3_hds import algos, load_policy
from sb3_hds.experiments.study import Study, is_complete

AGENTS = Path(__file__).parent.parent / "trained_agents"
STUDY = Study.load(AGENTS / "study.yml")
RUNS = {str(run.place): run for run in STUDY.runs}
NONE_YET = {"droq"}
_MOST_BYTES = 12 * 2**20  # of a checkout, for all of them


def model_of(run) -> Path:
    return AGENTS / run.place / f"{run.env_name}.zip"


def mean_return(policy, env_id: str, n_episodes: int) -> float:
    env, returns = gym.make(env_id), []
    for episode in range(n_episodes):
        observation, _ = env.reset(seed=100 + episode)
        total, over = 0.0, False
        while not over:
            action, _ = policy.predict(observation, deterministic=True)
            observation, reward, terminated, truncated, _ = env.step(action)
            total, over = total + float(reward), terminated or truncated
        returns.append(total)
    env.close()
    return float(np.mean(returns))


def least_return(run) -> float:
    """Of ten episodes at the end of training, the mean less four standard deviations of one."""
    with np.load(AGENTS / run.place / "evaluations.npz") as held:
        last = held["results"][-1]
    return float(last.mean() - 4.0 * last.std() - 0.01 * abs(last.mean()))


def test_the_agents_are_a_study_that_is_complete_and_small():
    assert [place for place, run in RUNS.items() if not is_complete(STUDY, run, AGENTS)] == []
    assert sum(model_of(run).stat().st_size for run in STUDY.runs) < _MOST_BYTES
    assert {run.algo for run in STUDY.runs} == set(algos.ALL) - NONE_YET


def test_no_file_of_an_agent_names_a_folder_of_the_machine_that_trained_it():
    for run in STUDY.runs:
        told = json.loads((AGENTS / run.place / "study.json").read_text())["command"]
        config = AGENTS / run.place / run.env_name
        text = " ".join(told) + (config / "args.yml").read_text()
        text += (config / "command.txt").read_text()
        assert [word for word in text.split() if word.startswith("/")] == []


@pytest.mark.parametrize("place", RUNS)
def test_an_agent_is_loaded_without_unpickling_and_fits_its_environment(place, no_pickle):
    run = RUNS[place]
    policy, env = load_policy(model_of(run)), gym.make(run.env)

    observation, _ = env.reset(seed=0)
    action, _ = policy.predict(observation, deterministic=True)
    assert env.action_space.contains(action)


def test_an_agent_swings_a_pendulum_up():
    run = RUNS["hds/Pendulum-v1_1"]
    assert mean_return(load_policy(model_of(run)), run.env, 1) > least_return(run)


@pytest.mark.expensive
@pytest.mark.parametrize("place", RUNS)
def test_an_agent_reaches_the_return_that_is_stored_with_it(place):
    run = RUNS[place]
    model = algos.ALL[run.algo].load(model_of(run), env=gym.make(run.env))

    assert mean_return(model, run.env, 5) > least_return(run)
