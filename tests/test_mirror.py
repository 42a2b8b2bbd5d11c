"""Which twin mirrors an environment, however that is wrapped and vectorised."""

import math
from functools import partial

import gymnasium
import numpy as np
import pytest
from cases import each
from gymnasium import spaces, wrappers
from odd_envs import AnySpaces
from stable_baselines3.common.monitor import Monitor as SB3Monitor
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecCheckNan,
    VecFrameStack,
    VecMonitor,
    VecNormalize,
)

from sb3_hds import twins
from sb3_hds.core import RescaleAction, TransformedTwin
from sb3_hds.envs import TwinEnv, TwinVecEnv, check_mirrors, twin_of, verify_mirror
from sb3_hds.errors import EnvironmentMismatchError, NoTwinError
from sb3_hds.twins import Pendulum
from sb3_hds.wrappers import ActionDelay, ActionShield


class Tinted(gymnasium.Wrapper): ...


class Monitor(gymnasium.Wrapper):
    """Has the name of a neutral wrapper, and is none."""


def read_elsewhere(make):
    """:return: what is known of a copy in another process, which goes on"""
    env = SubprocVecEnv([make])
    try:
        return twin_of(env)
    finally:
        env.reset()
        env.close()


def test_arguments_and_layers_reach_the_twin_from_other_processes_too():
    # Another process has to import us first, as for every id that is not Gymnasium's own.
    payload = "sb3_hds:sb3_hds/PayloadPendulum-v0"
    payload = partial(gymnasium.make, payload, goal="stop_at_origin", mass=2.0)

    found = read_elsewhere(lambda: ActionDelay(payload(), 2))

    assert found == twin_of(DummyVecEnv([lambda: ActionDelay(payload(), 2)] * 2))
    assert found == twin_of(ActionDelay(payload(), 2))
    assert (found.base.goal, found.values["mass"]) == ("stop_at_origin", 2.0)
    assert twin_of(gymnasium.make("Pendulum-v1", g=9.8)).values["gravity"] == 9.8
    assert read_elsewhere(lambda: TwinEnv("Pendulum", mass=1.3)).values["mass"] == 1.3


@each(
    # Its argument cannot be sent between processes.
    (
        lambda: wrappers.TransformReward(gymnasium.make("Pendulum-v1"), lambda reward: reward),
        "wrapper TransformReward may",
    ),
    (AnySpaces, r"not made by gymnasium.make[\s\S]*pass twin="),
)
def test_what_cannot_be_read_in_another_process_is_refused_and_survives(make, says):
    with pytest.raises((EnvironmentMismatchError, NoTwinError), match=says):
        read_elsewhere(make)


def test_environments_made_of_a_twin_give_it_back():
    twin = Pendulum(mass=1.3)

    assert twin_of(SB3Monitor(TwinEnv(twin))) is twin
    assert twin_of(VecNormalize(VecCheckNan(VecMonitor(TwinVecEnv(twin, 2))))) is twin
    with pytest.raises(EnvironmentMismatchError, match="VecEnv wrapper VecFrameStack may"):
        twin_of(VecNormalize(VecFrameStack(TwinVecEnv(twin, 2), 2)))


@each(
    lambda env: wrappers.TimeLimit(env, 50),
    wrappers.Autoreset,
    lambda env: SB3Monitor(wrappers.RecordEpisodeStatistics(env)),
    lambda env: env.unwrapped,
)
def test_wrappers_that_leave_the_problem_alone_are_looked_through(wrap):
    assert type(twin_of(wrap(gymnasium.make("Pendulum-v1")))) is Pendulum


@each(
    ("FlattenObservation", wrappers.FlattenObservation),
    ("ActionShield", lambda env: ActionDelay(ActionShield(env, ([[1.0]], [1.0])), 1)),
    ("Tinted", lambda env: SB3Monitor(Tinted(env))),
    ("Monitor", Monitor),
)
def test_other_wrappers_are_refused_by_name(name, wrap):
    env = wrap(gymnasium.make("Pendulum-v1"))
    for one in (env, DummyVecEnv([lambda: env])):
        with pytest.raises(EnvironmentMismatchError, match=rf"wrapper {name} may .* pass a twin="):
            twin_of(one)


def test_a_twin_is_checked_against_the_environment_as_wrapped():
    env = wrappers.RescaleAction(gymnasium.make("Pendulum-v1"), -1.0, 1.0)
    through_the_wrapper = TransformedTwin(Pendulum(), action=RescaleAction())

    check_mirrors(env, through_the_wrapper)
    check_mirrors(DummyVecEnv([lambda: env]), through_the_wrapper)
    # Gymnasium rescales in single precision.
    assert verify_mirror(env, through_the_wrapper) < 1e-5
    with pytest.raises(EnvironmentMismatchError, match=r"\[-1.0\] to \[1.0\], and the .* \[-2.0\]"):
        check_mirrors(env, Pendulum())


@each(
    (gymnasium.make("CartPole-v1"), "continuous actions"),
    (gymnasium.make("Humanoid-v5"), r"no twin for 'Humanoid-v5'[\s\S]*twins.register"),
    ("Pendulum-v1", r"gymnasium.Env or an SB3 VecEnv"),
    (AnySpaces(action_space=spaces.Box(-1.0, 1.0, (1, 1))), "one axis"),
    (AnySpaces(action_space=spaces.Box(-np.inf, np.inf, (1,))), "finite"),
    (DummyVecEnv([partial(gymnasium.make, "Pendulum-v1", g=g) for g in (9, 8)]), "gravity is 9 an"),
    ids=["discrete", "no twin", "an id", "matrix", "no limits", "copies that differ"],
)
def test_an_environment_without_a_twin_says_why(env, says):
    with pytest.raises((EnvironmentMismatchError, NoTwinError, TypeError), match=says):
        twin_of(env)


@each(
    (gymnasium.make("MountainCarContinuous-v0"), r"from \[-1.0\] to \[1.0\]"),
    (gymnasium.make("Swimmer-v5"), r"takes 2 actions and Pendulum has 1 actuators \(torque\)"),
    (wrappers.TimeAwareObservation(gymnasium.make("Pendulum-v1")), r"\(3,\) \(cos, sin, spee"),
    (AnySpaces(action_space=spaces.Discrete(2)), "one axis"),
    ids=["other limits", "other actions", "other observations", "discrete"],
)
def test_a_twin_of_another_environment_is_refused(env, says):
    with pytest.raises(EnvironmentMismatchError, match=says):
        check_mirrors(env, Pendulum())


@pytest.mark.parametrize("difference", [{"mass": 1.1}, {"dt": 0.06}])
def test_a_twin_that_differs_is_found_out(difference):
    env = gymnasium.make("Pendulum-v1")
    paid = wrappers.TransformReward(env, lambda reward: reward + 0.1)

    with pytest.raises(EnvironmentMismatchError, match="error in 'speed' reaches"):
        verify_mirror(env, Pendulum(**difference))
    with pytest.raises(EnvironmentMismatchError, match="error in 'reward' reaches"):
        verify_mirror(paid, Pendulum())


def test_a_state_that_cannot_be_observed_is_not_compared():
    blind = twins.make("CartPole", observe="q")
    with pytest.warns(UserWarning, match="does not determine the state of CartPole"):
        assert math.isnan(verify_mirror(TwinEnv(blind), blind))
