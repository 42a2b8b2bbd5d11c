"""Environments made of twins. Every registered twin must pass."""

import copy
import pickle
import subprocess
import sys
import warnings

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
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


def _rollout(env, n_steps, seed):
    env.action_space.seed(seed)
    trace = [env.reset(seed=seed)[0]]
    for _ in range(n_steps):
        obs, reward, terminated, *_ = env.step(env.action_space.sample())
        trace += [obs, np.array([reward, terminated])]
        if terminated:
            trace.append(env.reset()[0])
    return np.concatenate(trace)


# --- one environment -----------------------------------------------------------------------------


@pytest.mark.parametrize("name", ALL)
def test_both_checkers_accept_every_twin(name):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check_gymnasium(_make(name, render_mode="rgb_array"))
        check_sb3(_make(name, render_mode="rgb_array"), skip_render_check=False)

    messages = [str(w.message) for w in caught]
    assert [m for m in messages if not any(known in m for known in _UNAVOIDABLE)] == []


@pytest.mark.parametrize("name", ALL)
def test_spaces_are_those_of_the_twin_and_contain_what_comes_out(name):
    env, twin = TwinEnv(name), twins.make(name)
    assert env.observation_space.dtype == env.action_space.dtype == np.float32
    np.testing.assert_array_equal(env.action_space.low, np.float32([a.low for a in twin.actuators]))
    np.testing.assert_array_equal(
        env.observation_space.high, np.float32([c.high for c in twin.channels])
    )

    env.action_space.seed(0)
    for seed in range(5):
        obs, _ = env.reset(seed=seed)
        assert env.observation_space.contains(obs)
        for _ in range(40):
            obs, _, terminated, *_ = env.step(env.action_space.sample())
            assert env.observation_space.contains(obs)
            if terminated:
                break


@pytest.mark.parametrize("name", ALL)
def test_a_seed_fixes_everything_that_follows(name):
    same, again, other = (_rollout(TwinEnv(name), 30, seed) for seed in (3, 3, 4))

    np.testing.assert_array_equal(same, again)
    assert not np.array_equal(same[: other.size], other[: same.size])


@pytest.mark.parametrize("name", ALL)
def test_each_episode_starts_elsewhere(name):
    env = TwinEnv(name)
    starts = [env.reset(seed=0)[0]] + [env.reset()[0] for _ in range(3)]

    assert len(np.unique(starts, axis=0)) == 4


@pytest.mark.parametrize("name", ALL)
def test_a_step_is_the_twins_own_step(name):
    env, twin = TwinEnv(name), twins.make(name)
    env.reset(seed=0)
    before = jax.tree.map(jnp.asarray, env.state)
    action = env.action_space.sample()

    obs, reward, terminated, truncated, info = env.step(action)

    after = twin.step(before, jnp.asarray(action), twin.params)
    expected = twin.reward(before, jnp.asarray(action), after, twin.params)
    # Compiled and interpreted programs round differently, by some 100 units in the last place.
    np.testing.assert_allclose(obs, twin.observe(after, twin.params), rtol=1e-5, atol=1e-5)
    assert reward == pytest.approx(float(expected), rel=1e-5, abs=1e-5)
    assert terminated is bool(twin.terminated(after, twin.params))
    assert type(reward) is float
    assert (truncated, info) == (False, {})


def test_the_pendulum_does_what_gymnasiums_does():
    real = gymnasium.make("Pendulum-v1", g=9.8).unwrapped
    ours = TwinEnv("Pendulum", gravity=9.8)
    real.reset(seed=0)
    real.state = np.array([2.0, -0.5])
    ours.reset(options={"state": (2.0, -0.5)})

    for action in np.random.default_rng(0).uniform(-2.5, 2.5, (50, 1)).astype(np.float32):
        expected, theirs = real.step(action)[:2]
        obs, reward = ours.step(action)[:2]
        # Single against double precision over 50 steps of a swinging pendulum.
        np.testing.assert_allclose(obs, expected, atol=2e-4)
        assert reward == pytest.approx(theirs, abs=2e-3)


def test_a_start_state_is_taken_as_given():
    env = TwinEnv("CartPole")
    env.reset(seed=0, options={"state": ([0.5, 0.25], [0.0, -1.0])})

    np.testing.assert_array_equal(env.state.q, np.float32([0.5, 0.25]))
    np.testing.assert_array_equal(env.state.v, np.float32([0.0, -1.0]))


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
    np.testing.assert_allclose(
        speeds[:3], [2 + 0.5 * gravity, 2 + 0.25 * gravity, 2 + 0.2 * gravity]
    )
    assert speeds[3] < speeds[0] - 0.1
    assert envs[2].metadata["render_fps"] == 50


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_a_copied_environment_goes_on_from_the_same_state(duplicate):
    env = TwinEnv("Pendulum", render_mode="rgb_array", mass=1.2)
    env.reset(seed=0)
    env.render()

    other = duplicate(env)

    assert other.twin.values == env.twin.values
    np.testing.assert_array_equal(other.render(), env.render())
    np.testing.assert_array_equal(other.step([1.0])[0], env.step([1.0])[0])
    np.testing.assert_array_equal(other.reset()[0], env.reset()[0])


@pytest.mark.parametrize(
    ("settings", "error", "says"),
    [
        ({"twin": "Pendulm"}, NoTwinError, "Did you mean 'Pendulum'"),
        ({"twin": "Pendulum", "weight": 1.0}, ParameterError, "has no parameter 'weight'"),
        ({"twin": "Pendulum", "mass": -1.0}, ParameterError, "'mass' must be finite and within"),
        ({"twin": Pendulum}, TypeError, "made of a twin or the name of one"),
        (
            {"twin": "Pendulum", "render_mode": "human"},
            ValueError,
            "render_mode='rgb_array' or None",
        ),
    ],
)
@pytest.mark.parametrize("environment", [TwinEnv, TwinVecEnv])
def test_impossible_settings_are_refused(environment, settings, error, says):
    with pytest.raises(error, match=says):
        environment(**settings)


@pytest.mark.parametrize(
    ("action", "says"),
    [
        ([np.nan], r"finite actions \(torque \[N m\]\), got \[nan\]"),
        ([np.inf], "finite actions"),
        ([0.0, 0.0], r"actions of shape \(1,\) .* got shape \(2,\)"),
        (0.0, r"got shape \(\)"),
    ],
)
def test_an_impossible_action_is_refused_and_changes_nothing(action, says):
    env = TwinEnv("Pendulum")
    env.reset(seed=0)
    before = env.state

    with pytest.raises(ValueError, match=says):
        env.step(action)

    assert env.state is before


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"stat": (0.0, 0.0)}, r"one option of reset\(\), 'state'; got \['stat'\]"),
        ({"state": 3.0}, r"1 finite positions and 1 finite velocities \(hinge \[rad\]\)"),
        ({"state": ([0.0, 1.0], 0.0)}, "1 finite positions"),
        ({"state": (np.nan, 0.0)}, "1 finite positions"),
        ({"state": (0.0, 9.0)}, r"leaves the observation space: speed = 9 rad/s \(from -8 to 8\)"),
    ],
)
def test_an_impossible_start_is_refused_and_changes_nothing(options, says):
    env = TwinEnv("Pendulum")
    env.reset(seed=0)
    before = env.state

    with pytest.raises(ValueError, match=says):
        env.reset(options=options)

    assert env.state is before


def test_a_step_before_the_first_reset_says_so():
    with pytest.raises(gymnasium.error.ResetNeeded, match="Call reset"):
        TwinEnv("Pendulum").step(np.zeros(1, np.float32))


# --- images --------------------------------------------------------------------------------------


def _drawn(image):
    """Pixels in the colour of the line."""
    return (np.abs(image.astype(int) - (0x27, 0x49, 0x6D)).sum(-1) < 30).sum()


@pytest.mark.parametrize("name", ALL)
def test_every_twin_is_drawn_and_its_motion_shows(name):
    env = TwinEnv(name, render_mode="rgb_array")
    env.reset(seed=0)
    first = env.render()
    for _ in range(10):
        env.step(env.action_space.high)
    later = env.render()

    assert first.dtype == np.uint8
    assert first.shape == later.shape == (400, 400, 3)
    assert _drawn(first) > 200
    assert not np.array_equal(first, later)


def test_the_view_holds_still_until_the_drawing_would_leave_it():
    env = TwinEnv("CartPole", render_mode="rgb_array")
    images = {}
    for x in (0.0, 1.5, 1e3):
        env.reset(options={"state": ([x, 0.0], [0.0, 0.0])})
        images[x] = env.render()
    column = {x: np.nonzero(image[..., 0] < 100)[1].mean() for x, image in images.items()}

    # One and a half metres move the cart across a still picture, and a kilometre not out of it.
    assert column[1.5] > column[0.0] + 60
    assert _drawn(images[1e3]) == pytest.approx(_drawn(images[0.0]), rel=0.1)
    edge = np.concatenate([images[x][0, :, 0] for x in (0.0, 1.5)])
    np.testing.assert_array_equal(edge[:400], edge[400:])


def test_without_a_render_mode_there_is_no_image():
    env = TwinEnv("Pendulum")
    env.reset(seed=0)
    with pytest.warns(UserWarning, match="render_mode"):
        assert env.render() is None


# --- ids -----------------------------------------------------------------------------------------


def test_our_ids_and_their_step_limits_are_those_of_the_twins():
    declared = {twins.get(i).env_id: twins.get(i).max_episode_steps for i in twins.all_ids()}

    limits = STEP_LIMITS | {env_id: steps for env_id, (_, steps) in HARDWARE.items()}
    assert {i: n for i, n in declared.items() if i.startswith("sb3_hds/")} == limits


@pytest.mark.parametrize("env_id", STEP_LIMITS | HARDWARE)
def test_our_ids_are_cut_by_gymnasiums_time_limit(env_id):
    limits = STEP_LIMITS | {env_id: steps for env_id, (_, steps) in HARDWARE.items()}
    assert gymnasium.spec(env_id).max_episode_steps == limits[env_id]
    env = gymnasium.make(env_id, max_episode_steps=3)
    env.reset(seed=0)

    steps = [env.step(0.0 * env.action_space.high) for _ in range(3)]

    assert [truncated for _, _, _, truncated, _ in steps] == [False, False, True]


def test_registering_again_changes_nothing():
    before = dict(gymnasium.registry)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        register_environments()

    assert gymnasium.registry == before


def test_settings_pass_through_gymnasium_make():
    env = gymnasium.make("sb3_hds/CartPoleSwingUp-v0", cart_mass=2.0)

    assert env.unwrapped.twin.values["cart_mass"] == 2.0


def test_registering_our_ids_imports_neither_jax_nor_torch():
    program = (
        "import sys, sb3_hds.envs.registration as r; r.register_environments(); "
        "print({'jax', 'torch', 'matplotlib'} & set(sys.modules))"
    )
    run = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )

    assert run.stdout.strip() == "set()"
