"""Many copies of a twin as one vectorised environment."""

import pickle

import gymnasium
import numpy as np
import pytest
from gymnasium.wrappers import TimeLimit
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecMonitor

from sb3_hds import twins
from sb3_hds.envs import TwinEnv, TwinVecEnv, programs
from sb3_hds.twins import Pendulum


@pytest.mark.parametrize("name", [n for n in twins.names() if twins.get(n).env_id])
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
    assert len(np.unique(env.get_images(), axis=0)) == 4


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


def test_a_step_before_the_first_reset_says_so():
    with pytest.raises(gymnasium.error.ResetNeeded, match="Call reset"):
        TwinVecEnv("Pendulum").step(np.zeros((1, 1), np.float32))
