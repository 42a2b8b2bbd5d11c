"""TD7: priorities, checkpoints and what they are worth, beside its paper."""

import dataclasses
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium import spaces
from odd_envs import AnySpaces
from small_models import STATES, greedy, reloaded, small
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_hds import TD7
from sb3_hds.algos.model_free.td7 import update as td7_update
from sb3_hds.algos.model_free.td7.prioritized_replay import LapReplayBuffer, SumTree


def test_entries_are_drawn_in_proportion_to_their_size():
    tree, sizes = SumTree(7), np.array([0.0, 1.0, 5.0, 0.0, 2.0, 0.0, 2.0])
    tree.set(np.arange(7), sizes)

    at = np.linspace(0.0, tree.total, 10_001)
    drawn = np.bincount(tree.draw(at), minlength=7) / len(at)

    assert tree.total == 10.0 and tree.largest() == 5.0
    np.testing.assert_allclose(drawn, sizes / 10.0, atol=1e-3)


def test_each_transition_has_its_priority_also_where_old_ones_are_replaced():
    limits = spaces.Box(-1.0, 1.0, (1,))
    buffer = LapReplayBuffer(8, limits, limits, n_envs=2)
    add = lambda: buffer.add(*np.zeros((3, 2, 1)), np.zeros(2), np.zeros(2), [{}, {}])  # noqa: E731
    for _ in range(4):
        add()
    assert buffer.priorities.entries().tolist() == [1.0] * 8

    buffer.set_priorities(np.array([1, 2]), np.array([1, 0]), np.array([5.0, 3.0]))
    assert buffer.priorities.entries().tolist() == [1.0, 1.0, 1.0, 5.0, 3.0, 1.0, 1.0, 1.0]
    add()
    assert buffer.priorities.entries().tolist() == [5.0, 5.0, 1.0, 5.0, 3.0, 1.0, 1.0, 1.0]

    everything = np.arange(4).repeat(2), np.tile([0, 1], 4)
    buffer.set_priorities(*everything, np.where(np.arange(8) == 5, 2.0, 0.0))
    steps, copies = buffer.draw(10)
    assert set(steps) == {2} and set(copies) == {1} and buffer.highest == 5.0
    buffer.forget_highest()
    assert buffer.highest == 2.0


def test_td7_gives_what_it_drew_the_priority_of_its_error():
    model = small("td7", learning_starts=100, target_update_interval=3).learn(20)
    buffer, drawn = model.replay_buffer, (np.array([2, 5, 11]), np.zeros(3, int))
    buffer.draw = lambda n: drawn
    wanted = []
    keep = buffer.set_priorities
    buffer.set_priorities = lambda *given: wanted.append(given[2]) or keep(*given)

    model.train(gradient_steps=2, batch_size=3)

    entries = buffer.priorities.entries()
    np.testing.assert_allclose(entries[[2, 5, 11]], wanted[-1])
    assert len(np.unique(wanted)) > 3 and np.min(wanted) >= 1.0
    assert (np.delete(entries[:20], [2, 5, 11]) == 1.0).all()
    buffer.highest = 100.0
    model.train(gradient_steps=1, batch_size=3)
    assert buffer.highest == buffer.priorities.largest() < 100.0


def test_layers_of_td7_start_as_those_of_torch():
    n = 30  # of each last layer, too: its biases are as many
    env = AnySpaces(spaces.Box(-1, 1, (n,)), spaces.Box(-1, 1, (n,)))
    kwargs = {"net_arch": [n, n], "embedding_size": n, "n_critics": n}
    learner = small("td7", env, policy_kwargs=kwargs).policy.agent_state
    # The ensemble's axis comes first.
    n_inputs = lambda layer: layer["kernel"].shape[-2]  # noqa: E731
    layers = []
    for part in (learner.encoder, learner.actor, learner.critic):
        is_layer = lambda tree: "kernel" in tree  # noqa: E731
        layers += jax.tree.leaves(part.weights["params"], is_leaf=is_layer)

    assert sorted(map(n_inputs, layers)) == 10 * [n] + 3 * [2 * n] + [3 * n]
    for layer in layers:
        assert layer.keys() == {"kernel", "bias"}
        for drawn in layer.values():
            share = np.asarray(drawn).ravel() * np.sqrt(n_inputs(layer))
            assert share.size >= n and np.abs(share).max() <= 1.0 + 1e-6
            # Five standard deviations of the second moment of as many uniform numbers.
            assert np.mean(share**2) == pytest.approx(1 / 3, abs=5 * np.sqrt(4 / 45 / share.size))


def judged_by(model: TD7) -> list[tuple[float, int]]:
    """:return: what episodes earned by which policies will be judged, and how long they were"""
    judged: list[tuple[float, int]] = []
    model._assess = lambda: judged.extend(model._finished) or 0
    return judged


def both_actions(model: TD7) -> tuple[np.ndarray, np.ndarray]:
    """:return: as the policy is now, and where nothing is explored"""
    return model.policy.predict(STATES)[0], greedy(model.policy)


def assessing(**changes: Any) -> TD7:
    return small("td7", **({"use_checkpoints": True, "train_freq": None} | changes))


def with_checkpoint() -> TD7:
    """:return: a model whose checkpoint is worth -150 and whose networks are others since"""
    model = assessing()
    model.policy.keep_checkpoint()
    model.best_worst_return = -150.0
    model._reset_networks(seed=1)
    return model


def test_td7_judges_no_policy_by_random_actions_nor_by_normalised_rewards():
    # Ten steps that earn 1 each; normalised, the same ten earn less and less.
    model = assessing(env=VecNormalize(DummyVecEnv([AnySpaces])), learning_starts=12)
    judged = judged_by(model)
    model.learn(30)

    # The first episode is random, the second begins so.
    assert judged == [(10.0, 10)]


def test_a_checkpoint_acts_when_networks_start_afresh_and_with_several_until_learning_goes_on():
    _, expected = both_actions(assessing())
    model = with_checkpoint()
    exploring, kept = both_actions(model)
    assert np.abs(exploring - kept).min() > 1e-3
    np.testing.assert_array_equal(kept, expected)
    assert model.best_worst_return == -150.0
    model.use_checkpoints = None

    loaded = reloaded(model, env=make_vec_env("Pendulum-v1", 2))

    np.testing.assert_array_equal(both_actions(loaded)[1], kept)
    assert not loaded.assesses
    np.testing.assert_array_equal(*both_actions(loaded.learn(40)))
    assert loaded._n_updates > 0 and loaded.best_worst_return == -np.inf


def test_td7_takes_no_buffer_without_the_priorities_that_it_draws_by(tmp_path):
    small("droq", learning_starts=100).learn(20).save_replay_buffer(tmp_path / "buffer")
    model = small("td7")
    before = model.replay_buffer

    with pytest.raises(ValueError, match="no priorities to draw by"):
        model.load_replay_buffer(tmp_path / "buffer")

    assert model.replay_buffer is before
    uniform = small("td7", replay_buffer_class=ReplayBuffer)
    uniform.load_replay_buffer(tmp_path / "buffer")
    assert uniform.replay_buffer.size() == 20


@pytest.mark.parametrize("anew", [True, False], ids=["counted anew", "saved and loaded"])
def test_an_interrupted_episode_of_td7_is_no_part_of_the_next_one(anew):
    # Ten steps that earn 1 each.
    model = assessing(env=AnySpaces(), learning_starts=0)
    model.learn(100, callback=lambda *_: model.num_timesteps < 15)

    model = model if anew else reloaded(model, env=AnySpaces())
    judged = judged_by(model)
    model.learn(10, reset_num_timesteps=anew)

    assert judged == [(10.0, 10)]


def test_what_td7_is_loaded_with_counts():
    model = assessing(use_checkpoints=None)

    loaded = reloaded(model, exploration_noise=0.7, train_freq=4)

    for each in (loaded, reloaded(loaded)):
        np.testing.assert_allclose(each.action_noise._sigma, [0.7], rtol=1e-6)
        assert each.train_freq.frequency == 4 and each.train_freq.unit.value == "step"
    assert reloaded(model).train_freq.unit.value == "episode"
    own = small("td7", action_noise=NormalActionNoise(np.zeros(1), np.array([0.3])))
    assert reloaded(own, exploration_noise=0.7).action_noise._sigma == [0.3]


def test_uniform_draws_give_td7_the_gradient_of_prioritised_ones():
    model = small("td7")
    prioritised = model.make_update_config()
    errors = jnp.array([[0.2, 3.0, 5.0, 0.7], [0.9, 1.5, 8.0, 0.1]])
    share = td7_update.priorities_of(prioritised, errors)
    uniform = dataclasses.replace(prioritised, uniform=True)

    slope = jax.grad(partial(td7_update.loss_of, uniform))(errors)

    expected = jnp.clip(errors, -1.0, 1.0) * share / share.sum()
    np.testing.assert_allclose(slope, expected, rtol=1e-6)


def test_a_policy_of_td7_is_kept_only_if_it_did_no_worse():
    model = assessing()
    model.best_worst_return = -300.0
    begun = model.policy.agent_state.checkpoint

    for earned, kept, best in ((-500.0, False, -300.0), (-100.0, True, -100.0)):
        model._finished = [(earned, 200)]
        assert model._assess() == 200 and (model.policy.agent_state.checkpoint is not begun) == kept
        assert model.best_worst_return == best


def test_td7_assesses_by_more_episodes_once_it_has_gone_beyond_the_mark():
    model = assessing(updates_before_checkpointing=400)
    accounts = []
    for n_updates, earned in ((200, -100.0), (400, -100.0), (600, -50.0)):
        model._n_updates, model._finished = n_updates, [(earned, 200)]
        accounts.append((model._assess(), model.best_worst_return))

    # As in the authors' code: the update that would be the 401st scales the best assessment.
    assert accounts == [(200, -100.0), (200, -90.0), (0, -90.0)] and model.assessed_episodes == 1
