"""What a diagnosis is worth for the policy."""

import dataclasses

import gymnasium
import numpy as np
import pytest
from cases import each
from stable_baselines3 import SAC
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_hds import effects, twins
from sb3_hds.envs import TwinEnv
from sb3_hds.errors import EnvironmentMismatchError, ParameterError, TrajectoryError
from sb3_hds.experiments import PolicyGain, measure_policy_gain
from sb3_hds.experiments.policy_gain import _summarised
from sb3_hds.sysid import Diagnosis

ROBOT = "sb3_hds/PendulumReal-v1"
SMALL = {"pretrain_epochs": 2, "n_rollouts": 4, "n_random_plans": 0}


def a_diagnosis(believed="PendulumReal"):
    twin = twins.make(believed)
    extended = twin.extend(effects.CoulombFriction(0, tau_c=0.3))
    return Diagnosis(verdict="named", believed=twin, twin=extended, data_hash="", seed=0)


def gain_of(believed, extended, **true):
    returns = {"believed": np.array(believed), "extended": np.array(extended)} | true
    return PolicyGain(returns, _summarised(returns["extended"] - returns["believed"]))


def test_the_gain_is_paired_and_labelled_where_it_is_not_the_difference_of_the_means():
    # Of the inner halves: 1.5 believed, 12.5 extended; differences 10, 20, 10 and -87.
    gain = gain_of([[0.0, 1.0, 2.0, 100.0]] * 2, [[10.0, 21.0, 12.0, 13.0]] * 2)
    spread = gain_of([[-100.0, -900.0], [-110.0, -910.0]], [[-91.0, -889.0], [-100.0, -900.0]])

    assert gain.gain.mean == 10.0 and gain.share_of_ceiling is None
    assert "gain, paired" in str(gain) and "differ by 11.0" in " ".join(str(gain).split())
    assert spread.gain.mean == pytest.approx(10.0) and spread.gain.low <= 10.0 <= spread.gain.high
    assert all(len(line) <= 80 for line in f"{gain}\n{spread}".splitlines())
    # The share of a gap is that of the means.
    known = gain_of(*(np.full((2, 4), x) for x in (-300, -200)), true=np.full((2, 4), -180))
    assert known.share_of_ceiling == pytest.approx(5.0 / 6.0) and "83% of the gap" in str(known)


def test_an_outlier_moves_no_interquartile_mean_and_a_single_run_has_no_interval():
    values = np.arange(16.0).reshape(4, 4)
    expected = _summarised(values).mean
    values[3, 3] = 1e6
    assert _summarised(values).mean == expected == _summarised(np.arange(16.0)[None]).mean == 7.5

    gain = gain_of(np.arange(16.0)[None], np.arange(16.0)[None] + 1.0)
    assert "over 16 start states, one run" in str(gain) and "interval" not in str(gain)
    assert gain.to_dict()["gain"] == {"mean": 1.0, "low": None, "high": None}


def robot():
    return gymnasium.make(ROBOT, friction=0.3, max_episode_steps=20)


@pytest.fixture(scope="module")
def measured():
    return measure_policy_gain(a_diagnosis(), robot, seeds=2, n_episodes=3, progress=False, **SMALL)


def test_every_twin_gets_the_same_runs_and_start_states(measured):
    assert set(measured.returns) == {"believed", "extended", "true"}
    assert all(values.shape == (2, 3) for values in measured.returns.values())
    # The extended twin is the true one here, so its policies are the same.
    np.testing.assert_array_equal(measured.returns["extended"], measured.returns["true"])


def test_other_algorithms_train_in_the_simulation_for_a_budget():
    how = {"budget": 30, "seeds": 1, "n_episodes": 1, "progress": False, "learning_starts": 10}
    found = measure_policy_gain(a_diagnosis(), gymnasium.make("Pendulum-v1"), SAC, **how)

    assert set(found.returns) == {"believed", "extended"} and found.to_dict()["runs"] == 1


def test_it_is_plotted_and_described_in_the_report(measured, tmp_path):
    assert measured.plot(tmp_path / "gain.png").stat().st_size > 5_000
    page = a_diagnosis().to_html(tmp_path / "report.html", measured.to_dict()).read_text()
    assert "What it buys" in page and "the extended twin" in page
    assert "What it buys" not in a_diagnosis().to_html(tmp_path / "report.html").read_text()


class OneStep(gymnasium.Env):
    """A real system whose episodes end at once."""

    def __init__(self, n_obs=3, most=2.0):
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (n_obs,))
        self.action_space = gymnasium.spaces.Box(-most, most, (1,))
        self.closed = False

    def reset(self, *, seed=None, options=None):
        return np.zeros(self.observation_space.shape, np.float32), {}

    def step(self, action):
        return np.zeros(self.observation_space.shape, np.float32), 1.0, True, False, {}

    def close(self):
        self.closed = True


def test_a_truth_that_is_known_is_the_ceiling_and_what_was_made_here_is_closed_here():
    """Of a system made of a twin, that twin; of another one, what the user says."""
    truth, made = twins.make("PendulumReal", mass=1.2), []
    simulated = gymnasium.wrappers.TimeLimit(TwinEnv(truth), 5)
    settings = {"seeds": 1, "n_episodes": 1, "progress": False} | SMALL | {"pretrain_epochs": 1}

    def factory():
        made.append(OneStep())
        return made[-1]

    # One that never ends is cut off as the twin is.
    endless = gymnasium.make(ROBOT, max_episode_steps=20).unwrapped
    names, own = [], OneStep()
    for env, ceiling in ((simulated, True), (own, truth), (factory, True), (endless, False)):
        gain = measure_policy_gain(a_diagnosis(), env, ceiling=ceiling, **settings)
        names.append([*gain.returns])

    assert names == [["believed", "extended", "true"]] * 2 + [["believed", "extended"]] * 2
    assert [env.closed for env in made] == [True] and not own.closed


@each(
    (OneStep(n_obs=4), {}, EnvironmentMismatchError, r"observations of shape \(4,\).*\(3,\)"),
    (OneStep(most=1.0), {}, EnvironmentMismatchError, r"actions in \[-1\] to \[1\]"),
    (DummyVecEnv([OneStep]), {}, ParameterError, "got DummyVecEnv"),
    (ROBOT, {"speed": 1}, ParameterError, "'speed'"),
    (ROBOT, {"pretrain_epochs": 0}, TrajectoryError, "HDS learns nothing in 0 steps"),
    (ROBOT, {"algorithm": SAC}, TrajectoryError, "SAC learns nothing in 0 steps"),
    (ROBOT, {"seeds": 0}, TrajectoryError, "at least"),
    (ROBOT, {"of": "LinearAxis"}, TrajectoryError, "no episode length"),
)
def test_what_cannot_be_compared_is_refused(real, changes, error, message):
    changes = {"of": "PendulumReal"} | changes
    diagnosis = dataclasses.replace(a_diagnosis(), believed=twins.make(changes.pop("of")))
    with pytest.raises(error, match=message):
        measure_policy_gain(diagnosis, real, **changes)
