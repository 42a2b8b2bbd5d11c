"""
One contract for every Gymnasium wrapper.

Whoever adds a wrapper adds one entry to ``CASES``.
"""

import contextlib
import copy
import itertools
import pickle
import warnings
from collections.abc import Callable, Mapping
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import numpy as np
import pytest
import yaml
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env as check_gymnasium
from stable_baselines3.common.env_checker import check_env as check_sb3
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

from sb3_hds import wrappers


class Case(NamedTuple):
    """
    :param wrapper: the class
    :param arguments: of its constructor, besides the environment; a function of an empty folder
        where it writes files
    :param env_id: of an environment that it fits
    :param pickles: False where it holds what no other process can have
    :param remade: False where ``env.spec`` cannot tell how to wrap again
    :param in_yml: False where an argument is no plain data
    """

    wrapper: type[gymnasium.Wrapper]
    arguments: Mapping[str, Any] | Callable[[Path], Mapping[str, Any]] = {}
    env_id: str = "Pendulum-v1"
    pickles: bool = True
    remade: bool = True
    in_yml: bool = True


def standing_still() -> float:
    return 0.0


def no_waiting(seconds: float) -> None:
    pass


CASES = {
    "ActionDelay": Case(wrappers.ActionDelay, {"steps": 2}),
    "ActionRateLimit": Case(wrappers.ActionRateLimit, {"max_rate": 10.0}),
    "ActionScale": Case(wrappers.ActionScale, {"scale": 0.5}),
    "ActionScale, schedule": Case(wrappers.ActionScale, {"schedule": [[0, 0.2], [20, 1.0]]}),
    "ActionShield": Case(wrappers.ActionShield, {"constraints": [[[1.0]], [1.5]]}),
    "CPGPrior": Case(wrappers.CPGPrior, {"omega_swing": 6.0}),
    "CPGPrior, own parameters": Case(wrappers.CPGPrior, {"mode": "parameters", "omega_swing": 6.0}),
    "CPGPrior, joints of MuJoCo": Case(
        wrappers.CPGPrior, {"omega_swing": 4.0, "phase": [0.0, 1.5]}, "Swimmer-v5", pickles=False
    ),
    "CPGPrior, joints observed": Case(
        wrappers.CPGPrior,
        {"omega_swing": 4.0, "mode": "residual", "position": [0], "velocity": [2]},
        "InvertedPendulum-v5",
        pickles=False,
    ),
    "ContinuityCost": Case(wrappers.ContinuityCost, {"weight": 0.1}),
    "HistoryObservation": Case(wrappers.HistoryObservation, {"n_observations": 2}),
    "InfiniteHorizon": Case(wrappers.InfiniteHorizon, {"max_episode_steps": 20}),
    # Pendulum-v1 is commanded by its torque, which the barrier would object to.
    "JointLimitBarrier": Case(
        wrappers.JointLimitBarrier,
        {"low": -2.0, "high": 2.0, "position": [[0, 1]], "on_breach": "ignore"},
    ),
    "LowPassAction": Case(wrappers.LowPassAction, {"cutoff": 4.0}),
    "ManualReset": Case(wrappers.ManualReset),
    "ManualReset, by name": Case(wrappers.ManualReset, {"wanted": "moving_joints.nobody"}),
    "Perturb": Case(wrappers.Perturb, {"noise": 0.1}),
    # Without a watchdog, which would act where the machine is busy; and with one, at a clock that
    # stands still.
    "RealTime": Case(wrappers.RealTime, {"period": 1e-4}),
    "RealTime, watchdog": Case(
        wrappers.RealTime,
        {
            "period": 0.1,
            "safe_action": [0.0],
            "threaded": False,
            "clock": standing_still,
            "sleep": no_waiting,
        },
        remade=False,
        in_yml=False,
    ),
    # An open file, which is never overwritten.
    "Record": Case(
        wrappers.Record,
        lambda folder: {"path": str(folder / "run.jsonl")},
        pickles=False,
        remade=False,
    ),
    "SharedControlTemplate": Case(
        wrappers.SharedControlTemplate,
        {
            "phases": [
                {
                    "name": "down",
                    "mapping": [[2.0]],
                    "transitions": [{"to": "up", "when": {"channel": 0, "above": 0.0}}],
                },
                {"name": "up", "mapping": [[1.0]], "constraints": [[[1.0]], [0.5]]},
            ]
        },
    ),
    # Environments of MuJoCo begin anew where they are unpickled.
    "ShowJoints": Case(wrappers.ShowJoints, env_id="Swimmer-v5", pickles=False),
    "TerminateToTruncate": Case(wrappers.TerminateToTruncate, env_id="MountainCarContinuous-v0"),
    "TimeAware": Case(wrappers.TimeAware),
    "TimeAware, own limit": Case(wrappers.TimeAware, {"max_episode_steps": 50}),
    "TruncateToTerminate": Case(wrappers.TruncateToTerminate),
}
# What the spaces of the wrapped environments bring along, and that there is a wrapper at all.
_UNAVOIDABLE = ("normalized", "symmetric", "infinity", "has a wrapper applied")

every_wrapper = pytest.mark.parametrize("name", CASES)


@pytest.fixture
def new_folder(tmp_path):
    """:return: a function that makes an empty folder at each call"""
    numbers = itertools.count()

    def make() -> Path:
        folder = tmp_path / str(next(numbers))
        folder.mkdir()
        return folder

    return make


def arguments_of(case: Case, folder: Path) -> dict[str, Any]:
    return dict(case.arguments(folder) if callable(case.arguments) else case.arguments)


def wrapped(name: str, folder: Path, **settings: Any) -> gymnasium.Env:
    case = CASES[name]
    env = gymnasium.make(case.env_id, **settings)
    return case.wrapper(env, **arguments_of(case, folder))


def steps(env: gymnasium.Env, n: int, seed: int = 1) -> list[tuple]:
    """:return: what ``n`` steps with drawn actions give, beginning anew where an episode ends"""
    space = copy.deepcopy(env.action_space)
    space.seed(seed)
    found = []
    for _ in range(n):
        found.append(env.step(space.sample()))
        if found[-1][2] or found[-1][3]:
            env.reset()
    return found


def flat(space: spaces.Space, obs: Any) -> np.ndarray:
    return np.asarray(spaces.flatten(space, obs), np.float64)


def trace(env: gymnasium.Env, n: int, seed: int | None) -> list[np.ndarray]:
    """:return: observation, reward and flags of a start and ``n`` steps"""
    start, _ = env.reset(seed=seed)
    rows = [flat(env.observation_space, start)]
    for obs, reward, terminated, truncated, _ in steps(env, n):
        numbers = [float(reward), terminated, truncated]
        rows.append(np.append(flat(env.observation_space, obs), numbers))
    return rows


def same(first: list[np.ndarray], second: list[np.ndarray]) -> bool:
    return all(np.array_equal(a, b) for a, b in zip(first, second, strict=True))


def test_every_wrapper_has_a_case():
    public = [getattr(wrappers, name) for name in wrappers.__all__]
    classes = {
        one for one in public if isinstance(one, type) and issubclass(one, gymnasium.Wrapper)
    }

    assert classes == {case.wrapper for case in CASES.values()}


@every_wrapper
def test_spaces_contain_what_comes_out_and_the_seed_decides_what_follows(name, new_folder):
    env, second = (wrapped(name, new_folder()) for _ in range(2))
    obs, _ = env.reset(seed=0)

    assert env.observation_space.contains(obs)
    for obs, reward, terminated, truncated, info in steps(env, 30):
        assert env.observation_space.contains(obs)
        assert np.isfinite(float(reward)) and isinstance(info, dict)
        assert type(terminated) is bool and type(truncated) is bool
    # After an episode that went another way.
    again = trace(env, 30, 3)
    assert same(again, trace(second, 30, 3)) and not same(again, trace(second, 30, 4))


@every_wrapper
def test_seeds_and_options_of_reset_reach_the_environment(name, new_folder):
    class Listening(gymnasium.Wrapper):
        def reset(self, *, seed=None, options=None):
            heard.append((seed, options))
            return self.env.reset(seed=seed)

    heard: list[Any] = []
    case = CASES[name]
    env = case.wrapper(Listening(gymnasium.make(case.env_id)), **arguments_of(case, new_folder()))

    env.reset(seed=7, options={"wind": 1.0})

    assert heard == [(7, {"wind": 1.0})]


@pytest.mark.parametrize("name", [name for name, case in CASES.items() if case.pickles])
def test_a_pickled_wrapper_goes_on_where_it_was(name, new_folder):
    env = wrapped(name, new_folder())
    env.reset(seed=0)
    steps(env, 10)

    again = pickle.loads(pickle.dumps(env))

    for one, two in zip(steps(env, 30, seed=2), steps(again, 30, seed=2), strict=True):
        np.testing.assert_array_equal(
            flat(env.observation_space, one[0]), flat(env.observation_space, two[0])
        )
        assert one[1:4] == two[1:4]


@every_wrapper
def test_both_checkers_accept_it(name, new_folder):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        with contextlib.closing(wrapped(name, new_folder())) as env:
            remade = CASES[name].remade
            check_gymnasium(env, skip_render_check=True, skip_close_check=not remade)
        with contextlib.closing(wrapped(name, new_folder())) as env:
            check_sb3(env)

    messages = [str(w.message) for w in caught]
    assert [m for m in messages if not any(known in m for known in _UNAVOIDABLE)] == []


@every_wrapper
def test_the_wrapped_environment_stays_as_it_was(name, new_folder):
    case = CASES[name]
    inner = gymnasium.make(case.env_id)
    own = (inner.observation_space, inner.action_space)
    before, alone = copy.deepcopy(own), trace(inner, 30, 0)

    env = case.wrapper(inner, **arguments_of(case, new_folder()))
    trace(env, 30, 0)

    assert inner.observation_space is own[0] and inner.action_space is own[1]
    assert (inner.observation_space, inner.action_space) == before
    assert same(trace(inner, 30, 0), alone)
    assert env.unwrapped is inner.unwrapped and env.env is inner


@every_wrapper
def test_several_copies_step_together_as_one_by_one(name, new_folder):
    together = DummyVecEnv([partial(wrapped, name, new_folder()) for _ in range(2)])
    together.seed(5)
    obs = [together.reset()]
    alone = [wrapped(name, new_folder()) for _ in range(2)]
    expected = [[env.reset(seed=5 + i)[0]] for i, env in enumerate(alone)]
    action = together.action_space.sample()

    for _ in range(5):
        obs.append(together.step(np.stack([action, action]))[0])
        for rows, env in zip(expected, alone, strict=True):
            rows.append(env.step(action)[0])

    for i, rows in enumerate(expected):
        for seen, row in zip(obs, rows, strict=True):
            one = {k: v[i] for k, v in seen.items()} if isinstance(seen, dict) else seen[i]
            np.testing.assert_array_equal(
                flat(alone[i].observation_space, one), flat(alone[i].observation_space, row)
            )


class Every(gymnasium.Env):
    """All wrappers, side by side: what each observes, one after the other."""

    action_space = spaces.Box(0.0, 1.0, (1,))

    def __init__(self, folder: Path) -> None:
        self._envs = []
        for i, name in enumerate(CASES):
            (folder / str(i)).mkdir(parents=True)
            self._envs.append(wrapped(name, folder / str(i)))
        size = sum(spaces.flatdim(env.observation_space) for env in self._envs)
        self.observation_space = spaces.Box(-np.inf, np.inf, (size,), np.float64)

    def reset(self, *, seed=None, options=None):
        for env in self._envs:
            env.action_space.seed(0)
        return self._seen([env.reset(seed=seed)[0] for env in self._envs]), {}

    def step(self, action):
        taken = [env.step(env.action_space.sample())[0] for env in self._envs]
        return self._seen(taken), 0.0, False, False, {}

    def _seen(self, obs):
        pairs = zip(self._envs, obs, strict=True)
        return np.concatenate([flat(env.observation_space, one) for env, one in pairs])


def test_another_process_sees_the_same(new_folder):
    away, here = (cls([partial(Every, new_folder())]) for cls in (SubprocVecEnv, DummyVecEnv))
    try:
        for env in (away, here):
            env.seed(3)
        np.testing.assert_array_equal(away.reset(), here.reset())
        for _ in range(3):
            there, _, _, _ = away.step(np.zeros((1, 1)))
            np.testing.assert_array_equal(there, here.step(np.zeros((1, 1)))[0])
    finally:
        away.close()


@pytest.mark.skipif(find_spec("rl_zoo3") is None, reason="needs the extra 'zoo'")
@pytest.mark.parametrize("name", [name for name, case in CASES.items() if case.in_yml])
def test_the_zoo_makes_it_from_a_yml_entry(name, new_folder):
    from rl_zoo3.utils import get_wrapper_class

    case, folder = CASES[name], new_folder()
    path, arguments = f"sb3_hds.wrappers.{case.wrapper.__name__}", arguments_of(case, folder)
    entry = yaml.safe_dump({"env_wrapper": [{path: arguments} if arguments else path]})

    wrap = get_wrapper_class(yaml.safe_load(entry))

    assert wrap is not None
    env = wrap(gymnasium.make(case.env_id))
    assert type(env) is case.wrapper
    assert same(trace(env, 10, 0), trace(wrapped(name, new_folder()), 10, 0))
