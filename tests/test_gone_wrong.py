"""What is left of a model, and of what it remembers, when something went wrong or was cut off."""

import gymnasium
import numpy as np
import pytest
from cases import each
from odd_envs import Dead
from small_models import greedy, small
from stable_baselines3.common.envs import BitFlippingEnv
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from stable_baselines3.her import HerReplayBuffer

from sb3_hds import HDS, TD7, CrossQ
from sb3_hds.algos.model_free.sac.policy import GaussianPolicy
from sb3_hds.algos.model_free.td7.algorithm import TD7Policy
from sb3_hds.algos.nets.optimizers import finite_leaves
from sb3_hds.errors import DivergedError


def finite(model) -> bool:
    return finite_leaves(model.policy.weights)


def test_an_update_that_diverges_is_an_error_and_leaves_the_last_good_weights():
    model = small("droq").learn(20)
    before = model.get_parameters()["policy"]
    model.replay_buffer.rewards[:] = 1e38

    assert issubclass(DivergedError, ValueError)  # for which RL Zoo prunes a trial
    with pytest.raises(DivergedError, match="diverged"):
        for _ in range(20):
            model.train(gradient_steps=4, batch_size=16)

    after = model.get_parameters()["policy"]
    assert finite(model) and before.keys() == after.keys()
    assert model._n_updates == int(model.policy.agent_state.n_updates)


@pytest.mark.parametrize("name", ["droq", "td7"])
def test_weights_of_which_no_loss_tells_neither_act_nor_are_saved(name, monkeypatch, tmp_path):
    model = small(name, gradient_steps=1, train_freq=5, policy_delay=1).learn(20)
    # The next update leaves no weight of the actor finite.
    monkeypatch.setattr(model, "learning_rates", lambda: (np.inf, 1e-3))

    for n_steps in (50, 5):
        with pytest.raises(DivergedError, match="keeps its last good state"):
            model.learn(n_steps, reset_num_timesteps=False)
        assert finite(model) and np.isfinite(model.replay_buffer.actions).all()

    model.train(gradient_steps=1, batch_size=16)
    assert not finite(model)
    with pytest.raises(DivergedError, match="last good state"):
        model.save(tmp_path / "model")
    assert not list(tmp_path.iterdir()) and finite(model)


def test_updates_are_counted_where_they_are_interrupted(monkeypatch):
    model, made = small("td7").learn(10), []

    def interrupted(*given):
        made.append(given)
        if len(made) == 3:
            raise KeyboardInterrupt
        return taken(*given)

    taken = model._accept
    monkeypatch.setattr(model, "_accept", interrupted)
    before = model._n_updates
    with pytest.raises(KeyboardInterrupt):
        model.train(gradient_steps=200, batch_size=16)

    assert model._n_updates == int(model.policy.agent_state.n_updates) > before


@pytest.mark.parametrize(("of_reward", "value"), [(True, np.inf), (False, np.nan)])
def test_statistics_of_vec_normalize_survive_a_dead_sensor(of_reward, value):
    env = Dead(value, of_reward)
    normalizer = VecNormalize(DummyVecEnv([lambda: env]))
    model = small("droq", normalizer)

    with pytest.raises(ValueError, match=r"Step 10 of the environment is not finite"):
        model.learn(100)

    assert np.isfinite(normalizer.obs_rms.mean).all() and np.isfinite(normalizer.ret_rms.var)
    assert model.replay_buffer.pos == 9 and np.isfinite(greedy(model)).all()
    # Nine steps and what the environment began with.
    assert normalizer.obs_rms.count == pytest.approx(10.0, abs=0.01)
    env.value = 0.5
    model.learn(20, reset_num_timesteps=False)
    assert np.isfinite(model.replay_buffer.observations).all()


def test_an_environment_that_begins_with_no_number_is_an_error(monkeypatch):
    env = gymnasium.make("Pendulum-v1")
    model = small("droq", env)

    with monkeypatch.context() as blind:
        blind.setattr(env.unwrapped, "_get_obs", lambda: np.full(3, np.nan, np.float32))
        with pytest.raises(ValueError, match="What the environment begins with is not finite"):
            model.learn(20)

    assert model.learn(20).num_timesteps == 20


def test_returns_of_n_steps_end_where_learning_began_anew():
    model = small("droq", n_steps=3, gradient_steps=0).learn(20)
    model.learn(10, reset_num_timesteps=False).learn(30)
    buffer = model.replay_buffer
    assert np.flatnonzero(buffer.timeouts[:60]).tolist() == [29]

    # One environment: of each row, the return is that of its own episode.
    batch = buffer._get_samples(np.array([27, 28, 29, 30]))
    rewards, gamma = buffer.rewards[:, 0], model.gamma
    of_rows = [(27, 28, 29), (28, 29), (29,), (30, 31, 32)]
    expected = [sum(gamma**i * rewards[j] for i, j in enumerate(rows)) for rows in of_rows]
    np.testing.assert_allclose(batch.rewards[:, 0], expected, rtol=1e-5)
    np.testing.assert_allclose(batch.discounts[:, 0], [gamma**3, gamma**2, gamma, gamma**3])
    # They go on to be worth something there: a cut is no end of the task.
    assert not batch.dones.any()
    np.testing.assert_array_equal(batch.next_observations[1], buffer.next_observations[29, 0])


def test_goals_are_not_taken_from_the_episode_after_the_cut():
    env = BitFlippingEnv(n_bits=4, continuous=True, max_steps=50)
    arguments = {"policy": "MultiInputPolicy", "replay_buffer_class": HerReplayBuffer}
    model = small("droq", env, **arguments).learn(30)
    assert not model.replay_buffer.dones[29].any()

    model.learn(10)

    assert model.replay_buffer.ep_length[29, 0] > 0 and model.replay_buffer.timeouts[29].all()


def test_with_shared_memory_a_cut_counts_as_an_end():
    shared = {"handle_timeout_termination": False}
    model = small("droq", optimize_memory_usage=True, replay_buffer_kwargs=shared).learn(30)
    model._last_obs = None

    model.learn(5, reset_num_timesteps=False)

    assert model.replay_buffer.dones[29].all()


@pytest.mark.parametrize("name", ["droq", "hds"])
def test_without_its_monitor_an_environment_is_left_as_it_is(name):
    bare = small(name, monitor_wrapper=False).get_env().envs[0]
    assert not isinstance(bare, Monitor)


@each((CrossQ, GaussianPolicy), (TD7, GaussianPolicy), (HDS, TD7Policy))
def test_a_policy_of_another_family_is_refused(algorithm, policy):
    with pytest.raises(ValueError, match=f"cannot use the policy {policy.__name__}"):
        algorithm(policy, "Pendulum-v1")
