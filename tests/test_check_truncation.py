"""Whether a time-out reaches the learner, in environments whose mistake is known."""

import re

import gymnasium
import numpy as np
import pytest
from counting import CountingVector
from gymnasium import spaces
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import TimeLimit
from gymnasium.wrappers.vector import RescaleAction
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecEnv,
    VecEnvWrapper,
    VecMonitor,
)

from sb3_hds.errors import ParameterError
from sb3_hds.wrappers import (
    GymnasiumVecEnv,
    InfiniteHorizon,
    TimeAware,
    TruncateToTerminate,
    check_truncation,
)

LIMIT = 20
every_mode = pytest.mark.parametrize("mode", list(AutoresetMode), ids=lambda mode: mode.name)


class Drawn(gymnasium.Env):
    """
    Observations that are drawn; an episode fails in each step with the same probability.

    :param failing: the probability
    :param limit: steps after which it calls itself terminated
    :param how: in which the limit is told: ``"terminated"``, ``"truncated"``, or ``"info"`` (a
        termination with ``TimeLimit.truncated``)
    """

    observation_space = spaces.Box(-1.0, 1.0, (2,))
    action_space = spaces.Box(-1.0, 1.0, (1,))

    def __init__(self, failing: float = 0.0, limit: int | None = None, how: str = "terminated"):
        self.failing, self.limit, self.how = failing, limit, how

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.n = 0
        return self._obs(), {}

    def step(self, action):
        self.n += 1
        late = self.limit is not None and self.n >= self.limit
        failed = bool(self.np_random.random() < self.failing)
        over = failed or (late and self.how != "truncated")
        info = {"TimeLimit.truncated": True} if late and self.how == "info" else {}
        return self._obs(), 1.0, over, late and self.how == "truncated", info

    def _obs(self):
        return self.np_random.uniform(-1.0, 1.0, 2).astype(np.float32)


class OldStyle(Drawn):
    """Of the time before truncations: four values."""

    def step(self, action):
        obs, reward, terminated, truncated, info = super().step(action)
        return obs, reward, terminated or truncated, info


class Foreign(VecEnv):
    """
    Somebody's own ``VecEnv``.

    :param envs: its copies
    :param flag: whether ``TimeLimit.truncated`` is told ``"always"``, only ``"where true"``, or
        ``"never"``
    :param last: which ``terminal_observation``: ``"right"``, ``"none"``, that of the ``"next"``
        episode, or ``"all"`` rows
    """

    def __init__(self, envs, flag: str = "always", last: str = "right"):
        self.envs, self.flag, self.last = envs, flag, last
        super().__init__(len(envs), envs[0].observation_space, envs[0].action_space)

    def reset(self):
        return np.stack([env.reset(seed=s)[0] for env, s in zip(self.envs, self._seeds)])  # noqa: B905

    def step_async(self, actions):
        self.actions = actions

    def step_wait(self):
        obs, rewards, dones, infos = [], [], [], []
        for env, action in zip(self.envs, self.actions, strict=True):
            seen, reward, terminated, truncated, info = env.step(action)
            if terminated or truncated:
                cut, following = truncated and not terminated, env.reset()[0]
                info = info | self._told(cut, seen, following)
                seen = following
            obs.append(seen)
            rewards.append(reward)
            dones.append(terminated or truncated)
            infos.append(info)
        return np.stack(obs), np.array(rewards), np.array(dones), infos

    def _told(self, cut, seen, following):
        told = {"right": seen, "next": following, "all": np.stack([seen] * self.num_envs)}
        flag = self.flag == "always" or (self.flag == "where true" and cut)
        info = {"TimeLimit.truncated": cut} if flag else {}
        return info | ({"terminal_observation": told[self.last]} if self.last in told else {})

    def close(self):
        pass

    def get_attr(self, attr_name, indices=None):
        return [None] * self.num_envs

    def set_attr(self, attr_name, value, indices=None):
        pass

    def env_method(self, method_name, *args, indices=None, **kwargs):
        return [None] * self.num_envs

    def env_is_wrapped(self, wrapper_class, indices=None):
        return [False] * self.num_envs


def limited(failing: float = 0.0, wrap=lambda env: env) -> gymnasium.Env:
    return wrap(TimeLimit(Drawn(failing), LIMIT))


def foreign(failing: float = 0.0, n: int = 2, **how) -> Foreign:
    return Foreign([limited(failing) for _ in range(n)], **how)


def problem(env, **how) -> str:
    """:return: the only problem, in one line"""
    report = check_truncation(env, **how)
    assert len(report.problems) == 1 and not report.ok, report
    return report.problems[0]


# --- environments of Gymnasium -------------------------------------------------------------------


@pytest.mark.parametrize("failing", [0.0, 0.02])
def test_a_time_limit_of_gymnasium_is_fine(failing):
    report = check_truncation(limited(failing))

    assert report.ok and report.problems == [] and report.notes == []


def test_a_limit_that_every_episode_reaches_as_a_termination_is_found():
    text = problem(Drawn(limit=LIMIT))

    assert "20 of 20 episodes ended as terminations after exactly 20 steps" in text
    assert "max_episode_steps=20" in text and "truncated=True, terminated=False" in text
    # What it says mends it.
    assert check_truncation(InfiniteHorizon(Drawn(limit=LIMIT), max_episode_steps=LIMIT)).ok


@pytest.mark.parametrize("seed", range(2))
def test_a_limit_that_few_episodes_reach_is_found(seed):
    # Each step fails with 2 %: of 20 episodes, 0.98^49 = 37 % reach the limit, all others end at
    # times of their own.
    text = problem(Drawn(0.02, limit=50), seed=seed)

    found = re.match(r"(\d+) of 2\d episodes ended as terminations after exactly 50 steps", text)
    assert found and 3 <= int(found[1]) <= 14


@pytest.mark.parametrize("failing", [0.01, 0.1])
def test_failures_at_any_time_are_no_limit(failing):
    for seed in range(4):
        assert check_truncation(Drawn(failing), seed=seed).ok


def test_failures_about_the_same_time_are_no_limit():
    lengths = np.rint(np.random.default_rng(0).normal(42.0, 2.0, 50))

    class Falling(Drawn):
        def step(self, action):
            obs, reward, _, _, info = super().step(action)
            return obs, reward, bool(self.n >= lengths[self.episode]), False, info

        def reset(self, *, seed=None, options=None):
            self.episode = 0 if seed is not None else self.episode + 1
            return super().reset(seed=seed)

    assert check_truncation(Falling()).ok


def test_where_no_time_out_was_seen_it_says_so():
    # A limit that ends the task is fine where observations tell the time.
    told = check_truncation(limited(wrap=lambda env: TruncateToTerminate(TimeAware(env))))
    early = check_truncation(TimeLimit(Drawn(0.3), 500))

    assert told.ok and "all 4 episodes terminated, 4 of them at the limit of 20" in told.notes[0]
    assert early.ok and "all 20 episodes terminated before the limit of 500" in early.notes[0]
    assert "No episode ended in 2000 steps" in problem(Drawn())


def test_a_time_out_that_stands_in_info_only_is_found():
    # The number of steps gives it away as well: two paragraphs.
    texts = check_truncation(Drawn(limit=LIMIT, how="info")).problems

    assert "20 time-outs of 20 ends stood only in info['TimeLimit.truncated']" in texts[0]


def test_a_step_of_four_values_and_a_reset_without_a_seed_are_found():
    class OldReset(OldStyle):
        def reset(self):
            return super().reset(seed=0)[0]

    assert "With a single 'done', a time-out cannot" in problem(OldStyle(limit=LIMIT))
    assert "(obs, info) from reset(seed=..., options=...)" in problem(OldReset(limit=LIMIT))


# --- environments of SB3 -------------------------------------------------------------------------


@pytest.mark.parametrize(
    "kind", [DummyVecEnv, pytest.param(SubprocVecEnv, marks=pytest.mark.expensive)]
)
def test_sb3_tells_time_outs_and_where_they_were(kind):
    env = VecMonitor(kind([limited] * 2))
    try:
        report = check_truncation(env, n_steps=200)
    finally:
        env.close()

    assert report.ok and report.notes == []


# --- those of others -----------------------------------------------------------------------------


@pytest.mark.parametrize("flag", ["always", "where true"])
def test_a_foreign_vec_env_may_tell_time_outs_only_where_there_are_some(flag):
    # SB3 reads a missing entry as False.
    report = check_truncation(foreign(0.03, flag=flag), n_steps=800)

    assert report.ok and report.notes == []


@pytest.mark.parametrize(
    ("how", "said"),
    [
        ({"flag": "never"}, "infos[i] had no 'TimeLimit.truncated'"),
        ({"last": "none"}, "had no 'terminal_observation'"),
        ({"last": "next"}, "was what step() returned as well"),
        ({"last": "all"}, "of shape (2, 2) instead of one observation"),
    ],
)
def test_a_foreign_vec_env_that_loses_time_outs_or_last_observations_is_found(how, said):
    assert said in problem(foreign(**how))


# --- vectorised environments of Gymnasium --------------------------------------------------------


@every_mode
def test_time_outs_arrive_in_every_autoreset_mode_and_limits_that_terminate_are_found(mode):
    right, wrong = (
        [lambda how=how: limited(wrap=how)] * 2 for how in (lambda env: env, TruncateToTerminate)
    )

    report = check_truncation(SyncVectorEnv(right, autoreset_mode=mode))

    # Who uses them without the adapter has to know.
    assert report.ok
    assert any("NEXT_STEP" in note for note in report.notes) == (mode is AutoresetMode.NEXT_STEP)
    assert check_truncation(GymnasiumVecEnv(SyncVectorEnv(right, autoreset_mode=mode))).ok
    text = problem(SyncVectorEnv(wrong, autoreset_mode=mode))
    assert "ended as terminations after exactly 20 steps" in text


@pytest.mark.parametrize("mode", [AutoresetMode.SAME_STEP, AutoresetMode.DISABLED])
def test_copies_of_somebodys_own_are_judged(mode):
    # Half of the episodes are cut, after one to four steps.
    assert check_truncation(CountingVector(3, mode), n_steps=100).ok
    lossy = CountingVector(3, AutoresetMode.SAME_STEP, final_obs=None)
    assert "final_obs" in problem(lossy, n_steps=100)


def test_copies_of_somebodys_own_that_reset_a_step_late_need_the_adapters_help():
    env = CountingVector(3, AutoresetMode.NEXT_STEP)

    assert "partial_reset=" in problem(env, n_steps=100)
    adapted = GymnasiumVecEnv(
        env, partial_reset=lambda which: env.reset(options={"reset_mask": which})
    )
    assert check_truncation(adapted, n_steps=100).ok


# --- what it is asked ----------------------------------------------------------------------------


def test_the_environment_is_left_open_and_its_spaces_undrawn():
    env = limited()
    env.action_space.seed(3)
    expected = env.action_space.sample()
    env.action_space.seed(3)

    check_truncation(env)

    np.testing.assert_array_equal(env.action_space.sample(), expected)
    env.reset(seed=0)
    env.step(expected)


def test_other_things_are_refused():
    with pytest.raises(ParameterError, match="got str"):
        check_truncation("Pendulum-v1")
    with pytest.raises(ParameterError, match="at least one step"):
        check_truncation(limited(), n_steps=0)


def test_a_vector_environment_whose_copies_cannot_be_reset_alone_is_a_problem():
    copies = gymnasium.make_vec("CartPole-v1", 2, "sync")

    report = check_truncation(gymnasium.wrappers.vector.NormalizeObservation(copies))

    assert not report.ok and "VecNormalize" in report.problems[0]


# --- limits inside limits ------------------------------------------------------------------------


class CutsVectors(VecEnvWrapper):
    """A vectorised wrapper that has a limit of its own, which is never reached here."""

    _max_episode_steps = None

    def __init__(self, env, limit):
        super().__init__(env)
        self._max_episode_steps = limit

    def reset(self):
        return self.venv.reset()

    def step_wait(self):
        return self.venv.step_wait()


def outrun() -> gymnasium.Env:
    return TimeLimit(limited(), 1_000)


@pytest.mark.parametrize(
    "stacked",
    [
        outrun,
        lambda: Monitor(outrun()),
        lambda: InfiniteHorizon(Monitor(limited()), 1_000),
        lambda: DummyVecEnv([limited, outrun]),
        lambda: VecMonitor(CutsVectors(DummyVecEnv([limited] * 2), 1_000)),
        lambda: SyncVectorEnv([outrun] * 2),
        lambda: RescaleAction(SyncVectorEnv([outrun] * 2), -1.0, 1.0),
        lambda: GymnasiumVecEnv(SyncVectorEnv([outrun] * 2)),
    ],
)
def test_a_limit_around_a_shorter_one_is_found_through_every_wrapper(stacked):
    text = problem(stacked())

    assert re.match(r"The limit of 1000 steps of \w+ never acts", text)
    assert "that of 20 steps of TimeLimit inside it comes first" in text


def test_it_says_how_an_environment_of_gymnasium_gets_the_longer_limit():
    text = problem(TimeLimit(gymnasium.make("Pendulum-v1"), 1_000))

    assert "gymnasium.make('Pendulum-v1', max_episode_steps=1000)" in text
    assert check_truncation(gymnasium.make("Pendulum-v1", max_episode_steps=300)).ok


def test_a_limit_around_a_longer_one_or_an_equal_one_is_fine():
    for limit in (1_000, LIMIT):
        assert check_truncation(TimeLimit(TimeLimit(Drawn(), limit), LIMIT)).ok


def test_a_shorter_limit_that_the_environment_keeps_to_itself_is_seen_by_where_episodes_end():
    text = problem(TimeLimit(Drawn(0.005, limit=LIMIT, how="truncated"), 500))

    found = re.match(r"(\d+) of 20 episodes were cut after exactly 20 steps", text)
    # Each step fails with 0.5 %: 0.995^19 = 91 % reach the limit.
    assert found and 12 <= int(found[1]) <= 20
    assert "the limit of 500 steps of TimeLimit never acts" in text


@pytest.mark.parametrize("kind", [SubprocVecEnv, AsyncVectorEnv])
@pytest.mark.expensive
def test_it_is_found_in_copies_in_processes_of_their_own(kind):
    env = kind([outrun] * 2)
    try:
        text = problem(env, n_steps=400)
        env.reset()
    finally:
        env.close()

    assert "20 of 20 episodes were cut after exactly 20 steps" in text
    assert "the limit of 1000 steps of the outermost wrapper never acts" in text
