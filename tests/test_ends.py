"""What wrappers make of the end of an episode, and of the time that is left until then."""

import pickle

import gymnasium
import numpy as np
import pytest
from cases import each
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit
from odd_envs import OBS, AnySpaces

from sb3_hds.errors import ParameterError
from sb3_hds.wrappers import (
    InfiniteHorizon,
    ManualReset,
    TerminateToTruncate,
    TimeAware,
    TruncateToTerminate,
)

ONE, STILL = spaces.Discrete(3), np.zeros(1, np.float32)
#: terminated, truncated
GOES_ON, FALLS, IS_CUT, BOTH = (False, False), (True, False), (False, True), (True, True)


class Script(AnySpaces):
    """Ends as written, the last flags for ever, and pays the number of the step."""

    def __init__(self, *flags, space=OBS, told=None):
        super().__init__(space)
        self.flags, self.told = flags, told or {}

    def step(self, action):
        obs, *_ = super().step(action)
        flags = self.flags[min(self.n, len(self.flags)) - 1]
        return obs, float(self.n), *flags, dict(self.told)


def played(env, n):
    env.reset(seed=0)
    steps = [env.step(STILL) for _ in range(n)]
    assert [step[1] for step in steps] == list(range(1, n + 1))
    return [step[2:4] for step in steps], [step[4] for step in steps]


@each(
    (TerminateToTruncate, FALLS, IS_CUT, "was_terminated"),
    (TerminateToTruncate, IS_CUT, IS_CUT, None),
    (TerminateToTruncate, BOTH, IS_CUT, "was_terminated"),
    (TruncateToTerminate, FALLS, FALLS, None),
    (TruncateToTerminate, IS_CUT, FALLS, "was_truncated"),
    # Over is over, whatever else would have cut it.
    (TruncateToTerminate, BOTH, FALLS, None),
)
def test_an_end_becomes_one_of_the_other_kind_and_info_says_so(wrapper, flags, expected, said):
    found, infos = played(wrapper(Script(GOES_ON, flags)), 2)
    _, told = played(wrapper(Script(flags, told={"TimeLimit.truncated": not expected[1]})), 1)

    assert found == [GOES_ON, expected] and infos == [{}, {said: True} if said else {}]
    # The old entry for time-outs is set right where the end became another.
    assert told[0]["TimeLimit.truncated"] is (expected[1] == bool(said))


@each(
    ([GOES_ON], [GOES_ON, GOES_ON, IS_CUT], {}),
    ([GOES_ON, GOES_ON, FALLS], [GOES_ON, GOES_ON, IS_CUT], {"was_terminated": True}),
    ([GOES_ON, FALLS], [GOES_ON, FALLS], {}),
    ([GOES_ON, IS_CUT], [GOES_ON, IS_CUT], {}),
)
def test_a_horizon_without_an_end_cuts_at_the_limit_and_leaves_earlier_ends(flags, expected, said):
    found, infos = played(InfiniteHorizon(Script(*flags), 3), len(expected))
    assert found == expected and infos[-1] == said


def test_the_limit_counts_from_every_reset_and_is_the_least_of_several():
    inner = TimeLimit(Script(GOES_ON), 2)

    assert played(env := InfiniteHorizon(inner), 2)[0] == played(env, 2)[0] == [GOES_ON, IS_CUT]
    assert InfiniteHorizon(inner).max_episode_steps == 2
    assert TimeAware(InfiniteHorizon(TimeLimit(inner, 200), 50)).max_episode_steps == 2
    assert TimeAware(InfiniteHorizon(Script(GOES_ON), 50)).max_episode_steps == 50


def test_the_remaining_time_falls_from_one_to_zero():
    space = spaces.Dict(image=spaces.Box(0, 255, (2, 2), np.uint8), n=ONE)
    flat = TimeAware(Script(GOES_ON), max_episode_steps=4)
    named = TimeAware(Script(GOES_ON, space=space), max_episode_steps=4)

    whole = lambda env: [env.reset()[0], *(env.step(STILL)[0] for _ in range(6))]  # noqa: E731
    seen, told = whole(flat), whole(named)

    # 1 - k / 4; where nobody ends the episode, nothing is left any more.
    remaining = [1, 0.75, 0.5, 0.25, 0, 0, 0]
    np.testing.assert_array_equal([obs[-1] for obs in seen], remaining)
    assert all(flat.observation_space.contains(obs) for obs in seen)
    assert [obs["remaining_time"] for obs in told] == remaining and set(space) < set(told[0])
    assert all(named.observation_space.contains(obs) for obs in told) and flat.reset()[0][-1] == 1.0
    assert TimeAware(TimeLimit(Script(GOES_ON), 7)).max_episode_steps == 7


@each(
    (InfiniteHorizon, {}, OBS, "cannot tell after how many steps"),
    (TimeAware, {"max_episode_steps": 2.5}, OBS, "positive whole number"),
    (TimeAware, {"max_episode_steps": 5}, spaces.Box(0.0, 1.0, (2, 2)), "FlattenObservation"),
    (TimeAware, {"max_episode_steps": 5}, spaces.Box(0, 9, (2,), int), "Box of floats"),
    (TimeAware, {"max_episode_steps": 5}, spaces.Discrete(3), "or a Dict"),
    (TimeAware, {"max_episode_steps": 5}, spaces.Dict(remaining_time=ONE), "remaining_time"),
)
def test_what_makes_no_sense_is_refused_with_the_way_out(wrapper, arguments, space, says):
    with pytest.raises(ParameterError, match=says):
        wrapper(Script(GOES_ON, space=space), **arguments)


def test_an_end_by_hand_is_a_truncation_and_a_fall_stays_one():
    env = ManualReset(Script(GOES_ON))
    env.reset()
    env.request()

    assert env.step(STILL)[2:] == (*IS_CUT, {"manual_reset": True})
    # Asked once, ended once; and a request from before an episode is none in it.
    assert env.step(STILL)[2:] == (*GOES_ON, {})
    env.request()
    env.reset()
    assert env.step(STILL)[2:] == (*GOES_ON, {})
    flags, infos = played(ManualReset(Script(FALLS), wanted=lambda: True), 1)
    assert (flags, infos) == ([BOTH], [{"manual_reset": True}])


def test_who_wants_the_end_can_be_named_and_a_spec_remembers_the_name_and_no_function():
    made = gymnasium.make("Pendulum-v1")

    named = ManualReset(made, "moving_joints.somebody").spec
    function = ManualReset(made, lambda: True).spec

    assert function.additional_wrappers[-1].kwargs == {"wanted": None}
    env = gymnasium.make(named)
    env.reset()
    assert env.step(STILL)[4]["manual_reset"]
    again = pickle.loads(pickle.dumps(ManualReset(Script(GOES_ON), "moving_joints.somebody")))
    assert played(again, 1)[0] == [IS_CUT]
    with pytest.raises(ParameterError, match=r"no function 'moving_joints\.none'"):
        ManualReset(Script(GOES_ON), "moving_joints.none")
