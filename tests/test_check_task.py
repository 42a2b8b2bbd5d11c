"""What is wrong with a task is found, and what is not wrong is left alone."""

import copy
import functools
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.wrappers import RescaleAction, TimeLimit
from stable_baselines3.common.vec_env import DummyVecEnv
from toy_task import toy

from sb3_hds.errors import ParameterError
from sb3_hds.wrappers import TaskReport, check_task


def topics(env: gymnasium.Env, **how) -> list[str]:
    """:return: what the problems are about"""
    return [text.split(":")[0] for text in check_task(env, **({"n_steps": 1000} | how)).problems]


def test_nothing_is_wrong_with_a_healthy_task():
    report = check_task(toy())

    assert report.ok and report.problems == []
    assert words(report).endswith("no problem found.")


@functools.cache
def of_toy(settings: tuple[tuple[str, Any], ...], how: tuple[tuple[str, Any], ...]) -> list[str]:
    return topics(toy(**dict(settings)), **dict(how))


def words(report: TaskReport) -> str:
    return " ".join(str(report).split())


# Settings of the task and of the check, what is wrong, and the same task mended.
EFFORT, LATE = {"reward": "jerk", "sees_action": True}, {"reward": "late"}
DEFECTS = {
    "large observations": ({"units": 100.0}, {}, "Observation scale", {}),
    "observations that are not finite": ({"units": np.nan}, {}, "Observation", {}),
    "large actions": ({"max_force": 3.0}, {}, "Action space", {}),
    "small actions": ({"max_force": 0.1}, {}, "Action space", {}),
    "actions without limits": ({"max_force": np.inf}, {}, "Action space", {}),
    "constant reward": ({"reward": "constant"}, {}, "Constant reward", {}),
    "nothing but effort": ({"reward": "effort"}, {}, "Sparse reward", {}),
    "rare reward": ({"reward": "rare"}, {}, "Sparse reward", {}),
    "large rewards": ({"scale": 1e3}, {}, "Reward scale", {}),
    "small rewards": ({"scale": 1e-4}, {}, "Reward scale", {}),
    "rewards that are not finite": ({"scale": np.inf}, {}, "Reward", {}),
    "last action unseen": ({"reward": "jerk"}, {}, "Last action", EFFORT),
    "velocity unseen": ({"sees_velocity": False}, {}, "Velocity", {}),
    "dying pays": ({"fails": True}, {}, "Termination pays", {"fails": True, "end": -100.0}),
    "a goal like a death": ({"fails": True}, {}, "Termination pays", {"fails": True, "success": 1}),
    "short episodes": ({"limit": 4}, {"gamma": 0.98}, "Episode length", {}),
    "no end": ({"limit": None}, {}, "Episode length", {}),
    "a short-sighted discount": ({"limit": 900}, {"gamma": 0.8}, "Episode length", {}),
    "late reward": (LATE, {"gamma": 0.9}, "Late reward", LATE),
}


@pytest.mark.parametrize("defect", DEFECTS)
def test_a_defect_is_found_and_what_has_it_not_is_left_alone(defect):
    wrong, how, topic, mended = DEFECTS[defect]

    assert topic in of_toy(tuple(wrong.items()), tuple(how.items()))
    # The late reward is one at a discount of 0.9, and none at 0.99.
    how = {} if topic == "Late reward" else how
    assert topic not in of_toy(tuple(mended.items()), tuple(how.items()))


@pytest.mark.parametrize(
    ("settings", "numbers"),
    [
        ({"units": 100.0}, ("obs[0]", "VecNormalize")),
        ({"max_force": 3.0}, ("[-3, 3]", "RescaleAction")),
        ({"reward": "constant"}, ("2000 steps paid -1",)),
        # 1 - 0.99^4 is 4 %; 0.99^69 is one half.
        ({"limit": 4}, ("after 4 steps", "4%", "69 steps")),
    ],
)
def test_a_problem_says_what_was_measured_and_what_to_do(settings, numbers):
    text = " ".join(check_task(toy(**settings)).problems)

    assert all(number in text for number in numbers)


class Drawn(gymnasium.Env):
    """
    Observes noise; what a step pays and whether it ends an episode is drawn.

    :param step_of: of the environment and the action: reward, end, info
    """

    observation_space = spaces.Box(-1.0, 1.0, (1,))
    action_space = spaces.Box(-1.0, 1.0, (1,))

    def __init__(self, step_of):
        self.step_of = step_of

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.stays = self.np_random.random() < 0.2
        return self.observation_space.sample(), {}

    def step(self, action):
        reward, over, info = self.step_of(self, action)
        return self.observation_space.sample(), reward, bool(over), False, info


def test_ends_are_weighed_against_staying():
    def costly(end):
        def step(env, action):
            over = env.np_random.random() < 0.1
            return (end if over else -1.0), over, {}

        return Drawn(step)

    # Staying costs 1 / (1 - gamma) = 100.
    assert "Termination pays" in topics(costly(-99.0))
    assert "Termination pays" not in topics(costly(-101.0))
    assert "staying therefore 100" in " ".join(check_task(costly(-99.0)).problems)


def test_what_is_said_of_a_limit_is_of_episodes_that_it_cut():
    def mixed(env, action):
        """Most episodes fall after a few steps; the others would go on for ever."""
        return float(action[0]), not env.stays and env.np_random.random() < 0.3, {}

    # 1 - 0.99^150 is 78 %, although the mean episode has some 35 steps.
    assert "Episode length" not in topics(TimeLimit(Drawn(mixed), 150))
    assert "Episode length" in topics(TimeLimit(Drawn(mixed), 20))


def test_a_cost_for_each_step_is_no_constant_reward_where_something_ends_it():
    def until_the_goal(env, action):
        there = env.np_random.random() < 0.02
        return -1.0, there, {"is_success": there}

    assert topics(TimeLimit(Drawn(until_the_goal), 200)) == []


def of_stock(env_id: str, **changes) -> list[str]:
    return topics(gymnasium.make(env_id, **changes))


def test_what_is_said_of_stock_environments_is_true():
    # Their limits are [-2, 2] and [-3, 3]. Nothing else is unusual about them.
    assert of_stock("Pendulum-v1") == of_stock("InvertedPendulum-v5") == ["Action space"]
    assert of_stock("HalfCheetah-v5") == of_stock("CartPole-v1") == of_stock("Hopper-v5") == []
    assert topics(RescaleAction(gymnasium.make("Pendulum-v1"), -1.0, 1.0)) == []
    # A speed of 0.006 and -1 in each step; nothing but a cost of effort.
    assert of_stock("MountainCar-v0") == ["Observation scale", "Constant reward"]
    assert of_stock("MountainCarContinuous-v0") == ["Sparse reward"]
    assert of_stock("sb3_hds/ConstantReward-v0") == ["Constant reward", "Episode length"]


def test_choices_images_and_dictionaries_are_looked_at_as_far_as_they_are_numbers():
    class Many(gymnasium.Env):
        observation_space = spaces.Dict(
            {
                "far": spaces.Box(-1e3, 1e3, (2,)),
                "choice": spaces.Discrete(1000),
                "image": spaces.Box(0, 255, (3, 8, 8), np.uint8),
            }
        )
        action_space = spaces.Discrete(3)

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            return self.observation_space.sample(), {}

        def step(self, action):
            return self.observation_space.sample(), float(action), False, False, {}

    report = check_task(TimeLimit(Many(), 100))

    [problem] = report.problems
    assert "obs['far'][0], obs['far'][1] have" in problem


def test_checking_leaves_the_action_spaces_generator_alone():
    env = toy()
    env.action_space.seed(5)
    expected = copy.deepcopy(env.action_space).sample()

    first, second = check_task(env, seed=1), check_task(env, seed=1)

    assert env.action_space.sample() == expected
    assert first == second


def test_what_cannot_be_checked_is_refused():
    with pytest.raises(ParameterError, match="one of the copies"):
        check_task(DummyVecEnv([toy]))  # type: ignore[arg-type]
    with pytest.raises(ParameterError, match="gamma must be"):
        check_task(toy(), gamma=1.0)
    with pytest.raises(ParameterError, match="at least 100"):
        check_task(toy(), n_steps=10)


def test_a_report_fits_into_80_columns():
    report = check_task(toy(limit=4, units=1e3, reward="constant"))

    assert isinstance(report, TaskReport) and len(report.problems) == 3 and not report.ok
    assert max(map(len, str(report).splitlines())) <= 80
    assert str(report) == repr(report) and "3 problems" in words(report)
