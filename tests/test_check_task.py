"""What is wrong with a task is found, and what is not wrong is left alone."""

import copy

import gymnasium
import numpy as np
import pytest
from cases import each
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit
from odd_envs import AnySpaces
from stable_baselines3.common.vec_env import DummyVecEnv
from toy_task import toy

from sb3_hds.errors import ParameterError
from sb3_hds.wrappers import check_task


def topics(env: gymnasium.Env, **how) -> list[str]:
    """:return: what the problems are about"""
    return [text.split(":")[0] for text in check_task(env, **({"n_steps": 1000} | how)).problems]


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

    assert topic in topics(toy(**wrong), **how)
    # The late reward is one at a discount of 0.9, and none at 0.99.
    how = {} if topic == "Late reward" else how
    assert not mended or topic not in topics(toy(**mended), **how)


def test_nothing_is_wrong_with_a_healthy_task_and_a_report_says_so():
    report, bad = check_task(toy()), check_task(toy(limit=4, units=1e3, reward="constant"))
    assert report.ok and report.problems == [] and "no problem" in str(report)
    assert not bad.ok and len(bad.problems) == 3 and "3. Episode length" in str(bad)
    assert max(map(len, str(bad).splitlines())) <= 80


class Drawn(AnySpaces):
    """:param step_of: of the environment and the action: reward, end, info"""

    def __init__(self, step_of, *its_spaces):
        super().__init__(*its_spaces)
        self.step_of = step_of

    def step(self, action):
        obs, *_ = super().step(action)
        reward, over, info = self.step_of(self, action)
        return obs, reward, bool(over), False, info


def test_what_is_said_of_a_limit_is_of_episodes_that_it_cut():
    def mixed(env, action):
        """Most episodes fall after a few steps; the others would go on for ever."""
        env.stays = env.np_random.random() < 0.2 if env.n == 1 else env.stays
        return float(action[0]), not env.stays and env.np_random.random() < 0.3, {}

    # 1 - 0.99^150 is 78 %, although the mean episode has some 35 steps.
    assert "Episode length" not in topics(TimeLimit(Drawn(mixed), 150))
    assert "Episode length" in topics(TimeLimit(Drawn(mixed), 20))


def test_a_cost_for_each_step_is_no_constant_reward_where_episodes_can_end():
    def until_the_goal(env, action):
        there = env.np_random.random() < 0.02
        return -1.0, there, {"is_success": there}

    assert topics(TimeLimit(Drawn(until_the_goal), 200)) == []


@each(
    # Its limits are [-2, 2].
    ("Pendulum-v1", ["Action space"]),
    ("CartPole-v1", []),
    ("Hopper-v5", []),
    # A speed of 0.006 and -1 in each step; nothing but a cost of effort.
    ("MountainCar-v0", ["Observation scale", "Constant reward"]),
    ("MountainCarContinuous-v0", ["Sparse reward"]),
    ("sb3_hds/ConstantReward-v0", ["Constant reward", "Episode length"]),
)
def test_what_is_said_of_stock_environments_is_true(env_id, expected):
    assert topics(gymnasium.make(env_id)) == expected


def test_choices_images_and_dictionaries_are_looked_at_as_far_as_they_are_numbers():
    space = spaces.Dict(
        far=spaces.Box(-1e3, 1e3, (2,)),
        choice=spaces.Discrete(1000),
        image=spaces.Box(0, 255, (3, 8, 8), np.uint8),
    )
    env = Drawn(lambda _, action: (float(action), False, {}), space, spaces.Discrete(3))

    [problem] = check_task(TimeLimit(env, 100)).problems

    assert "obs['far'][0], obs['far'][1] have" in problem


def test_checking_leaves_the_action_spaces_generator_alone():
    env = toy()
    env.action_space.seed(5)
    expected = copy.deepcopy(env.action_space).sample()

    first, second = check_task(env, seed=1), check_task(env, seed=1)

    assert env.action_space.sample() == expected and first == second


def test_what_cannot_be_checked_is_refused():
    with pytest.raises(ParameterError, match="one of the copies"):
        check_task(DummyVecEnv([toy]))  # type: ignore[arg-type]
    with pytest.raises(ParameterError, match="gamma must be"):
        check_task(toy(), gamma=1.0)
    with pytest.raises(ParameterError, match="at least 100"):
        check_task(toy(), n_steps=10)
