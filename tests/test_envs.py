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
from gymnasium.wrappers import TimeLimit
from stable_baselines3 import PPO
from stable_baselines3.common.env_checker import check_env as check_sb3
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecMonitor

from sb3_hds import twins
from sb3_hds.effects import ViscousFriction
from sb3_hds.envs import TwinEnv, TwinVecEnv, programs, register_environments
from sb3_hds.envs.registration import STEP_LIMITS
from sb3_hds.errors import NoTwinError, ParameterError
from sb3_hds.twins import Pendulum

ALL = twins.names()
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
    with pytest.raises(gymnasium.error.ResetNeeded, match="Call reset"):
        TwinVecEnv("Pendulum").step(np.zeros((1, 1), np.float32))


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

    assert {i: n for i, n in declared.items() if i.startswith("sb3_hds/")} == STEP_LIMITS


@pytest.mark.parametrize("env_id", STEP_LIMITS)
def test_our_ids_are_cut_by_gymnasiums_time_limit(env_id):
    assert gymnasium.spec(env_id).max_episode_steps == STEP_LIMITS[env_id]
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


# --- many copies ---------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ALL)
def test_the_vectorised_twin_does_what_single_ones_do(name):
    n_envs, limit = 3, 12
    ours = TwinVecEnv(name, n_envs, max_episode_steps=limit)
    single = DummyVecEnv([lambda: TimeLimit(TwinEnv(name), limit)] * n_envs)
    ours.seed(5), single.seed(5)
    # The same draws, compiled for one and for many.
    np.testing.assert_allclose(ours.reset(), single.reset(), rtol=1e-6, atol=1e-6)

    generator = np.random.default_rng(0)
    n_done = 0
    for _ in range(3 * limit):
        actions = generator.uniform(
            ours.action_space.low, ours.action_space.high, (n_envs, *ours.action_space.shape)
        )
        obs, rewards, dones, infos = ours.step(actions)
        expected = single.step(actions.astype(np.float32))
        # Rounding differs between the two programs, and a few unstable steps magnify it.
        np.testing.assert_allclose(obs, expected[0], rtol=1e-3, atol=1e-3)
        np.testing.assert_allclose(rewards, expected[1], rtol=1e-3, atol=1e-3)
        np.testing.assert_array_equal(dones, expected[2])
        for info, other in zip(infos, expected[3], strict=True):
            assert info.keys() == other.keys()
            assert info["TimeLimit.truncated"] is other["TimeLimit.truncated"]
            if "terminal_observation" in info:
                np.testing.assert_allclose(
                    info["terminal_observation"], other["terminal_observation"], 1e-3, 1e-3
                )
        n_done += dones.sum()
    assert n_done >= 3 * n_envs
    assert (obs.dtype, rewards.dtype, dones.dtype) == (np.float32, np.float32, np.bool_)


def test_a_termination_at_the_step_limit_is_no_truncation():
    # At x = 0.44 m with 0.07 m/s the car passes the goal, at 0.45 m, in one step.
    start = {"state": (0.44, 0.07)}
    ours = TwinVecEnv("MountainCar", 2, max_episode_steps=1)
    ours.set_options([start, {}])
    ours.reset()

    _, _, dones, infos = ours.step(np.zeros((2, 1), np.float32))

    assert dones.tolist() == [True, True]
    assert [info["TimeLimit.truncated"] for info in infos] == [False, True]
    assert infos[0]["terminal_observation"][0] > 0.45


def test_one_step_of_all_copies_is_one_call_of_one_program(monkeypatch):
    calls = []
    programs.for_many.cache_clear()
    compiled = programs.for_many(Pendulum())

    def counted(*arguments):
        calls.append(1)
        return compiled.step(*arguments)

    monkeypatch.setattr(programs, "for_many", lambda twin: compiled._replace(step=counted))
    for mass in (1.0, 1.3):
        env = TwinVecEnv("Pendulum", 4, max_episode_steps=5, mass=mass)
        env.reset()
        for _ in range(12):
            env.step(np.zeros((4, 1), np.float32))

    # 24 steps, restarts among them and two values of the mass: 24 calls, one compilation.
    assert len(calls) == 24
    assert compiled.step._cache_size() == 1


def test_copies_start_independently_and_reproducibly():
    first, again = TwinVecEnv("Pendulum", 4), TwinVecEnv("Pendulum", 4)
    for env in (first, again):
        env.seed(7)
    starts = np.concatenate([first.reset(), first.reset()])

    assert len(np.unique(starts, axis=0)) == 8
    np.testing.assert_array_equal(starts, np.concatenate([again.reset(), again.reset()]))


def test_each_copy_may_be_given_its_start():
    env = TwinVecEnv("Pendulum", 2)
    env.set_options([{"state": (0.0, 1.5)}, {}])
    obs = env.reset()

    np.testing.assert_allclose(obs[0], [1.0, 0.0, 1.5])
    env.set_options({"state": (0.0, 9.0)})
    with pytest.raises(ValueError, match="leaves the observation space"):
        env.reset()


@pytest.mark.parametrize(("limit", "ends"), [(None, 200), (7, 7), (-1, None)])
def test_the_step_limit_is_the_twins_own_unless_given(limit, ends):
    env = TwinVecEnv("Pendulum", 1, max_episode_steps=limit)
    env.reset()
    dones = [env.step(np.zeros((1, 1), np.float32))[2][0] for _ in range(210)]

    assert (dones.index(True) + 1 if True in dones else None) == ends


def test_the_vectorised_twin_answers_sb3s_questions():
    env = TwinVecEnv("Pendulum", 3, render_mode="rgb_array", mass=1.1)

    assert env.get_attr("render_mode") == ["rgb_array"] * 3
    assert [spec.id for spec in env.get_attr("spec", indices=[0, 2])] == ["Pendulum-v1"] * 2
    assert env.get_attr("twin", indices=1)[0].values["mass"] == 1.1
    assert env.env_is_wrapped(TimeLimit) == [False] * 3
    assert env.metadata["render_fps"] == 20
    assert not env.has_attr("nonsense")
    env.set_attr("note", "kept")
    assert env.get_attr("note") == ["kept"] * 3
    with pytest.raises(ValueError, match="share 'note'"):
        env.set_attr("note", "lost", indices=[0])
    with pytest.raises(AttributeError, match="DummyVecEnv of several TwinEnv"):
        env.env_method("reset")


def test_images_of_all_copies_are_tiled():
    env = TwinVecEnv("Pendulum", 4, render_mode="rgb_array")
    env.reset()

    assert env.render().shape == (800, 800, 3)
    assert len(np.unique([_drawn(image) for image in env.get_images()])) > 1


def test_vec_monitor_counts_episodes():
    env = VecMonitor(TwinVecEnv("Pendulum", 2, max_episode_steps=5))
    env.reset()
    total = np.zeros(2)
    for _ in range(5):
        _, rewards, _, infos = env.step(np.ones((2, 1), np.float32))
        total += rewards

    assert [info["episode"]["l"] for info in infos] == [5, 5]
    np.testing.assert_allclose([info["episode"]["r"] for info in infos], total, rtol=1e-5)


def test_a_pickled_vectorised_twin_goes_on_from_the_same_states():
    env = TwinVecEnv("Pendulum", 2, max_episode_steps=3)
    env.seed(1)
    env.reset()
    other = pickle.loads(pickle.dumps(env))

    for _ in range(5):
        ours, theirs = (e.step(np.ones((2, 1), np.float32))[0] for e in (env, other))
        np.testing.assert_array_equal(ours, theirs)


@pytest.mark.parametrize(
    ("settings", "says"),
    [({"n_envs": 0}, "at least one copy"), ({"max_episode_steps": 0}, r"Pendulum's own \(200\)")],
)
def test_impossible_numbers_are_refused(settings, says):
    with pytest.raises(ValueError, match=says):
        TwinVecEnv("Pendulum", **settings)


def test_actions_of_the_wrong_shape_are_refused():
    env = TwinVecEnv("Pendulum", 2)
    env.reset()
    with pytest.raises(ValueError, match=r"shape \(2, 1\)"):
        env.step(np.zeros((1, 1), np.float32))
    with pytest.raises(ValueError, match="finite"):
        env.step(np.full((2, 1), np.nan))


def test_sb3_learns_on_the_vectorised_twin():
    env = TwinVecEnv("Pendulum", 2, max_episode_steps=10)
    model = PPO("MlpPolicy", VecMonitor(env), n_steps=16, batch_size=16, device="cpu")

    model.learn(32)

    assert model.num_timesteps == 32
    assert len(model.ep_info_buffer) == 2


def test_twins_step_in_other_processes():
    remote = SubprocVecEnv([lambda: TwinEnv("Pendulum", mass=1.2)] * 2)
    try:
        local = DummyVecEnv([lambda: TwinEnv("Pendulum", mass=1.2)] * 2)
        remote.seed(0), local.seed(0)
        np.testing.assert_array_equal(remote.reset(), local.reset())
        actions = np.ones((2, 1), np.float32)
        np.testing.assert_array_equal(remote.step(actions)[0], local.step(actions)[0])
    finally:
        remote.close()
