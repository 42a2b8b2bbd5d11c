"""Environments made of twins. Every registered twin must pass."""

import pickle
import warnings

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import each
from gymnasium.utils.env_checker import check_env as check_gymnasium
from stable_baselines3.common.env_checker import check_env as check_sb3

from sb3_hds import twins
from sb3_hds.effects import ViscousFriction
from sb3_hds.envs import TwinEnv, TwinVecEnv, programs, register_environments
from sb3_hds.envs.registration import HARDWARE, STEP_LIMITS
from sb3_hds.errors import NoTwinError, ParameterError
from sb3_hds.twins import Pendulum

ALL = [name for name in twins.names() if twins.get(name).env_id]  # rigs have no task
# What the spaces of real systems cannot avoid: torques in N m, positions without limit. And an
# environment that is not made by its id cannot be made again by the checker.
_UNAVOIDABLE = ("normalized", "infinity", "not having a spec")


def _make(name, **settings):
    """The environment of a registered id where there is one, bare."""
    env_id = twins.get(name).env_id
    if env_id in STEP_LIMITS:
        return gymnasium.make(env_id, **settings).unwrapped
    return TwinEnv(name, **settings)


@pytest.mark.parametrize("name", ALL)
def test_both_checkers_accept_every_twin_and_its_motion_shows(name):
    env = _make(name, render_mode="rgb_array")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check_gymnasium(env)
        check_sb3(env, skip_render_check=False)

    messages = [str(w.message) for w in caught]
    assert [m for m in messages if not any(known in m for known in _UNAVOIDABLE)] == []
    env.reset(seed=0)
    first = env.render()
    for _ in range(10):
        env.step(env.action_space.high)
    later = env.render()
    assert first.shape == later.shape == (400, 400, 3) and not np.array_equal(first, later)


@pytest.mark.parametrize("name", ["Pendulum", "InvertedDoublePendulum"])
def test_spaces_and_steps_are_those_of_the_twin(name):
    env, twin = TwinEnv(name), twins.make(name)
    np.testing.assert_array_equal(env.action_space.low, np.float32([a.low for a in twin.actuators]))
    highest = np.float32([c.high for c in twin.channels])
    np.testing.assert_array_equal(env.observation_space.high, highest)
    assert env.observation_space.dtype == env.action_space.dtype == np.float32
    starts = [env.reset(seed=0)[0]] + [env.reset()[0] for _ in range(3)]
    assert len(np.unique(starts, axis=0)) == 4
    before = jax.tree.map(jnp.asarray, env.state)
    action = env.action_space.sample()

    obs, reward, terminated, truncated, info = env.step(action)

    after = jax.jit(twin.step)(before, jnp.asarray(action), twin.params)
    expected = twin.reward(before, jnp.asarray(action), after, twin.params)
    # Compiled and interpreted programs round differently, by some 100 units in the last place.
    np.testing.assert_allclose(obs, twin.observe(after, twin.params), rtol=1e-5, atol=1e-5)
    assert type(reward) is float and reward == pytest.approx(float(expected), rel=1e-5, abs=1e-5)
    assert terminated is bool(twin.terminated(after, twin.params))
    assert (truncated, info) == (False, {})


def test_environments_of_equal_twins_share_one_compiled_program():
    programs.for_one.cache_clear()
    for mass in (1.0, 1.1):
        env = TwinEnv("Pendulum", mass=mass)
        env.reset(seed=0)
        env.step(np.ones(1, np.float32))

    assert programs.for_one.cache_info().currsize == 1
    assert programs.for_one(Pendulum()).step._cache_size() == 1


def test_settings_and_effects_reach_the_simulation():
    start = {"state": (1.0, 2.0)}
    twin = Pendulum()
    envs = [
        TwinEnv(twin),
        TwinEnv(twin, gravity=5.0),
        TwinEnv("Pendulum-v1", dt=0.02),
        TwinEnv(twin.extend(ViscousFriction(b=0.5))),
    ]
    for env in envs:
        env.reset(options=start)
    speeds = [env.step(np.zeros(1, np.float32))[0][2] for env in envs]

    # v' = v + dt (3 g / (2 l) sin(q) - 3 b v / (m l^2))
    gravity = 1.5 * np.sin(1.0)
    np.testing.assert_allclose(speeds[:3], 2.0 + np.array([0.5, 0.25, 0.2]) * gravity)
    assert speeds[3] < speeds[0] - 0.1 and envs[2].metadata["render_fps"] == 50


def test_a_pickled_environment_goes_on_from_the_same_state():
    env = TwinEnv("Pendulum", render_mode="rgb_array", mass=1.2)
    env.reset(seed=0)
    env.render()

    other = pickle.loads(pickle.dumps(env))

    assert other.twin.values == env.twin.values
    np.testing.assert_array_equal(other.render(), env.render())
    np.testing.assert_array_equal(other.step([1.0])[0], env.step([1.0])[0])
    np.testing.assert_array_equal(other.reset()[0], env.reset()[0])


@each(
    ({"twin": "Pendulm"}, NoTwinError, "Did you mean 'Pendulum'"),
    ({"weight": 1.0}, ParameterError, "has no parameter 'weight'"),
    ({"twin": Pendulum}, TypeError, "made of a twin or the name of one"),
    ({"render_mode": "human"}, ValueError, "render_mode='rgb_array' or None"),
)
def test_impossible_settings_are_refused(settings, error, says):
    for environment in (TwinEnv, TwinVecEnv):
        with pytest.raises(error, match=says):
            environment(**{"twin": "Pendulum"} | settings)


@each(
    (lambda env: env.step([np.nan]), r"finite actions \(torque \[N m\]\), got \[nan\]"),
    (lambda env: env.step([0.0, 0.0]), r"actions of shape \(1,\) .* got shape \(2,\)"),
    (lambda env: env.reset(options={"stat": (0.0, 0.0)}), r"only option of reset\(\) .* 'state'"),
    (lambda env: env.reset(options={"state": 3.0}), r"1 finite positions .*hinge \[rad\]"),
    (lambda env: env.reset(options={"state": (0.0, 9.0)}), "speed = 9 rad/s .from -8 to 8"),
)
def test_an_impossible_action_or_start_is_refused_and_changes_nothing(attempt, says):
    env = TwinEnv("Pendulum")
    with pytest.raises(gymnasium.error.ResetNeeded, match="Call reset"):
        env.step(np.zeros(1, np.float32))
    env.reset(seed=0)
    before = env.state

    with pytest.raises(ValueError, match=says):
        attempt(env)

    assert env.state is before


def test_our_ids_and_their_step_limits_are_those_of_the_twins():
    declared = {twins.get(i).env_id: twins.get(i).max_episode_steps for i in twins.all_ids()}
    registry = dict(gymnasium.registry)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        register_environments()  # again, which changes nothing

    limits = STEP_LIMITS | {env_id: steps for env_id, (_, steps) in HARDWARE.items()}
    assert {i: n for i, n in declared.items() if i.startswith("sb3_hds/")} == limits
    assert {env_id: gymnasium.spec(env_id).max_episode_steps for env_id in limits} == limits
    assert gymnasium.registry == registry
    made = gymnasium.make("sb3_hds/CartPoleSwingUp-v0", cart_mass=2.0)
    assert made.unwrapped.twin.values["cart_mass"] == pytest.approx(2.0)


def test_a_pendulum_with_a_delay_is_stepped_without_a_reset():
    env = gymnasium.make("sb3_hds/PendulumReal-v1", delay=0.05, disable_env_checker=True).unwrapped
    obs, *_ = env.step(np.array([1.0]))
    assert np.isfinite(obs).all()
