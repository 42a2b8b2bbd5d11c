"""What wrappers make of the end of an episode, and of the time that is left until then."""

import pickle

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit

from sb3_hds.errors import ParameterError
from sb3_hds.wrappers import (
    InfiniteHorizon,
    ManualReset,
    TerminateToTruncate,
    TimeAware,
    TruncateToTerminate,
)

ONE = spaces.Discrete(3)
#: terminated, truncated
GOES_ON, FALLS, IS_CUT, BOTH = (False, False), (True, False), (False, True), (True, True)


class Script(gymnasium.Env):
    """
    Does what is written, and pays the number of the step.

    :param flags: of each step; after the last, of the last
    :param space: of observations, which are always the same
    :param told: further entries of ``info``
    """

    action_space = spaces.Box(-1.0, 1.0, (1,))

    def __init__(self, *flags, space=None, told=None):
        self.flags, self.told = flags, told or {}
        self.observation_space = space or spaces.Box(0.0, 1.0, (2,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.n = 0
        return self._obs(), {}

    def step(self, action):
        self.n += 1
        flags = self.flags[min(self.n, len(self.flags)) - 1]
        return self._obs(), float(self.n), *flags, dict(self.told)

    def _obs(self):
        self.observation_space.seed(0)
        return self.observation_space.sample()


def played(env, n):
    """:return: flags and infos of ``n`` steps"""
    env.reset(seed=0)
    steps = [env.step(np.zeros(1)) for _ in range(n)]
    assert [step[1] for step in steps] == list(range(1, n + 1))
    return [step[2:4] for step in steps], [step[4] for step in steps]


@pytest.mark.parametrize(
    ("wrapper", "flags", "expected", "said"),
    [
        (TerminateToTruncate, GOES_ON, GOES_ON, None),
        (TerminateToTruncate, FALLS, IS_CUT, "was_terminated"),
        (TerminateToTruncate, IS_CUT, IS_CUT, None),
        (TerminateToTruncate, BOTH, IS_CUT, "was_terminated"),
        (TruncateToTerminate, GOES_ON, GOES_ON, None),
        (TruncateToTerminate, FALLS, FALLS, None),
        (TruncateToTerminate, IS_CUT, FALLS, "was_truncated"),
        # Over is over, whatever else would have cut it.
        (TruncateToTerminate, BOTH, FALLS, None),
    ],
)
def test_every_end_becomes_one_of_the_other_kind_and_info_says_what_it_was(
    wrapper, flags, expected, said
):
    found, infos = played(wrapper(Script(GOES_ON, flags)), 2)
    _, told = played(wrapper(Script(flags, told={"TimeLimit.truncated": not expected[1]})), 1)

    assert found == [GOES_ON, expected]
    assert infos == [{}, {said: True} if said else {}]
    # The old entry for time-outs is set right where the end became another.
    assert told[0]["TimeLimit.truncated"] is (expected[1] == bool(said))


def test_a_horizon_without_an_end_cuts_at_the_limit_and_leaves_earlier_ends_alone():
    forever, _ = played(InfiniteHorizon(Script(GOES_ON), 3), 3)
    late, infos = played(InfiniteHorizon(Script(GOES_ON, GOES_ON, FALLS), 3), 3)
    early, earlier = played(InfiniteHorizon(Script(GOES_ON, FALLS), 3), 2)
    cut, _ = played(InfiniteHorizon(Script(GOES_ON, IS_CUT), 3), 2)

    assert forever == [GOES_ON, GOES_ON, IS_CUT]
    assert late == [GOES_ON, GOES_ON, IS_CUT] and infos[2] == {"was_terminated": True}
    assert early == [GOES_ON, FALLS] and earlier[1] == {}
    assert cut == [GOES_ON, IS_CUT]


def test_the_limit_counts_from_every_reset_and_is_the_least_of_several():
    inner = TimeLimit(Script(GOES_ON), 2)

    assert played(env := InfiniteHorizon(inner), 2)[0] == played(env, 2)[0] == [GOES_ON, IS_CUT]
    assert InfiniteHorizon(inner).max_episode_steps == 2
    assert TimeAware(InfiniteHorizon(TimeLimit(inner, 200), 50)).max_episode_steps == 2
    assert TimeAware(InfiniteHorizon(Script(GOES_ON), 50)).max_episode_steps == 50


def test_the_remaining_time_falls_from_one_to_zero():
    env = TimeAware(Script(GOES_ON), max_episode_steps=4)

    seen = [env.reset()[0], *(env.step(np.zeros(1))[0] for _ in range(6))]

    # 1 - k / 4; where nobody ends the episode, nothing is left any more.
    np.testing.assert_array_equal([obs[2] for obs in seen], [1, 0.75, 0.5, 0.25, 0, 0, 0])
    assert all(env.observation_space.contains(obs) for obs in seen)
    np.testing.assert_array_equal(seen[0][:2], seen[5][:2])
    assert env.reset()[0][2] == 1.0
    assert TimeAware(TimeLimit(Script(GOES_ON), 7)).max_episode_steps == 7


def test_a_dict_of_observations_gets_the_remaining_time_under_a_name_of_its_own():
    space = spaces.Dict(image=spaces.Box(0, 255, (2, 2), np.uint8), n=ONE)
    inner = Script(GOES_ON, space=space)
    env = TimeAware(inner, max_episode_steps=2)

    first, _ = env.reset(seed=0)
    second, *_ = env.step(np.zeros(1))

    assert set(first) == {"image", "n", "remaining_time"} == {*space, "remaining_time"}
    assert [first["remaining_time"], second["remaining_time"]] == [1.0, 0.5]
    assert env.observation_space.contains(first) and env.observation_space.contains(second)


@pytest.mark.parametrize(
    ("wrapper", "arguments", "space", "says"),
    [
        (InfiniteHorizon, {}, None, "cannot tell after how many steps"),
        (InfiniteHorizon, {"max_episode_steps": 0}, None, "positive whole number"),
        (TimeAware, {"max_episode_steps": 2.5}, None, "positive whole number"),
        (TimeAware, {"max_episode_steps": True}, None, "positive whole number"),
        (TimeAware, {"max_episode_steps": 5}, spaces.Box(0.0, 1.0, (2, 2)), "FlattenObservation"),
        (TimeAware, {"max_episode_steps": 5}, spaces.Box(0, 9, (2,), int), "Box of floats"),
        (TimeAware, {"max_episode_steps": 5}, spaces.Discrete(3), "or a Dict"),
        (TimeAware, {"max_episode_steps": 5}, spaces.Dict(remaining_time=ONE), "remaining_time"),
    ],
)
def test_what_makes_no_sense_is_refused_with_the_way_out(wrapper, arguments, space, says):
    with pytest.raises(ParameterError, match=says):
        wrapper(Script(GOES_ON, space=space), **arguments)


def test_an_end_by_hand_is_a_truncation_and_a_fall_stays_one():
    env = ManualReset(Script(GOES_ON))
    env.reset()
    env.request()

    assert env.step(np.zeros(1))[2:] == (*IS_CUT, {"manual_reset": True})
    # Asked once, ended once; and a request from before an episode is none in it.
    assert env.step(np.zeros(1))[2:] == (*GOES_ON, {})
    env.request()
    env.reset()
    assert env.step(np.zeros(1))[2:] == (*GOES_ON, {})
    flags, infos = played(ManualReset(Script(FALLS), wanted=lambda: True), 1)
    assert (flags, infos) == ([BOTH], [{"manual_reset": True}])


def test_who_wants_the_end_can_be_named_and_a_spec_remembers_the_name_and_no_function():
    made = gymnasium.make("Pendulum-v1")

    named, function = (
        ManualReset(made, wanted).spec for wanted in ("moving_joints.somebody", lambda: True)
    )

    assert named.additional_wrappers[-1].kwargs == {"wanted": "moving_joints.somebody"}
    assert function.additional_wrappers[-1].kwargs == {"wanted": None}
    env = gymnasium.make(named)
    env.reset()
    assert env.step(np.zeros(1, np.float32))[4]["manual_reset"]
    for who, flags in (("somebody", IS_CUT), ("nobody", GOES_ON)):
        again = pickle.loads(pickle.dumps(ManualReset(Script(GOES_ON), f"moving_joints.{who}")))
        assert played(again, 1)[0] == [flags]
    with pytest.raises(ParameterError, match=r"no function 'moving_joints\.none'"):
        ManualReset(Script(GOES_ON), "moving_joints.none")
