"""Control periods, overruns and the watchdog: against a clock of our own, and once a real one."""

import time

import gymnasium
import numpy as np
import pytest
from cases import each
from gymnasium import spaces
from small_models import small

from sb3_hds.algos import TrainBeside
from sb3_hds.errors import ParameterError, SafetyError
from sb3_hds.wrappers import RealTime, Timing


class Time:
    """A clock that only sleeping moves, and whoever holds it."""

    def __init__(self):
        self.now, self.slept = 100.0, []

    def clock(self):
        return self.now

    def sleep(self, seconds):
        self.slept.append(seconds)
        self.now += seconds


class Plant(gymnasium.Env):
    """Notes when it is told what; a step takes as long as it is said to. Each step is worth one."""

    def __init__(self, time=None, takes=0.0, length=1000):
        self.observation_space = spaces.Box(-np.inf, np.inf, (1,))
        self.action_space = spaces.Box(-1.0, 1.0, (1,))
        self.time, self.takes, self.length, self.told = time, takes, length, []

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.n = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        if not np.isfinite(action).all():
            raise ValueError("no number")
        self.told.append((self.time.clock() if self.time else time.monotonic(), float(action[0])))
        self.time.sleep(self.takes) if self.time else time.sleep(self.takes)
        self.n += 1
        return np.full(1, self.n, np.float32), 1.0, False, self.n >= self.length, {}


def controlled(takes=0.0, length=1000, safe=None):
    """A period of 0.1 s, begun with a first command at 100 s."""
    ours = Time()
    how = {"threaded": False, "clock": ours.clock, "sleep": ours.sleep}
    env = RealTime(Plant(ours, 0.0, length), 0.1, safe, **how)
    env.reset(seed=0)
    env.step(GO)
    env.unwrapped.takes = takes
    return env, ours


GO = np.array([1.0], np.float32)


def times(env):
    """After the first command."""
    return [at for at, _ in env.unwrapped.told[1:]]


def test_commands_act_at_the_ticks_however_fast_the_learner_is():
    env, ours = controlled(takes=0.02)
    slow, _ = controlled(takes=0.25)

    for thinking in (0.0, 0.0525, 0.0325):
        ours.now += thinking
        env.step(GO)
    slow.step(GO)
    slow.step(GO)

    assert times(env) == pytest.approx([100.1, 100.2, 100.3])
    assert env.latency == pytest.approx(0.0325) and not env.overrun
    assert env.timing == Timing(steps=4)
    # Bins of 5 ms up to 0.2 s.
    counts, edges = env.latencies()
    assert np.flatnonzero(counts).tolist() == [0, 6, 10] and counts[-1] == 0
    assert edges[10] == pytest.approx(0.05) and edges[-1] == np.inf
    # A step from 0.1 to 0.35 s, so the next tick is at 0.4 s.
    assert times(slow) == pytest.approx([100.1, 100.4])
    assert slow.timing == Timing(steps=3, slow_steps=2)


def test_a_late_command_is_counted_and_acts_at_once_and_within_the_grace_keeps_the_ticks():
    for late, safe, expected in (
        # Nobody kept the ticks meanwhile: the next period counts from the late command.
        (0.17, None, [100.17, 100.27]),
        (0.12, [-1.0], [100.12, 100.2]),
    ):
        env, ours = controlled(safe=safe)

        ours.now += late
        assert safe is None or not env.watch()
        *_, info = env.step(GO)
        overrun = env.overrun
        env.step(GO)

        assert times(env) == pytest.approx(expected)
        assert overrun and not env.overrun and info["missed_steps"] == 0
        assert env.timing == Timing(steps=3, overruns=1)


def test_the_watchdog_sends_the_safe_action_at_each_tick_without_a_command():
    env, ours = controlled(safe=[-1.0])
    sent = []

    for _ in range(14):  # looks every 25 ms, as a thread would, for 350 ms
        ours.now += 0.025
        sent.append(env.watch())
    obs, reward, _, _, info = env.step(GO)

    # Ticks at 0.1, 0.2 and 0.3 s, each with 0.05 s of grace; the command acts at the next one.
    assert [command for _, command in env.unwrapped.told[1:]] == [-1.0, -1.0, -1.0, 1.0]
    assert times(env) == pytest.approx([100.15, 100.25, 100.35, 100.4])
    assert (obs[0], reward, info["missed_steps"]) == (5.0, 4.0, 3)
    assert env.timing == Timing(steps=2, overruns=1, safe_actions=3)


def test_a_watchdog_that_was_held_up_does_not_make_up_for_ticks_in_a_burst():
    env, ours = controlled(safe=[-1.0])

    ours.now += 0.57
    *_, info = env.step(GO)

    assert [command for _, command in env.unwrapped.told[1:]] == [-1.0, 1.0]
    assert times(env) == pytest.approx([100.57, 100.6]) and info["missed_steps"] == 1


def test_an_episode_that_ends_under_the_watchdog_is_reported_and_the_command_dropped():
    env, ours = controlled(safe=[-1.0], length=3)

    for _ in range(30):
        ours.now += 0.025
        env.watch()
    obs, reward, terminated, truncated, info = env.step(GO)

    assert (obs[0], reward, terminated, truncated) == (3.0, 2.0, False, True)
    assert info["command_dropped"] and info["missed_steps"] == 2
    assert env.timing == Timing(steps=1, safe_actions=2, dropped=1)


@pytest.mark.parametrize("reset_first", [True, False])
def test_no_tick_passes_while_a_learner_trains_between_episodes(reset_first):
    env, ours = controlled(safe=[-1.0], length=2)
    env.step(GO)

    if reset_first:
        env.reset()
    ours.now += 60.0
    assert not env.watch()
    if not reset_first:
        env.reset()
    env.step(GO)
    ours.now += 0.05
    env.step(GO)

    assert not env.overrun and env.timing == Timing(steps=4)
    assert times(env) == pytest.approx([100.1, 160.1, 160.2]) and env.latencies()[0].sum() == 2


def interrupt(seconds):
    raise KeyboardInterrupt


@each(
    (interrupt, GO, KeyboardInterrupt),
    (None, np.array([np.nan]), ValueError),
    ids=["interrupted", "refused"],
)
def test_the_watchdog_goes_on_where_a_step_was_not_finished(sleep, action, error):
    env, ours = controlled(safe=[-1.0])
    ours.now += 0.16
    assert env.watch()
    env._sleep = sleep or ours.sleep
    with pytest.raises(error):
        env.step(action)
    env._sleep = ours.sleep

    for _ in range(20):
        ours.now += 0.025
        env.watch()

    assert [command for _, command in env.unwrapped.told[1:]] == [-1.0] * 6
    assert env.step(GO)[-1]["missed_steps"] == 6


@each(
    ({"period": 0.0}, "period must be above 0"),
    ({"period": 0.1, "grace": 1.5}, "grace must be from 0 to 1"),
    ({"period": 0.1, "safe_action": [3.0]}, "must be in Box"),
)
def test_arguments_out_of_range_are_refused(arguments, says):
    with pytest.raises(ParameterError, match=says):
        RealTime(Plant(), **arguments)


def test_in_real_time_a_learner_that_hangs_is_replaced_by_the_watchdog():
    env = RealTime(Plant(takes=0.002), 0.02, [-1.0])
    begin = time.monotonic()
    env.reset()
    try:
        for _ in range(5):
            env.step(GO)
        time.sleep(0.3)  # the learner hangs for 15 periods
        *_, info = env.step(GO)
    finally:
        env.close()

    # Never faster than the clock, and how much slower depends on the machine.
    assert time.monotonic() - begin >= 4 * 0.02 + 0.3 and 1 <= info["missed_steps"] <= 16
    assert [command for _, command in env.unwrapped.told[-2:]] == [-1.0, 1.0]
    assert env.timing.steps == 6 and env.timing.safe_actions >= info["missed_steps"]


def test_a_watchdog_whose_safe_action_fails_says_so_and_stays_still():
    class Broken(Plant):
        def step(self, action):
            if float(action[0]) == 0.5:
                raise OSError("no answer from the drive")
            return super().step(action)

    env = RealTime(Broken(), 0.1, [0.5])
    env.reset()
    env.step(GO)
    time.sleep(0.35)
    with pytest.raises(SafetyError, match="watchdog"):
        env.step(GO)
    assert len(env.unwrapped.told) == 1
    env.reset()
    env.step(GO)
    env.close()


def test_training_beside_the_loop_improves_the_policy_while_the_environment_runs():
    env = gymnasium.wrappers.TimeLimit(Plant(takes=0.002), 20)
    model = small("droq", env, gradient_steps=0, learning_starts=20)
    beside = TrainBeside(gradient_steps=2, most=3.0)
    before = model.get_parameters()["policy"]
    before = {name: tensor.clone() for name, tensor in before.items()}

    model.learn(120, callback=beside)

    done, after = beside.n_done, model.get_parameters()["policy"]
    assert 0 < done <= 3.0 * 120 + 2
    assert any(not np.array_equal(before[name], after[name]) for name in before)
    time.sleep(0.05)
    assert beside.n_done == done  # nothing runs on


def test_what_fails_beside_the_loop_fails_in_it():
    model = small("droq", Plant(takes=0.002), gradient_steps=0)

    def broken(**settings):
        raise RuntimeError("the network caught fire")

    model.train = broken
    with pytest.raises(RuntimeError, match="caught fire"):
        model.learn(500, callback=TrainBeside())
    with pytest.raises(ValueError, match="gradient_steps=0"):
        small("droq", Plant()).learn(5, callback=TrainBeside())
