"""What model-free algorithms take, and what only they can do."""

from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
import torch as th
from cases import each
from gymnasium import spaces
from odd_envs import ACT, AnySpaces
from small_models import STATES, compilations, greedy, logged, reloaded, same, small
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.envs import BitFlippingEnv
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_hds import DroQ
from sb3_hds.algos.model_free.replay import batches_of
from sb3_hds.algos.model_free.sac import algorithm as soft_actor_critic
from sb3_hds.algos.model_free.sac import update as off_policy
from sb3_hds.algos.model_free.sac.networks import SimbaNet
from sb3_hds.algos.model_free.td7 import update as td7_update
from sb3_hds.algos.model_free.td7.prioritized_replay import LapReplayBuffer
from sb3_hds.algos.nets.optimizers import TrainState
from sb3_hds.errors import EnvironmentMismatchError

CHOICES = spaces.Dict(
    a=spaces.Box(-1, 1, (2,)),
    b=spaces.Discrete(3),
    c=spaces.MultiDiscrete([2, 3]),
    d=spaces.MultiBinary(3),
)


@pytest.mark.parametrize(("name", "space"), [("droq", CHOICES), ("td7", spaces.Box(-1, 1, (2, 3)))])
def test_observations_and_actions_of_any_shape_are_learned_from(name, space):
    # It refuses actions that its space does not contain.
    env = AnySpaces(space, spaces.Box(-2.0, 3.0, (2, 2)))
    policy = "MultiInputPolicy" if space is CHOICES else "MlpPolicy"

    model = small(name, env, policy=policy, learning_starts=5).learn(9)

    assert env.action_space.contains(model.predict(env.reset()[0])[0])
    assert model.replay_buffer.actions.shape[2:] == (4,)


def test_a_call_of_train_compiles_one_program_for_all_but_the_last_of_its_updates():
    # A width that no other test has; 64 updates at once, then 64 and 32.
    model = small("droq", policy_kwargs={"net_arch": [7]}, learning_starts=20).learn(15)

    with compilations() as counts:
        model.train(160, 16)

    assert model._n_updates == 160 and counts["update"] == 2


def test_after_the_same_seed_a_model_explores_and_learns_alike():
    models = [small("gsde_sac", seed=np.uint32(seed)) for seed in (1, 2)]
    actor = models[0].policy.agent_state.actor
    models[1].policy.agent_state = models[1].policy.agent_state._replace(actor=actor)
    assert not np.array_equal(*(model.predict(STATES)[0] for model in models))

    for model in models:
        model.set_random_seed(7)
        model.set_random_seed(None)

    np.testing.assert_array_equal(*(model.predict(STATES)[0] for model in models))
    keys = [jax.random.key_data(model.policy.agent_state.key) for model in models]
    np.testing.assert_array_equal(*keys)


@each(
    ("droq", {"policy_kwargs": {"log_std_init": -2.0}}, "log_std_init .* without use_sde"),
    ("crossq_jax", {"tau": 0.01}, "ignores tau"),
    ("droq", {"use_sde": True, "train_freq": 1}, "a new noise matrix at each step"),
    ("td7", {"gradient_steps": 2, "use_checkpoints": True}, "ignores gradient_steps"),
)
def test_arguments_without_effect_cause_a_warning(name, arguments, message):
    with pytest.warns(UserWarning, match=message):
        small(name, **arguments)


@each(
    ({"observation_space": spaces.Box(0, 255, (3, 36, 36), np.uint8)}, "is an image"),
    ({"observation_space": spaces.MultiDiscrete([[2, 3], [3, 4]])}, "with 2 axes"),
    ({"observation_space": spaces.Dict({})}, "has no numbers"),
    ({"observation_space": spaces.Dict({"a": spaces.Box(-1, 1, ())})}, "without an axis"),
    ({"action_space": spaces.Box(0, 5, (2,), np.int32)}, "whole numbers"),
    ({"action_space": spaces.Box(np.float32([0, -1]), np.float32([0, 1]))}, "have no range"),
    ids=str,
)
def test_spaces_that_cannot_be_learned_in_are_refused(given, message):
    with pytest.raises(EnvironmentMismatchError, match=message):
        DroQ(env=AnySpaces(**given))
    with pytest.raises(EnvironmentMismatchError, match="no Dict observation spaces"):
        DroQ("MultiInputPolicy", AnySpaces(CHOICES, ACT), n_steps=3)
    with pytest.raises(ValueError, match="none of the choices"):
        small("droq", AnySpaces(spaces.Discrete(4, start=2), ACT)).predict(np.array(1))


@pytest.mark.parametrize("name", ["tqc_jax", "td7"])
def test_values_of_the_critics_can_be_looked_at(name):
    model = small(name)

    actions = model.actor(th.as_tensor(STATES), deterministic=True)
    values = model.critic(th.as_tensor(STATES), th.as_tensor(actions))

    assert len(values) == 2 and {value.shape for value in values} == {(2, 1)}
    np.testing.assert_allclose(2.0 * actions, greedy(model), rtol=1e-5)
    assert not np.array_equal(values[0], model.critic(STATES, -np.ones((2, 1)))[0])


def of_policy(**arguments: Any) -> dict[str, Any]:
    return {"policy_kwargs": {"net_arch": [8]} | arguments}


@each(
    ("droq", {"tau": 2.0}, "tau must be from 0 to 1"),
    ("droq", {"ent_coef": "auto_0"}, "ent_coef must be"),
    ("droq", {"target_entropy": "low"}, "target_entropy must be"),
    ("droq", {"n_steps": 3, "optimize_memory_usage": True}, "False where n_steps > 1"),
    ("droq", {"optimize_memory_usage": True}, "handle_timeout_termination"),
    ("droq", {"param_resets": [500, 100]}, "param_resets must be"),
    ("droq", {"qf_learning_rate": "lin_-1e-3"}, "learning rate is a number of at least 0"),
    ("droq", of_policy(net_arch={"pi": [8]}), "net_arch must be"),
    ("droq", of_policy(optimizer_kwargs={"speed": 1}), "optimizer_kwargs"),
    ("droq", of_policy(optimizer_class=th.optim.NAdam), "optimizer_class='nadam'"),
    ("simba", of_policy(batch_norm_momentum=0.9), "do not use batch_norm_momentum"),
    ("simba", {"use_sde": True} | of_policy(squash_log_std=True), "with use_sde=True"),
    ("gsde_sac", of_policy(log_std_init=np.nan), "log_std_init must be"),
    ("crossq_jax", of_policy(batch_norm_momentum=1.5), "batch_norm_momentum must be"),
    ("tqc_jax", {"top_quantiles_to_drop_per_net": 1.5}, "top_quantiles_to_drop_per_net must"),
    ("td7", {"use_sde": True}, "use_sde"),
    ("td7", {"replay_buffer_class": LapReplayBuffer, "n_steps": 2}, "n_steps"),
    ids=str,
)
@pytest.mark.filterwarnings("ignore:n_steps=2 is ignored")
def test_what_cannot_work_is_refused_at_the_door(name, arguments, message):
    with pytest.raises(ValueError, match=message):
        small(name, **arguments)


def test_returns_of_several_steps_and_compressed_buffers_are_learned_from():
    longer = small("droq", n_steps=3, gamma=0.9).learn(30)
    buffer = {"handle_timeout_termination": False}
    compressed = small("td7", optimize_memory_usage=True, replay_buffer_kwargs=buffer).learn(30)

    assert longer._n_updates > 0 and compressed._n_updates > 0
    discounts = batches_of(longer.replay_source, 4, 16, 4).discount
    assert discounts.min() == pytest.approx(0.9**3)
    batch, env = (
        batches_of(compressed.replay_source, 1, 16, 1),
        gymnasium.make("Pendulum-v1").unwrapped,
    )
    env.reset()
    for obs, action, next_obs in zip(batch.obs[0], batch.action[0], batch.next_obs[0], strict=True):
        env.state = np.array([np.arctan2(obs[1], obs[0]), obs[2]], np.float64)
        np.testing.assert_allclose(env.step(2.0 * action)[0], next_obs, atol=2e-5)


def test_the_replay_buffer_is_that_of_the_arguments_that_a_model_is_loaded_with():
    plain = small("td7")

    longer = reloaded(plain, n_steps=3, gamma=0.9).learn(20)
    again = reloaded(longer, n_steps=1).learn(20)

    discounts = [
        batches_of(model.replay_source, 1, 16, 1).discount.min() for model in (longer, again)
    ]
    assert discounts == pytest.approx([0.9**3, 0.9])
    assert type(again.replay_buffer) is type(plain.replay_buffer)
    changed = reloaded(plain, replay_buffer_class=ReplayBuffer)
    assert type(reloaded(changed).replay_buffer) is ReplayBuffer


def test_an_entropy_coefficient_that_a_model_is_loaded_with_is_the_one_that_acts():
    learned = small("droq")
    entropy = learned.policy.agent_state.log_ent_coef._replace(
        weights={"params": jnp.float32(-2.0)}
    )
    learned.policy.agent_state = learned.policy.agent_state._replace(log_ent_coef=entropy)

    fixed = reloaded(learned, ent_coef=0.3)

    kept = np.exp(fixed.policy.agent_state.log_ent_coef.weights["params"])
    assert kept == pytest.approx(0.3) and not fixed.policy.update_config.learns_ent_coef
    assert same(reloaded(learned).get_parameters(), learned.get_parameters())
    with pytest.raises(ValueError, match="use_sde must be False"):
        reloaded(learned, use_sde=True)


def test_hindsight_replay_is_learned_from():
    env = BitFlippingEnv(n_bits=3, continuous=True, max_steps=3)
    model = small("droq", env, policy="MultiInputPolicy", replay_buffer_class=HerReplayBuffer)

    assert model.learn(40)._n_updates > 0
    batch = batches_of(model.replay_source, 1, 500, 1)
    achieved, goal = batch.next_obs[0, :, :3], batch.obs[0, :, 3:6]
    reached = (achieved == goal).all(1)
    np.testing.assert_array_equal(batch.reward[0], np.where(reached, 0.0, -1.0))
    # Four of five goals are those that were achieved later.
    assert reached.mean() > 0.3 > (model.replay_buffer.rewards[:40] == 0.0).mean()


def test_batches_are_normalised_as_the_environment_is_and_time_limits_are_no_end():
    env = VecNormalize(DummyVecEnv([lambda: gymnasium.make("Pendulum-v1")]))
    model = small("droq", env, gradient_steps=0).learn(450)

    batch = batches_of(model.replay_source, 3, 100, 4)

    assert batch.obs.shape == (4, 100, 3) and (batch.obs[3] == 0.0).all()
    assert np.abs(batch.obs[:3].reshape(-1, 3).mean(0)).max() < 0.5
    assert model.replay_buffer.dones.sum() == 2.0 and not batch.terminated.any()


def test_networks_are_reset_on_schedule():
    model = small("crossq_jax", param_resets=[20]).learn(15)
    before = model.get_parameters()["policy"]
    model.learn(15, reset_num_timesteps=False)

    assert model.reset_idx == 1
    changed = [
        np.abs(tensor.numpy() - before[key].numpy()).max()
        for key, tensor in model.get_parameters()["policy"].items()
        if key.endswith("kernel")
    ]
    # A few small steps of Adam would not lead so far.
    assert min(changed) > 0.05


@pytest.mark.parametrize(("name", "afresh"), [("bro", True), ("droq", False)])
def test_bro_starts_afresh_with_its_temperature_and_others_keep_theirs(name, afresh):
    model = small(name)
    assert len(model.param_resets or ()) == afresh
    begun = model.policy.agent_state.log_ent_coef
    later = jax.tree.map(lambda x: x + 1, begun)
    model.policy.agent_state = model.policy.agent_state._replace(log_ent_coef=later)

    model._reset_networks(seed=1)

    after = model.policy.agent_state.log_ent_coef
    assert jax.tree.leaves(after) == jax.tree.leaves(begun if afresh else later)


def test_entropy_may_be_worth_nothing():
    model = small("gsde_sac", ent_coef=0.0)
    lines = logged(model)

    model.learn(20).logger.dump()

    assert lines.column("train/ent_coef") == [0.0]
    assert np.isfinite(lines.column("train/critic_loss")[0])


@pytest.mark.parametrize("name", ["droq", "td7"])
def test_schedules_act_on_all_that_learns(name):
    rates = {"learning_rate": lambda left: 1e-3 * left, "qf_learning_rate": "lin_2e-3"}
    model = small(name, policy_delay=1, **rates).learn(20)

    def trained(left: float) -> list[np.ndarray]:
        model._current_progress_remaining = left
        model.train(2, 16)
        parts = jax.tree.leaves(
            model.policy.agent_state, is_leaf=lambda x: isinstance(x, TrainState)
        )
        parts = [part.weights["params"] for part in parts if isinstance(part, TrainState)]
        return [np.array(leaf) for leaf in jax.tree.leaves(parts)]

    begun, ended, again = trained(1.0), trained(0.0), trained(1.0)

    for before, after, later in zip(begun, ended, again, strict=True):
        np.testing.assert_array_equal(after, before)
        assert (later != before).any()


def test_a_rate_that_becomes_negative_or_infinite_is_named_where_it_does():
    model = small("droq", qf_learning_rate=lambda left: left - 0.5)
    model._current_progress_remaining = 0.25

    with pytest.raises(ValueError, match=r"qf_learning_rate .* 0\.25 of the .* says -0\.25"):
        model.train(1, 16)
    # What is infinite in single precision.
    with pytest.raises(ValueError, match="learning_rate must be a finite number"):
        small("droq", learning_rate=1e39).learn(20)


def test_learning_rates_of_every_form_may_be_changed_while_loading():
    model = small("droq", learning_rate=1e-4, qf_learning_rate=2e-4)

    changed = reloaded(model, learning_rate="lin_3e-4", qf_learning_rate="lin_5e-4")

    assert reloaded(model).learning_rates() == (1e-4, 2e-4)
    assert changed.learning_rates() == pytest.approx((3e-4, 5e-4))
    changed._current_progress_remaining = 0.5
    assert changed.learning_rates() == pytest.approx((1.5e-4, 2.5e-4))
    assert reloaded(changed).qf_learning_rate == "lin_5e-4"


def test_losses_of_the_actor_are_logged_where_it_was_updated_in_whichever_program(monkeypatch):
    monkeypatch.setattr(soft_actor_critic, "_MOST_UPDATES", 2)
    model = small("droq", policy_delay=4, learning_starts=0).learn(5)
    lines = logged(model)
    assert model._n_updates == 2

    # The actor's update is the fourth, of two and one in the last call.
    for n_updates in (1, 3):
        model.train(n_updates, 16)
        model.logger.dump()

    assert len(lines.column("train/critic_loss")) == 2
    assert lines.column("train/ent_coef") == [pytest.approx(1.0)]
    [loss] = lines.column("train/actor_loss")
    assert loss != 0.0


def test_networks_of_simba_serve_other_algorithms():
    model = small("droq", policy="SimbaPolicy", learning_starts=50).learn(30)

    policy, speeds = model.policy, model.replay_buffer.next_observations[:30, 0, 2]
    assert isinstance(policy.actor_network.body, SimbaNet)
    assert policy.optimizers[0].make is optax.adamw
    assert policy.critic_network.body.dropout_rate == 0.01
    assert float(policy.agent_state.obs_stats.count) == 30.0
    assert float(policy.agent_state.obs_stats.mean[2]) == pytest.approx(speeds.mean(), rel=1e-3)


@pytest.mark.parametrize(("name", "last"), [("tqc_jax", True), ("crossq_jax", False)])
def test_layers_start_orthogonal_where_that_is_asked_for(name, last):
    told = {"net_arch": [16, 16], "ortho_init": True if last else "hidden"}
    learner = small(name, policy_kwargs=told).policy.agent_state

    actor, critics = (getattr(learner, of).weights["params"] for of in ("actor", "critic"))
    for weights in (actor, critics):
        inner = weights["body"]["Dense_1"]["kernel"].reshape(-1, 16, 16)
        gained = np.matmul(inner.swapaxes(-1, -2), inner)
        np.testing.assert_allclose(gained, [2.0 * np.eye(16)] * len(gained), atol=1e-5)
    lasts = ((actor["Dense_0"], 2.0), (critics["Dense_0"], 2.0), (actor["Dense_1"], 1.0))
    for layer, squared in lasts:
        gains = np.linalg.svd(layer["kernel"])[1]
        assert np.allclose(gains, np.sqrt(squared), atol=1e-5) == last


@pytest.mark.parametrize(("name", "gain"), [("simba", 1.0), ("bro", np.sqrt(2.0))])
def test_last_layers_start_as_in_the_code_of_the_authors(name, gain):
    learner = small(name).policy.agent_state

    actor, critic = (getattr(learner, of).weights["params"] for of in ("actor", "critic"))
    for layer, expected in ((actor["Dense_0"], gain), (actor["Dense_1"], 1.0)):
        np.testing.assert_allclose(np.linalg.svd(layer["kernel"])[1], expected, atol=1e-5)
    np.testing.assert_allclose(np.linalg.svd(critic["Dense_0"]["kernel"])[1], gain, atol=1e-5)


@pytest.mark.parametrize(("name", "updates"), [("droq", off_policy), ("td7", td7_update)])
def test_all_updates_run_one_program(name, updates):
    model = small(name).learn(20)
    before = updates.update._cache_size()
    model.learn(50, reset_num_timesteps=False)
    assert model._n_updates > 2 and updates.update._cache_size() == before
