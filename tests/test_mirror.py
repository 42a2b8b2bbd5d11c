"""Which twin mirrors an environment, however that is wrapped and vectorised."""

import dataclasses
import math
from functools import partial
from typing import ClassVar

import gymnasium
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium import spaces, wrappers
from jaxtyping import Array, Float
from stable_baselines3.common.env_util import make_vec_env
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
from sb3_hds.core import Channel, ObservationTransform, RescaleAction, TransformedTwin
from sb3_hds.envs import TwinEnv, TwinVecEnv, check_mirrors, twin_of, verify_mirror
from sb3_hds.errors import EnvironmentMismatchError, NoTwinError
from sb3_hds.twins import Pendulum


class Tinted(gymnasium.Wrapper):
    """A wrapper of somebody's own, which Gymnasium cannot record."""


class Monitor(gymnasium.Wrapper):
    """Has the name of a neutral wrapper, and is none."""


def _patched_time_limit(env):
    """The TimeLimit that rl_zoo3 puts in the place of Gymnasium's, which is restored."""
    places = (gymnasium.wrappers, gymnasium.wrappers.common, gymnasium.envs.registration)
    before = [(place, place.TimeLimit) for place in places if hasattr(place, "TimeLimit")]
    from rl_zoo3.gym_patches import PatchedTimeLimit

    for place, original in before:
        place.TimeLimit = original
    return PatchedTimeLimit(env.env, 200)


# --- parameters ----------------------------------------------------------------------------------


@pytest.mark.parametrize("env_id", twins.all_ids())
def test_an_environment_made_by_its_id_has_its_twin_and_agrees_with_it(env_id):
    env = gymnasium.make(env_id)

    twin = twin_of(env)

    assert type(twin) is twins.get(env_id)
    # Observations may be single precision; on a chaotic linkage one step magnifies that tenfold.
    assert verify_mirror(env, twin) < 1e-4


def copies(*makers):
    """:return: copies that close themselves, in this process and in others"""
    for kind in (DummyVecEnv, SubprocVecEnv):
        env = kind(list(makers))
        yield env
        env.close()


def test_arguments_of_the_environment_reach_the_twin_from_other_processes_too():
    gravity = partial(gymnasium.make, "Pendulum-v1", g=9.8)
    # Other processes have to import us first, as for every id that is not Gymnasium's own.
    payload = "sb3_hds:sb3_hds/PayloadPendulum-v0"
    payload = partial(gymnasium.make, payload, goal="stop_at_origin", mass=2.0)
    unnamed = partial(TwinEnv, "Pendulum", mass=1.3)

    for env in copies(gravity):
        assert twin_of(env).values == {"gravity": 9.8, "mass": 1.0, "length": 1.0}
    for env in copies(payload):
        assert (twin_of(env).goal, twin_of(env).values["mass"]) == ("stop_at_origin", 2.0)
    for env in copies(lambda: SB3Monitor(unnamed())):
        assert twin_of(env).values["mass"] == 1.3


def test_environments_made_of_a_twin_give_it_back():
    twin = Pendulum(mass=1.3)

    assert twin_of(TwinEnv(twin)) is twin
    assert twin_of(SB3Monitor(TwinEnv(twin))) is twin
    assert twin_of(VecMonitor(TwinVecEnv(twin, 2))) is twin


def test_copies_that_differ_are_refused():
    makers = [partial(gymnasium.make, "Pendulum-v1", g=g) for g in (10.0, 9.8)]

    for env in copies(*makers):
        says = r"copies 0 and 1 .* differ: gravity is 10 and 9.8 m/s2"
        with pytest.raises(EnvironmentMismatchError, match=says):
            twin_of(env)


# --- wrappers ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "wrap",
    [
        lambda env: wrappers.TimeLimit(env, 50),
        wrappers.Autoreset,
        lambda env: SB3Monitor(wrappers.RecordEpisodeStatistics(env)),
        _patched_time_limit,
        lambda env: env.unwrapped,
    ],
)
def test_wrappers_that_leave_the_problem_alone_are_looked_through(wrap):
    assert type(twin_of(wrap(gymnasium.make("Pendulum-v1")))) is Pendulum


@pytest.mark.parametrize(
    ("name", "wrap"),
    [
        ("FlattenObservation", wrappers.FlattenObservation),
        ("RescaleAction", lambda env: wrappers.RescaleAction(env, -1.0, 1.0)),
        ("NormalizeReward", wrappers.NormalizeReward),
        ("DiscretizeAction", lambda env: wrappers.DiscretizeAction(env, 5)),
        ("Tinted", lambda env: SB3Monitor(Tinted(env))),
        ("Monitor", Monitor),
    ],
)
def test_other_wrappers_are_refused_by_name(name, wrap):
    env = wrap(gymnasium.make("Pendulum-v1"))

    with pytest.raises(EnvironmentMismatchError, match=rf"wrapper {name} may .* pass a twin="):
        twin_of(env)
    with pytest.raises(EnvironmentMismatchError, match=rf"wrapper {name} may"):
        twin_of(DummyVecEnv([lambda: env]))


@pytest.mark.parametrize(
    ("name", "wrap"),
    [
        ("Tinted", Tinted),
        # Its argument cannot be sent between processes.
        ("TransformReward", lambda env: wrappers.TransformReward(env, lambda reward: 2 * reward)),
    ],
)
def test_wrappers_in_other_processes_are_refused_by_name_and_survive(name, wrap):
    env = make_vec_env("Pendulum-v1", 1, wrapper_class=wrap, vec_env_cls=SubprocVecEnv)
    try:
        with pytest.raises(EnvironmentMismatchError, match=f"wrapper {name} may"):
            twin_of(env)
        assert env.reset().shape == (1, 3)
    finally:
        env.close()


def test_wrappers_of_vectorised_environments_are_looked_through_or_refused():
    env = make_vec_env("Pendulum-v1", 2)

    assert type(twin_of(VecNormalize(VecCheckNan(VecMonitor(TwinVecEnv("Pendulum")))))) is Pendulum
    assert type(twin_of(VecNormalize(env))) is Pendulum
    with pytest.raises(EnvironmentMismatchError, match="VecEnv wrapper VecFrameStack may"):
        twin_of(VecNormalize(VecFrameStack(env, 2)))


# --- spaces --------------------------------------------------------------------------------------


class Strange(gymnasium.Env):
    """An environment with a given action space."""

    observation_space = spaces.Box(-1.0, 1.0, (3,))

    def __init__(self, action_space):
        self.action_space = action_space


@pytest.mark.parametrize(
    ("space", "says"),
    [
        (spaces.Discrete(2), r"must be a Box with one axis, got Discrete\(2\)"),
        (spaces.Box(-1.0, 1.0, (1, 1)), "must be a Box with one axis"),
        (spaces.Box(-np.inf, np.inf, (1,)), "these must be finite"),
    ],
)
def test_actions_that_cannot_be_planned_are_refused_with_the_reason(space, says):
    with pytest.raises(EnvironmentMismatchError, match=says):
        twin_of(Strange(space))
    with pytest.raises(EnvironmentMismatchError, match=says):
        check_mirrors(Strange(space), Pendulum())


def test_an_environment_without_a_twin_says_why_and_how_to_add_one():
    with pytest.raises(EnvironmentMismatchError, match="continuous actions"):
        twin_of(gymnasium.make("CartPole-v1"))
    with pytest.raises(NoTwinError, match=r"no twin for 'Swimmer-v5'[\s\S]*twins.register"):
        twin_of(gymnasium.make("Swimmer-v5"))
    with pytest.raises(TypeError, match=r"gymnasium.Env or an SB3 VecEnv"):
        twin_of("Pendulum-v1")


def test_an_environment_elsewhere_that_cannot_be_read_is_refused():
    env = SubprocVecEnv([lambda: Strange(spaces.Box(-1.0, 1.0, (1,)))])
    try:
        with pytest.raises(NoTwinError, match=r"not made by gymnasium.make[\s\S]*pass twin="):
            twin_of(env)
    finally:
        env.close()


def test_a_twin_is_checked_against_the_environment_as_wrapped():
    env = wrappers.RescaleAction(gymnasium.make("Pendulum-v1"), -1.0, 1.0)
    through_the_wrapper = TransformedTwin(Pendulum(), action=RescaleAction())

    check_mirrors(env, through_the_wrapper)
    check_mirrors(DummyVecEnv([lambda: env]), through_the_wrapper)
    # Gymnasium rescales in single precision.
    assert verify_mirror(env, through_the_wrapper) < 1e-5
    with pytest.raises(EnvironmentMismatchError, match=r"\[-1.0\] to \[1.0\], and the .* \[-2.0\]"):
        check_mirrors(env, Pendulum())


@pytest.mark.parametrize(
    ("env_id", "says"),
    [
        ("MountainCarContinuous-v0", r"from \[-1.0\] to \[1.0\]"),
        ("InvertedPendulum-v5", r"from \[-3.0\] to \[3.0\]"),
        ("Swimmer-v5", r"takes 2 actions and Pendulum has 1 actuators \(torque\)"),
    ],
)
def test_a_twin_of_another_environment_is_refused(env_id, says):
    with pytest.raises(EnvironmentMismatchError, match=says):
        check_mirrors(gymnasium.make(env_id), Pendulum())


def test_observations_of_another_size_are_refused():
    env = wrappers.TimeAwareObservation(gymnasium.make("Pendulum-v1"))

    with pytest.raises(EnvironmentMismatchError, match=r"shape \(3,\) \(cos, sin, speed\)"):
        check_mirrors(env, Pendulum())


# --- side by side --------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class WithoutSpeed(ObservationTransform):
    """Hides the speed of a pendulum, and infers zero."""

    name: ClassVar[str] = "without_speed"

    def channels(self, below: tuple[Channel, ...]) -> tuple[Channel, ...]:
        return below[:2]

    def observe(
        self, obs: Float[Array, " inner"], below: tuple[Channel, ...]
    ) -> Float[Array, " outer"]:
        return obs[:2]

    def invert(
        self, obs: Float[Array, " outer"], below: tuple[Channel, ...]
    ) -> Float[Array, " inner"]:
        return jnp.append(obs, 0.0)


@pytest.mark.parametrize("difference", [{"mass": 1.1}, {"dt": 0.06}])
def test_a_twin_that_differs_is_found_out(difference):
    env = gymnasium.make("Pendulum-v1")
    paid = wrappers.TransformReward(env, lambda reward: reward + 0.1)

    with pytest.raises(EnvironmentMismatchError, match="error in 'speed' reaches"):
        verify_mirror(env, Pendulum(**difference))
    with pytest.raises(EnvironmentMismatchError, match="error in 'reward' reaches"):
        verify_mirror(paid, Pendulum())


def test_a_state_that_cannot_be_observed_is_not_compared():
    twin = TransformedTwin(Pendulum(), observation=WithoutSpeed())

    with pytest.warns(UserWarning, match="does not tell the state of Pendulum"):
        assert math.isnan(verify_mirror(TwinEnv(twin), twin))
