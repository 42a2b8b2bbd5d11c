"""One contract for every Gymnasium wrapper: whoever adds one adds an entry to ``CASES``."""

import contextlib
import copy
import itertools
import pickle
import warnings
from collections.abc import Callable, Mapping
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

from sb3_hds import wrappers
from sb3_hds.wrappers.action_layer import ActionLayer


class Case(NamedTuple):
    """What it is made with, and whether another process or ``env.spec`` can have it again."""

    wrapper: type[gymnasium.Wrapper]
    arguments: Mapping[str, Any] | Callable[[Path], Mapping[str, Any]] = {}
    env_id: str = "Pendulum-v1"
    pickles: bool = True
    remade: bool = True


TWO_JOINTS = {"omega_swing": 4.0, "phase": [0.0, 1.5]}
BARRIER = {"low": -2.0, "high": 2.0, "position": [[0, 1]], "on_breach": "ignore"}
PHASE = {"name": "only", "mapping": [[2.0]], "constraints": [[[1.0]], [0.5]]}
_numbers = itertools.count()


def fresh_path(folder: Path) -> dict[str, Any]:
    return {"path": str(folder / f"{next(_numbers)}.jsonl")}


CASES = {
    "ActionDelay": Case(wrappers.ActionDelay, {"steps": 2}),
    "ActionRateLimit": Case(wrappers.ActionRateLimit, {"max_rate": 10.0}),
    "ActionScale": Case(wrappers.ActionScale, {"schedule": [[0, 0.2], [20, 1.0]]}),
    "ActionShield": Case(wrappers.ActionShield, {"constraints": [[[1.0]], [1.5]]}),
    "CPGPrior": Case(wrappers.CPGPrior, {"mode": "parameters", "omega_swing": 6.0}),
    "CPGPrior, MuJoCo": Case(wrappers.CPGPrior, TWO_JOINTS, "Swimmer-v5", pickles=False),
    "ContinuityCost": Case(wrappers.ContinuityCost, {"weight": 0.1}),
    "HistoryObservation": Case(wrappers.HistoryObservation, {"n_observations": 2}),
    "InfiniteHorizon": Case(wrappers.InfiniteHorizon, {"max_episode_steps": 20}),
    # Pendulum-v1 is commanded by its torque, which the barrier would object to.
    "JointLimitBarrier": Case(wrappers.JointLimitBarrier, BARRIER),
    "LowPassAction": Case(wrappers.LowPassAction, {"cutoff": 4.0}),
    "ManualReset": Case(wrappers.ManualReset, {"wanted": "moving_joints.nobody"}),
    "Perturb": Case(wrappers.Perturb, {"noise": 0.1}),
    # Without a watchdog, which would act where the machine is busy.
    "RealTime": Case(wrappers.RealTime, {"period": 1e-4}),
    # An open file, which is never overwritten.
    "Record": Case(wrappers.Record, fresh_path, pickles=False, remade=False),
    "SharedControlTemplate": Case(wrappers.SharedControlTemplate, {"phases": [PHASE]}),
    # Environments of MuJoCo begin anew where they are unpickled.
    "ShowJoints": Case(wrappers.ShowJoints, env_id="Swimmer-v5", pickles=False),
    "TerminateToTruncate": Case(wrappers.TerminateToTruncate, env_id="MountainCarContinuous-v0"),
    "TimeAware": Case(wrappers.TimeAware),
    "TruncateToTerminate": Case(wrappers.TruncateToTerminate),
}
# What the spaces of the wrapped environments bring along, and that there is a wrapper at all.
_UNAVOIDABLE = ("normalized", "symmetric", "infinity", "has a wrapper applied")

every_wrapper = pytest.mark.parametrize("name", CASES)


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
    classes = {o for o in public if isinstance(o, type) and issubclass(o, gymnasium.Wrapper)}
    assert classes == {case.wrapper for case in CASES.values()}


@every_wrapper
def test_spaces_contain_what_comes_out_and_the_seed_decides_what_follows(name, tmp_path):
    env = wrapped(name, tmp_path)
    # What the constructor was told is recorded in the spec.
    remade = CASES[name].remade
    second = gymnasium.make(env.spec) if remade else wrapped(name, tmp_path)
    obs, _ = env.reset(seed=0)

    assert env.observation_space.contains(obs) and str(second) == str(env)
    for obs, reward, terminated, truncated, info in steps(env, 30):
        assert env.observation_space.contains(obs)
        assert np.isfinite(float(reward)) and isinstance(info, dict)
        assert type(terminated) is bool and type(truncated) is bool
    # After an episode that went another way.
    again = trace(env, 30, 3)
    assert same(again, trace(second, 30, 3)) and not same(again, trace(second, 30, 4))


@every_wrapper
def test_seeds_options_and_actions_arrive_and_layers_tell_what_they_did(name, tmp_path):
    case, heard = CASES[name], []

    class Listening(gymnasium.Wrapper):
        def reset(self, *, seed=None, options=None):
            heard.append((seed, options))
            return self.env.reset(seed=seed)

        def step(self, action):
            heard.append(action)
            return self.env.step(action)

    env = case.wrapper(Listening(gymnasium.make(case.env_id)), **arguments_of(case, tmp_path))
    env.reset(seed=7, options={"wind": 1.0})

    assert heard == [(7, {"wind": 1.0})]
    *_, info = steps(env, 1)[0]
    assert env.env.action_space.contains(heard[-1])
    if isinstance(env, ActionLayer):
        assert {"raw_action", "correction", "constraint_cost"} <= set(info)
        np.testing.assert_array_equal(info["safe_action"], heard[-1])
        with pytest.raises(ValueError, match="finite actions"):
            env.step(np.full(env.action_space.shape, np.nan))


@pytest.mark.parametrize("name", [name for name, case in CASES.items() if case.pickles])
def test_a_pickled_wrapper_goes_on_where_it_was(name, tmp_path):
    env = wrapped(name, tmp_path)
    env.reset(seed=0)
    steps(env, 10)

    again = pickle.loads(pickle.dumps(env))

    for one, two in zip(steps(env, 30, seed=2), steps(again, 30, seed=2), strict=True):
        np.testing.assert_array_equal(*(flat(env.observation_space, s[0]) for s in (one, two)))
        assert one[1:4] == two[1:4]


@every_wrapper
def test_both_checkers_accept_it(name, tmp_path):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        with contextlib.closing(wrapped(name, tmp_path)) as env:
            remade = CASES[name].remade
            check_gymnasium(env, skip_render_check=True, skip_close_check=not remade)
        with contextlib.closing(wrapped(name, tmp_path)) as env:
            check_sb3(env)

    messages = [str(w.message) for w in caught]
    assert [m for m in messages if not any(known in m for known in _UNAVOIDABLE)] == []


@every_wrapper
def test_the_wrapped_environment_stays_as_it_was(name, tmp_path):
    case = CASES[name]
    inner = gymnasium.make(case.env_id)
    own = (inner.observation_space, inner.action_space)
    before, alone = copy.deepcopy(own), trace(inner, 30, 0)

    env = case.wrapper(inner, **arguments_of(case, tmp_path))
    trace(env, 30, 0)

    assert inner.observation_space is own[0] and inner.action_space is own[1]
    assert (inner.observation_space, inner.action_space) == before
    assert same(trace(inner, 30, 0), alone)
    assert env.unwrapped is inner.unwrapped and env.env is inner


@pytest.mark.skipif(find_spec("rl_zoo3") is None, reason="needs the extra 'zoo'")
@every_wrapper
def test_the_zoo_makes_it_from_a_yml_entry(name, tmp_path):
    from rl_zoo3.utils import get_wrapper_class

    case = CASES[name]
    path, arguments = f"sb3_hds.wrappers.{case.wrapper.__name__}", arguments_of(case, tmp_path)
    entry = yaml.safe_dump({"env_wrapper": [{path: arguments} if arguments else path]})

    wrap = get_wrapper_class(yaml.safe_load(entry))

    assert wrap is not None
    env = wrap(gymnasium.make(case.env_id))
    assert type(env) is case.wrapper
    assert same(trace(env, 10, 0), trace(wrapped(name, tmp_path), 10, 0))
