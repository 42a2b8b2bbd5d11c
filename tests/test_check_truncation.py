"""Whether a time-out reaches the learner, in environments whose mistake is known."""

import re

import gymnasium
import numpy as np
import pytest
from cases import each
from counting import CountingVector
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import TimeLimit
from gymnasium.wrappers.vector import NormalizeObservation, RescaleAction
from odd_envs import AnySpaces
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnvWrapper, VecMonitor

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


class Drawn(AnySpaces):
    """Fails by chance; its limit is told as an end, as a truncation or in ``info``."""

    def __init__(self, failing: float = 0.0, limit: int | None = None, how: str = "terminated"):
        super().__init__()
        self.failing, self.limit, self.how = failing, limit, how

    def step(self, action):
        obs, reward, *_ = super().step(action)
        late = self.limit is not None and self.n >= self.limit
        failed = bool(self.np_random.random() < self.failing)
        over = failed or (late and self.how != "truncated")
        info = {"TimeLimit.truncated": True} if late and self.how == "info" else {}
        return obs, reward, over, late and self.how == "truncated", info


class Foreign(VecEnvWrapper):
    """Somebody's own ``VecEnv``: how it flags time-outs, and what it tells last."""

    def __init__(self, failing: float = 0.0, flag: str = "always", last: str = "right"):
        super().__init__(DummyVecEnv([lambda: limited(failing)] * 2))
        self.flag, self.last = flag, last

    def reset(self):
        return self.venv.reset()

    def step_wait(self):
        obs, rewards, dones, infos = self.venv.step_wait()
        for i, info in enumerate(infos):
            if self.flag == "never" or not (self.flag == "always" or info["TimeLimit.truncated"]):
                del info["TimeLimit.truncated"]
            if dones[i]:
                seen = info.pop("terminal_observation")
                told = {"right": seen, "next": obs[i].copy(), "all": np.stack([seen] * 2)}
                info |= {"terminal_observation": told[self.last]} if self.last in told else {}
        return obs, rewards, dones, infos


def limited(failing: float = 0.0, wrap=lambda env: env) -> gymnasium.Env:
    return wrap(TimeLimit(Drawn(failing), LIMIT))


def outrun() -> gymnasium.Env:
    return TimeLimit(limited(), 1_000)


class OldStyle(Drawn):
    """Of the time before truncations: four values."""

    def step(self, action):
        obs, reward, terminated, truncated, info = super().step(action)
        return obs, reward, terminated or truncated, info


class OldReset(OldStyle):
    def reset(self):
        return super().reset(seed=0)[0]


@each(
    (lambda: limited(0.02), None),
    (lambda: VecMonitor(DummyVecEnv([limited] * 2)), None),
    (lambda: Foreign(0.03, flag="where true"), None),  # SB3 reads a missing entry as False
    # Around a longer limit, or an equal one.
    (lambda: TimeLimit(TimeLimit(Drawn(), 1_000), LIMIT), None),
    (lambda: TimeLimit(limited(), LIMIT), None),
    (lambda: gymnasium.make("Pendulum-v1", max_episode_steps=300), None),
    # The remedy that is named for a limit that terminates.
    (lambda: InfiniteHorizon(Drawn(limit=LIMIT), max_episode_steps=LIMIT), None),
    # Copies of somebody's own: half of the episodes are cut, after one to four steps.
    (lambda: CountingVector(3, AutoresetMode.SAME_STEP), None),
    (lambda: CountingVector(3, AutoresetMode.DISABLED), None),
    # A limit that ends the task is fine where observations tell the time.
    (lambda: limited(wrap=lambda env: TruncateToTerminate(TimeAware(env))), "the limit of 20"),
    (lambda: TimeLimit(Drawn(0.3), 500), "before the limit of 500"),
    # Failures at any time are no limit.
    (lambda: Drawn(0.01), "terminated"),
    (lambda: Drawn(0.1), "terminated"),
)
def test_what_is_right_is_fine_and_where_no_time_out_was_seen_a_note_says_so(env, noted):
    report = check_truncation(env())
    assert report.ok and report.problems == []
    assert noted in report.notes[0] if noted else report.notes == []


def test_failures_about_the_same_time_are_no_limit():
    lengths = iter(np.rint(np.random.default_rng(0).normal(42.0, 2.0, 50)))

    class Falling(Drawn):
        def reset(self, *, seed=None, options=None):
            self.limit = next(lengths)
            return super().reset(seed=seed)

    assert check_truncation(Falling()).ok


@every_mode
def test_time_outs_arrive_in_every_autoreset_mode_and_limits_that_terminate_are_found(mode):
    right, wrong = [limited] * 2, [lambda: limited(wrap=TruncateToTerminate)] * 2

    report = check_truncation(SyncVectorEnv(right, autoreset_mode=mode))

    # Who uses them without the adapter has to know.
    assert report.ok
    assert any("NEXT_STEP" in note for note in report.notes) == (mode is AutoresetMode.NEXT_STEP)
    assert check_truncation(GymnasiumVecEnv(SyncVectorEnv(right, autoreset_mode=mode))).ok
    [text] = check_truncation(SyncVectorEnv(wrong, autoreset_mode=mode)).problems
    assert "ended as terminations after exactly 20 steps" in text


NEVER_ACTS = (
    "limit of 1000 steps of .* never takes effect.* that of 20 steps of TimeLimit .*_steps=1000"
)
SELDOM = "(1[2-9]|20) of 20 .* truncated after exactly 20 .* limit of 500 steps of TimeLimit never"
REMOTE = "20 of 20 .* truncated after exactly 20 .* 1000 steps of the outermost wrapper never"


@each(
    (lambda: Drawn(limit=LIMIT), "20 of 20 .* terminations after exactly 20 steps.*_steps=20"),
    # Of 20 episodes, 0.98^49 = 37 % reach the limit, all others end at times of their own.
    (lambda: Drawn(0.02, limit=50), "[3-9] of 2. .* terminations after exactly 50 steps"),
    # The number of steps gives it away as well: two paragraphs.
    (lambda: Drawn(limit=LIMIT, how="info"), "20 time-outs of 20 ends came only as info.*"),
    (lambda: OldStyle(limit=LIMIT), "With a single 'done', a time-out cannot"),
    (lambda: OldReset(limit=LIMIT), "from reset.seed=..., options=...."),
    (Drawn, "No episode ended in 2000 steps"),
    (lambda: Foreign(flag="never"), "had no 'TimeLimit.truncated'"),
    (lambda: Foreign(last="none"), "had no 'terminal_observation'"),
    (lambda: Foreign(last="next"), "was what step.. returned as well"),
    (lambda: Foreign(last="all"), "of shape .2, 3. instead of one observation"),
    (lambda: CountingVector(3, AutoresetMode.SAME_STEP, final_obs=None), "final_obs"),
    (lambda: CountingVector(3, AutoresetMode.NEXT_STEP), "partial_reset="),
    (lambda: NormalizeObservation(gymnasium.make_vec("CartPole-v1", 2, "sync")), "VecNormalize"),
    # Limits around shorter ones.
    (outrun, NEVER_ACTS),
    (lambda: InfiniteHorizon(Monitor(limited()), 1_000), NEVER_ACTS),
    (lambda: DummyVecEnv([limited, outrun]), NEVER_ACTS),
    (lambda: RescaleAction(SyncVectorEnv([outrun] * 2), -1.0, 1.0), NEVER_ACTS),
    (lambda: GymnasiumVecEnv(SyncVectorEnv([outrun] * 2)), NEVER_ACTS),
    # Each step fails with 0.5 %: 0.995^19 = 91 % reach the inner limit.
    (lambda: TimeLimit(Drawn(0.005, limit=LIMIT, how="truncated"), 500), SELDOM),
    pytest.param(lambda: SubprocVecEnv([outrun] * 2), REMOTE, marks=pytest.mark.expensive),
)
def test_what_is_wrong_is_found(env, said):
    env = env()
    report = check_truncation(env)
    if isinstance(env, SubprocVecEnv):
        env.close()

    assert not report.ok and re.search(said, report.problems[0], re.DOTALL), report


def test_what_is_no_environment_is_refused():
    with pytest.raises(ParameterError, match="got str"):
        check_truncation("Pendulum-v1")
    with pytest.raises(ParameterError, match="at least one step"):
        check_truncation(limited(), n_steps=0)
