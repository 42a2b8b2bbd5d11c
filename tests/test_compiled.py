"""Seeds side by side in one program: the same task, the same updates, none knows of the others."""

from functools import partial
from unittest.mock import Mock

import gymnasium
import jax
import numpy as np
import pytest
from cases import each
from point_mass import N_STEPS, linear_controller, point_mass_env, returns_of
from small_models import SMALL, greedy, saved, small
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_hds import algos, twins
from sb3_hds.algos import learn_compiled
from sb3_hds.algos.model_free.sac.compiled import learn
from sb3_hds.algos.model_free.sac.compiled.run import run_rounds
from sb3_hds.envs import twin_of
from sb3_hds.errors import EnvironmentMismatchError, SeedsDivergedError
from sb3_hds.wrappers import ActionRateLimit


def weights_of(model) -> list[np.ndarray]:
    return [np.asarray(leaf) for leaf in jax.tree.leaves(model.policy.weights)]


def test_what_is_remembered_are_steps_of_the_environment():
    (model,), (episodes,) = learn_compiled(small("tqc_jax"), 420)

    buffer, env = model.replay_buffer, gymnasium.make("Pendulum-v1").unwrapped
    assert buffer.size() == 420 and model.num_timesteps == 420
    for i in (0, 1, 57, 198, 300):
        x, y, speed = buffer.observations[i, 0]
        env.reset()
        env.state = np.array([np.arctan2(y, x), speed], np.float64)
        obs, reward, *_ = env.step(2.0 * buffer.actions[i, 0])
        np.testing.assert_allclose(buffer.next_observations[i, 0], obs, atol=2e-5)
        np.testing.assert_allclose(buffer.rewards[i, 0], reward, rtol=1e-4, atol=1e-5)
    follows = np.abs(buffer.next_observations[:419, 0] - buffer.observations[1:420, 0]).max(1)
    np.testing.assert_array_equal(np.flatnonzero(follows > 0.0), [199, 399])
    assert not buffer.dones.any() and episodes.timesteps.tolist() == [200, 400]
    np.testing.assert_allclose(episodes.returns[0], buffer.rewards[:200].sum(), rtol=1e-5)
    copy, before = algos.TQC.load(saved(model)), weights_of(model)
    np.testing.assert_allclose(greedy(copy), greedy(model), rtol=1e-6)
    model.learn(20, reset_num_timesteps=False)
    assert model.num_timesteps == buffer.size() == 440
    assert any((a != b).any() for a, b in zip(before, weights_of(model), strict=True))


def test_a_seed_does_not_know_which_others_run_beside_it():
    model = small("tqc_jax")
    together, _ = learn_compiled(model, 40, seeds=[3, 5])
    (alone,), _ = learn_compiled(model, 40, seeds=[5])

    for one, other in zip(weights_of(together[1]), weights_of(alone), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-3, atol=1e-4)
    assert any((a != b).any() for a, b in zip(*map(weights_of, together), strict=True))
    assert together[0]._n_updates == 12


@pytest.mark.expensive
def test_the_point_mass_is_solved():
    settings = SMALL["tqc_jax"] | {"policy_kwargs": {"net_arch": [32, 32]}, "gradient_steps": 5}
    model = algos.TQC(env=point_mass_env(), gamma=0.9, learning_rate=3e-3, **settings)
    (learned,), (episodes,) = learn_compiled(model, 1_500, seeds=[0])

    best, idle = returns_of(linear_controller()).mean(), returns_of(lambda _: np.zeros(1)).mean()
    assert (returns_of(partial(greedy, learned)).mean() - idle) / (best - idle) > 0.8
    assert np.diff(episodes.timesteps).tolist() == [N_STEPS] * (1_500 // N_STEPS - 1)


def test_runs_of_any_length_are_one_program():
    model = small("tqc_jax")
    learn_compiled(model, 60)
    before = run_rounds._cache_size()

    for n_steps in (1_100, 2_300):
        learn_compiled(model, n_steps)

    assert run_rounds._cache_size() == before


def test_seeds_that_diverge_leave_what_the_others_learned(monkeypatch):
    model = small("tqc_jax")
    before = weights_of(model)
    both, _ = learn_compiled(model, 40, seeds=[3, 5])
    monkeypatch.setattr(learn, "_diverged", lambda _: np.array([True, False]))

    with pytest.raises(SeedsDivergedError, match=r"with the seeds \[3\].*models") as caught:
        learn_compiled(model, 40, seeds=[3, 5])

    # The template stays as it is.
    assert model.num_timesteps == model.replay_buffer.size() == 0
    assert all(map(np.array_equal, before, weights_of(model)))
    assert list(caught.value.models) == list(caught.value.episodes) == [5]
    for one, other in zip(weights_of(caught.value.models[5]), weights_of(both[1]), strict=True):
        np.testing.assert_array_equal(one, other)


def test_what_was_learned_before_an_interruption_is_returned(monkeypatch):
    """It comes while a call of the program is waited for, whose state is the next one already."""
    waits = Mock(side_effect=[np.array([False]), KeyboardInterrupt])
    monkeypatch.setattr(learn, "_diverged", waits)

    with pytest.warns(UserWarning, match="Interrupted after 2000 of 3000 steps"):
        (model,), (episodes,) = learn_compiled(small("tqc_jax", buffer_size=5_000), 3_000)

    assert model.num_timesteps == model.replay_buffer.size() == 2_000
    assert episodes.timesteps[-1] == 2_000 and model._n_updates == 2 * (2_000 - 10) // 5


def test_a_twin_may_be_passed_for_what_a_wrapper_changes_and_the_time_limit_is_the_environments():
    made = gymnasium.make("Pendulum-v1", max_episode_steps=30)
    assert twin_of(made).max_episode_steps == 200
    env = gymnasium.wrappers.TransformReward(made, lambda reward: reward)
    with pytest.raises(EnvironmentMismatchError, match=r"pass a twin="):
        learn_compiled(small("tqc_jax", env), 40)

    _, (episodes,) = learn_compiled(small("tqc_jax", env), 95, twin=twins.make("Pendulum"))

    assert episodes.timesteps.tolist() == [30, 60, 90]


def pendulums(n: int) -> DummyVecEnv:
    return DummyVecEnv([lambda: gymnasium.make("Pendulum-v1")] * n)


@each(
    ("n_envs", {"env": pendulums(2)}),
    ("VecNormalize", {"env": VecNormalize(pendulums(1))}),
    ("n_steps", {"n_steps": 3}),
    ("action_noise", {"action_noise": NormalActionNoise(np.zeros(1), np.ones(1))}),
    ("param_resets", {"param_resets": [50]}),
    ("episodes", {"train_freq": (1, "episode")}),
    ("count as ends", {"replay_buffer_kwargs": {"handle_timeout_termination": False}}),
    ("store='raw'", {"env": ActionRateLimit(pendulums(1).envs[0], 4.0, store="executed")}),
)
def test_what_needs_python_is_refused(words, arguments):
    model = small("tqc_jax", **arguments)

    with pytest.raises(ValueError, match=words):
        learn_compiled(model, 100)
    with pytest.raises(ValueError, match=r"SAC family, not TD7"):
        learn_compiled(small("td7"), 100)


def test_actions_are_random_until_learning_starts():
    (model,), _ = learn_compiled(small("gsde_sac", learning_starts=400), 500)

    actions = model.replay_buffer.actions[:500, 0, 0]
    uniform = np.sort(actions[:400])
    # Kolmogorov-Smirnov: 1.95 / sqrt(n) is exceeded once in a thousand times.
    assert np.abs(uniform - np.linspace(-1.0, 1.0, 400)).max() / 2.0 < 1.95 / np.sqrt(400)
    assert np.abs(np.diff(actions[410:])).mean() < 0.2 * np.abs(np.diff(actions[:400])).mean()
