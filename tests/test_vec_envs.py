"""Many copies of a twin as one vectorised environment."""

import pickle

import gymnasium
import numpy as np
import pytest
from gymnasium.wrappers import TimeLimit
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_hds.envs import TwinEnv, TwinVecEnv, programs
from sb3_hds.twins import Pendulum


@pytest.mark.parametrize("name", ["Pendulum", "InvertedDoublePendulum"])
def test_the_vectorised_twin_does_what_single_ones_do(name):
    n_envs, limit = 3, 12
    ours = TwinVecEnv(name, n_envs, max_episode_steps=limit)
    single = DummyVecEnv([lambda: TimeLimit(TwinEnv(name), limit)] * n_envs)
    ours.seed(5), single.seed(5)
    # The same draws, compiled for one and for many.
    np.testing.assert_allclose(ours.reset(), single.reset(), rtol=1e-6, atol=1e-6)
    assert len(np.unique(ours.reset(), axis=0)) == n_envs
    single.reset()
    ours = pickle.loads(pickle.dumps(ours))  # goes on from the same states

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
                last, wanted = (i["terminal_observation"] for i in (info, other))
                np.testing.assert_allclose(last, wanted, 1e-3, 1e-3)
        n_done += dones.sum()
    assert n_done >= 3 * n_envs


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
    assert len(calls) == 24 and compiled.step._cache_size() == 1


def test_each_copy_may_be_given_its_start():
    env = TwinVecEnv("Pendulum", 2)
    env.set_options([{"state": (0.0, 1.5)}, {}])
    obs = env.reset()

    np.testing.assert_allclose(obs[0], [1.0, 0.0, 1.5])
    env.set_options({"state": (0.0, 9.0)})
    with pytest.raises(ValueError, match="leaves the observation space"):
        env.reset()


def test_the_step_limit_is_the_twins_own_unless_given():
    for limit, ends in ((None, [199]), (90, [89, 179]), (-1, [])):
        env = TwinVecEnv("Pendulum", 1, max_episode_steps=limit)
        env.reset()
        dones = [env.step(np.zeros((1, 1), np.float32))[2][0] for _ in range(210)]
        assert np.flatnonzero(dones).tolist() == ends


def test_the_vectorised_twin_answers_sb3s_questions():
    env = TwinVecEnv("Pendulum", 2, render_mode="rgb_array", mass=1.1)
    env.reset()

    assert env.get_attr("render_mode") == ["rgb_array"] * 2
    assert [spec.id for spec in env.get_attr("spec", indices=[1])] == ["Pendulum-v1"]
    assert env.get_attr("twin", indices=1)[0].values["mass"] == 1.1
    assert env.env_is_wrapped(TimeLimit) == [False] * 2 and not env.has_attr("nonsense")
    assert len(np.unique(env.get_images(), axis=0)) == 2 and env.render().shape == (800, 400, 3)
    env.set_attr("note", "kept")
    with pytest.raises(ValueError, match="share 'note'"):
        env.set_attr("note", "lost", indices=[0])
    assert env.get_attr("note") == ["kept"] * 2
    with pytest.raises(AttributeError, match="DummyVecEnv of several TwinEnv"):
        env.env_method("reset")


def test_what_is_impossible_is_refused():
    for settings, says in (({"n_envs": 0}, "at least one"), ({"max_episode_steps": 0}, "own")):
        with pytest.raises(ValueError, match=says):
            TwinVecEnv("Pendulum", **settings)
    env = TwinVecEnv("Pendulum", 2)
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(np.zeros((2, 1), np.float32))
    env.reset()
    for actions, says in ((np.zeros((1, 1)), r"shape \(2, 1\)"), (np.full((2, 1), np.nan), "fini")):
        with pytest.raises(ValueError, match=says):
            env.step(actions.astype(np.float32))
