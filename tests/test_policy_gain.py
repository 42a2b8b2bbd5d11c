"""What a diagnosis is worth for the policy."""

import dataclasses

import gymnasium
import numpy as np
import pytest
from stable_baselines3 import SAC
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_hds import HDS, effects, twins
from sb3_hds.envs import TwinEnv
from sb3_hds.errors import EnvironmentMismatchError, ParameterError, TrajectoryError
from sb3_hds.experiments import PolicyGain, measure_policy_gain
from sb3_hds.experiments.policy_gain import _summarised
from sb3_hds.sysid import Diagnosis

ROBOT = "sb3_hds/PendulumReal-v1"
SMALL = {"pretrain_epochs": 2, "n_rollouts": 4, "n_random_plans": 0, "compare_every": 0}


def a_diagnosis(believed="PendulumReal"):
    twin = twins.make(believed)
    extended = twin.extend(effects.CoulombFriction(0, tau_c=0.3))
    return Diagnosis(verdict="named", believed=twin, twin=extended, data_hash="", seed=0)


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


def test_the_gain_is_paired():
    believed = np.array([[-100.0, -900.0], [-110.0, -910.0]])
    extended = believed + np.array([[9.0, 11.0], [10.0, 10.0]])

    gain = PolicyGain(
        {"believed": believed, "extended": extended}, _summarised(extended - believed)
    )

    assert gain.gain.mean == pytest.approx(10.0)
    assert gain.gain.low <= 10.0 <= gain.gain.high
    assert gain.share_of_ceiling is None


def test_the_share_of_the_gap_is_that_of_the_means():
    at = lambda value: np.full((2, 4), value)  # noqa: E731
    returns = {"believed": at(-300.0), "extended": at(-200.0), "true": at(-180.0)}
    gain = PolicyGain(returns, _summarised(returns["extended"] - returns["believed"]))

    assert gain.share_of_ceiling == pytest.approx(100.0 / 120.0)
    assert "83% of the gap" in str(gain)


def test_an_outlier_among_runs_does_not_move_the_interquartile_mean():
    values = np.arange(16.0).reshape(4, 4)
    expected = _summarised(values).mean
    values[3, 3] = 1e6
    assert _summarised(values).mean == expected


def test_a_single_run_has_no_interval_and_says_so():
    values = np.arange(16.0)[None]
    found = _summarised(values)
    assert found.mean == pytest.approx(7.5) and found.low is found.high is None

    gain = PolicyGain(
        {"believed": values, "extended": values + 1.0}, _summarised(values * 0.0 + 1.0)
    )
    text = str(gain)
    assert "over 16 start states, one run" in text and "interval" not in text
    assert "One run in each simulation tells nothing of how others would differ." in text
    assert gain.to_dict()["gain"] == {"mean": 1.0, "low": None, "high": None}


def test_a_paired_gain_is_labelled_where_it_is_not_the_difference_of_the_means():
    """
    Of the inner halves: 1.5 believed, 12.5 extended; differences 10, 20, 10 and -87, so 10 paired.
    """
    believed = np.array([[0.0, 1.0, 2.0, 100.0]] * 2)
    extended = np.array([[10.0, 21.0, 12.0, 13.0]] * 2)
    other = PolicyGain(
        {"believed": believed, "extended": extended}, _summarised(extended - believed)
    )
    same = PolicyGain(
        {"believed": believed, "extended": believed + 3.0}, _summarised(np.full((2, 4), 3.0))
    )

    assert other.gain.mean == 10.0 and "gain, paired" in str(other)
    assert "The means themselves differ by 11.0: each" in " ".join(str(other).split())
    assert "differ by" not in str(same)
    assert all(len(line) <= 80 for line in f"{other}\n{same}".splitlines())


def test_other_algorithms_train_in_the_simulation_for_a_budget():
    found = measure_policy_gain(
        a_diagnosis(),
        gymnasium.make("Pendulum-v1"),
        SAC,
        budget=30,
        seeds=1,
        n_episodes=1,
        progress=False,
        learning_starts=10,
    )

    assert set(found.returns) == {"believed", "extended"}
    assert found.to_dict()["runs"] == 1


def test_it_is_drawn_and_told_in_the_report(measured, tmp_path):
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


def test_a_truth_that_is_known_is_the_ceiling_of_any_system():
    """Of a system made of a twin, that twin; of another one, what the user says."""
    diagnosis, truth = a_diagnosis(), twins.make("PendulumReal", mass=1.2)
    simulated = gymnasium.wrappers.TimeLimit(TwinEnv(truth), 5)
    names = []
    for env, ceiling in ((simulated, True), (OneStep(), truth), (OneStep(), True)):
        gain = measure_policy_gain(
            diagnosis,
            env,
            seeds=1,
            n_episodes=1,
            ceiling=ceiling,
            progress=False,
            **SMALL | {"pretrain_epochs": 1},
        )
        names.append([*gain.returns])

    assert names == [["believed", "extended", "true"]] * 2 + [["believed", "extended"]]


def test_an_environment_that_was_made_here_is_closed_here():
    made, own = [], OneStep()

    def factory():
        made.append(OneStep())
        return made[-1]

    for env in (factory, own):
        settings = SMALL | {"pretrain_epochs": 1}
        measure_policy_gain(a_diagnosis(), env, seeds=1, n_episodes=1, progress=False, **settings)

    assert [env.closed for env in made] == [True] and not own.closed


@pytest.mark.parametrize(
    ("algorithm", "changes"), [(SAC, {}), (HDS, {"pretrain_epochs": 0}), (SAC, {"budget": 0})]
)
def test_policies_that_learned_nothing_are_not_compared(algorithm, changes):
    with pytest.raises(TrajectoryError, match=f"{algorithm.__name__} learns nothing in 0 steps"):
        measure_policy_gain(a_diagnosis(), ROBOT, algorithm, **changes)


@pytest.mark.parametrize(
    ("real", "message"),
    [
        (OneStep(n_obs=4), r"observations of shape \(4,\).*\(3,\)"),
        (OneStep(most=1.0), r"actions in \[-1\] to \[1\].*\[-2\] to \[2\]"),
    ],
)
def test_a_system_that_the_twins_do_not_describe_is_refused(real, message):
    with pytest.raises(EnvironmentMismatchError, match=message):
        measure_policy_gain(a_diagnosis(), real)


def test_an_argument_that_the_algorithm_does_not_have_is_refused():
    with pytest.raises(ParameterError, match=r"HDS cannot be made.*'speed'"):
        measure_policy_gain(a_diagnosis(), ROBOT, speed=1)


def test_a_system_that_never_ends_is_cut_off_as_the_twin_is():
    endless = gymnasium.make(ROBOT, max_episode_steps=20).unwrapped

    gain = measure_policy_gain(
        a_diagnosis(), endless, seeds=1, n_episodes=1, ceiling=False, progress=False, **SMALL
    )

    assert np.isfinite(gain.returns["believed"]).all()


def test_vectorised_systems_are_refused():
    with pytest.raises(ParameterError, match="got DummyVecEnv"):
        measure_policy_gain(a_diagnosis(), DummyVecEnv([robot]))


@pytest.mark.parametrize("wrong", [{"seeds": 0}, {"n_episodes": 0}, {"budget": -1}])
def test_nothing_to_measure_is_an_error(wrong):
    with pytest.raises(TrajectoryError, match="at least"):
        measure_policy_gain(a_diagnosis(), ROBOT, HDS, **wrong)


def test_a_rig_has_no_task_to_be_good_at():
    rig = dataclasses.replace(a_diagnosis(), believed=twins.make("LinearAxis"))
    with pytest.raises(TrajectoryError, match="no episode length"):
        measure_policy_gain(rig, ROBOT)
