"""What model-free algorithms take, and what only they can do."""

from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
import torch as th
from gymnasium import spaces
from odd_envs import ACT, AnySpaces
from small_models import MODEL_FREE, SMALL, STATES, greedy, logged, reloaded, same, saved, small
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.envs import BitFlippingEnv
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from rl_zoo_plugin.lazy import parameters_of
from sb3_hds import DroQ, algos
from sb3_hds.algos import off_policy, soft_actor_critic, td7_update
from sb3_hds.algos.bodies import SimbaBody
from sb3_hds.algos.gaussian_policy import SimbaPolicy
from sb3_hds.algos.learner import GENERATOR
from sb3_hds.algos.off_policy import (
    Trained,
    judge,
)
from sb3_hds.algos.sampling import batches_of
from sb3_hds.errors import EnvironmentMismatchError

SPACES = {
    "box of two axes": spaces.Box(-1, 1, (2, 3)),
    "choices": spaces.Dict(
        {
            "a": spaces.Box(-1, 1, (2,)),
            "b": spaces.Discrete(3),
            "c": spaces.MultiDiscrete([2, 3]),
            "d": spaces.MultiBinary(3),
        }
    ),
}

pytestmark = pytest.mark.usefixtures("quick_compilation")


@pytest.mark.parametrize("space", SPACES)
def test_observations_of_numbers_and_choices_are_learned_from(space):
    env = AnySpaces(SPACES[space], spaces.Box(-2.0, 3.0, (2, 2)))
    policy = "MultiInputPolicy" if space == "choices" else "MlpPolicy"

    model = small("droq", env, policy=policy, learning_starts=5).learn(9)

    action, _ = model.predict(env.reset()[0])
    assert env.action_space.contains(action)


@pytest.mark.parametrize("name", ["gsde_sac", "td7"])
def test_actions_have_the_shape_of_the_action_space(name):
    # It refuses what the space does not contain.
    env = AnySpaces(action_space=spaces.Box(-2.0, 3.0, (2, 2)))

    model = small(name, env, learning_starts=5).learn(9)

    assert model.predict(np.zeros(3, np.float32))[0].shape == (2, 2)
    assert model.replay_buffer.actions.shape[2:] == (4,)


@pytest.mark.parametrize("use_sde", [False, True])
def test_after_the_same_seed_a_model_explores_and_learns_alike(use_sde):
    models = [small("tqc_jax", use_sde=use_sde, train_freq=5, seed=seed) for seed in (1, 2)]
    actor = models[0].policy.learner.actor
    models[1].policy.learner = models[1].policy.learner._replace(actor=actor)
    obs = np.tile(models[0].observation_space.sample(), (4, 1))
    assert not np.array_equal(*(model.predict(obs)[0] for model in models))

    for model in models:
        model.set_random_seed(7)
        model.set_random_seed(None)

    np.testing.assert_array_equal(*(model.predict(obs)[0] for model in models))
    keys = [jax.random.key_data(model.policy.learner.key) for model in models]
    np.testing.assert_array_equal(*keys)
    of_networks = jax.random.key_data(jax.random.key(7, impl=GENERATOR))
    assert not np.array_equal(keys[0], of_networks)


def test_a_seed_may_be_a_number_of_numpy():
    one, other = small("droq", seed=np.uint32(7)), small("droq", seed=7)

    assert same(one.get_parameters(), other.get_parameters())


@pytest.mark.parametrize(
    ("name", "arguments", "message"),
    [
        ("droq", {"policy_kwargs": {"log_std_init": -2.0}}, "log_std_init .* without use_sde"),
        (
            "crossq_jax",
            {"policy_kwargs": {"batch_norm_momentum": 0.01}},
            r"SB3-contrib's .*: pass 0\.99 for its 0\.01",
        ),
        ("crossq_jax", {"tau": 0.01}, "does not look at tau: there are no target networks"),
        ("td7", {"tau": 0.01}, "does not look at tau: target networks are copied whole"),
        ("td7", {"gradient_steps": 2}, "does not look at gradient_steps: with checkpoints"),
    ],
)
def test_arguments_that_say_nothing_are_warned_of(name, arguments, message):
    with pytest.warns(UserWarning, match=message):
        small(name, **{"use_checkpoints": True} if name == "td7" else {}, **arguments)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"observation_space": spaces.Box(0, 255, (3, 36, 36), np.uint8)}, "is an image"),
        ({"observation_space": spaces.Box(0, 255, (36, 36), np.uint8)}, "is an image"),
        (
            {"observation_space": spaces.MultiDiscrete([[2, 3], [3, 4]])},
            "MultiDiscrete with 2 axes",
        ),
        ({"observation_space": spaces.Box(-1, 1, (0,))}, "has no numbers"),
        ({"observation_space": spaces.Dict({})}, "has no numbers"),
        (
            {"observation_space": spaces.Dict({"angle": spaces.Box(-1, 1, ())})},
            r"'angle' is a number without an axis",
        ),
        ({"action_space": spaces.Box(0, 5, (2,), np.int32)}, "whole numbers"),
        (
            {"action_space": spaces.Box(np.array([0.0, -1.0], "f"), np.array([0.0, 1.0], "f"))},
            "have no range",
        ),
    ],
    ids=str,
)
def test_spaces_that_cannot_be_learned_in_are_refused(given, message):
    with pytest.raises(EnvironmentMismatchError, match=message):
        DroQ(env=AnySpaces(**given))


@pytest.mark.parametrize(
    ("space", "obs"),
    [
        (spaces.Discrete(4, start=2), 1),
        (spaces.MultiDiscrete([2, 3]), [2, 0]),
        (spaces.MultiDiscrete([2, 3]), [0, -1]),
    ],
)
def test_a_choice_that_there_is_not_gets_no_action(space, obs):
    model = small("droq", AnySpaces(space, ACT))

    with pytest.raises(ValueError, match="none of the choices that its space has"):
        model.predict(np.array(obs))


@pytest.mark.parametrize(
    ("name", "net_arch"), [("droq", []), ("td7", []), ("td7", {"pi": [8, 4], "qf": [6]})]
)
def test_networks_may_have_no_hidden_layer_or_layers_of_several_widths(name, net_arch):
    kwargs = SMALL[name]["policy_kwargs"] | {"net_arch": net_arch}

    assert np.isfinite(small(name, policy_kwargs=kwargs).predict(np.zeros(3, np.float32))[0]).all()


@pytest.mark.parametrize("name", ["tqc_jax", "simba", "td7"])
def test_values_of_the_critics_can_be_looked_at(name):
    model = small(name)

    actions = model.actor(th.as_tensor(STATES), deterministic=True)
    values = model.critic(th.as_tensor(STATES), th.as_tensor(actions))

    assert len(values) == 2 and {value.shape for value in values} == {(2, 1)}
    np.testing.assert_allclose(2.0 * actions, greedy(model), rtol=1e-5)
    assert not np.array_equal(values[0], model.critic(STATES, -np.ones((2, 1)))[0])
    if name == "tqc_jax":  # the means of the quantiles that targets are made of
        weights, key = model.policy.learner.critic.weights, jax.random.key(1)
        quantiles, _ = judge(model.policy.recipe, weights, STATES, actions, key)
        np.testing.assert_allclose(np.stack(values)[..., 0], quantiles.mean(-1), rtol=1e-5)


def test_a_replay_buffer_that_is_read_belongs_to_the_models_device(tmp_path):
    model = small("droq", n_steps=2).learn(30)
    model.save_replay_buffer(tmp_path / "buffer")
    model.device = th.device("cuda")

    model.load_replay_buffer(tmp_path / "buffer")

    assert model.replay_buffer.device.type == "cuda"
    assert batches_of(model, 1, 4, 1).obs.shape == (1, 4, 3)


def test_returns_of_several_steps_need_a_buffer_that_has_them():
    env = AnySpaces(SPACES["choices"], ACT)
    with pytest.raises(EnvironmentMismatchError, match="no Dict observation spaces"):
        DroQ("MultiInputPolicy", env, n_steps=3)
    with pytest.warns(UserWarning, match="n_steps=3 is ignored with replay_buffer_class=Replay"):
        DroQ("Pendulum-v1", n_steps=3, replay_buffer_class=ReplayBuffer)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"tau": 2.0}, "tau must be from 0 to 1"),
        ({"target_update_interval": 0}, "target_update_interval must be a whole number of at"),
        ({"policy_delay": 0}, "policy_delay must be a whole number of at least 1"),
        ({"ent_coef": "automatic"}, "ent_coef must be a number of at least 0, 'auto'"),
        ({"n_steps": 3, "optimize_memory_usage": True}, "False where n_steps > 1"),
        ({"optimize_memory_usage": True}, "'handle_timeout_termination': False"),
        ({"ent_coef": "auto_0"}, "ent_coef must be a number of at least 0, 'auto'"),
        ({"target_entropy": "low"}, "target_entropy must be 'auto' or a number"),
        ({"policy_kwargs": {"net_arch": {"pi": [8]}}}, "net_arch must be a list of widths"),
        ({"policy_kwargs": {"activation_fn": "swoosh"}}, "activation_fn must be one of"),
        ({"policy_kwargs": {"optimizer_class": "magic"}}, "optimizer_class must be one of"),
        ({"policy_kwargs": {"optimizer_kwargs": {"speed": 1}}}, "optimizer_kwargs"),
        ({"policy_kwargs": {"optimizer_class": th.optim.NAdam}}, "optimizer_class='nadam'"),
        ({"policy_kwargs": {"dropout_rate": 1.0}}, "dropout_rate must be at least 0"),
        ({"policy_kwargs": {"n_quantiles": 5}}, "one value each: leave it out, or use"),
    ],
)
def test_what_cannot_work_is_refused_at_the_door(arguments, message):
    with pytest.raises(ValueError, match=message):
        DroQ("Pendulum-v1", **arguments)


@pytest.mark.parametrize(
    ("name", "policy", "argument"),
    [
        ("droq", "SimbaPolicy", {"renorm_warmup_steps": 100}),
        ("simba", "MlpPolicy", {"batch_norm_momentum": 0.9}),
        ("bro", "MlpPolicy", {"dropout_rate": 0.1}),
    ],
)
def test_arguments_that_the_networks_do_not_use_are_refused(name, policy, argument):
    with pytest.raises(ValueError, match=f"do not use {next(iter(argument))}"):
        small(name, policy=policy, policy_kwargs={"net_arch": [8], **argument})


@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        ("droq", {"param_resets": 50}),
        ("td7", {"train_freq": 0}),
        ("droq", {"replay_buffer_class": "HerReplayBuffer"}),
        ("droq", {"policy_kwargs": {"dropout_rate": None}}),
        ("gsde_sac", {"policy_kwargs": {"log_std_init": np.nan}}),
        ("gsde_sac", {"policy_kwargs": {"clip_mean": -1.0}}),
        ("crossq_jax", {"policy_kwargs": {"batch_norm_momentum": 1.5}}),
        ("bro", {"gradient_steps": "many"}),
        ("droq", {"param_resets": [500, 100]}),
        ("droq", {"sde_sample_freq": 2.5}),
        ("tqc_jax", {"top_quantiles_to_drop_per_net": 1.5}),
        ("tqc_jax", {"policy_kwargs": {"n_quantiles": None}}),
        ("gsde_sac", {"policy_kwargs": {"ortho_init": "last"}}),
        ("td7", {"policy_kwargs": {"n_critics": 0}}),
        ("crossq_jax", {"policy_kwargs": {"renorm_warmup_steps": -1}}),
        ("td7", {"policy_kwargs": {"embedding_size": 0}}),
        ("bro", {"kl_target": -1}),
        ("bro", {"std_multiplier": -2}),
        ("droq", {"linear_ent_coef": "yes"}),
    ],
    ids=str,
)
def test_an_argument_out_of_range_is_refused_by_name(name, arguments):
    [(argument, value)] = (arguments.get("policy_kwargs") or arguments).items()

    with pytest.raises(ValueError, match=rf"{argument} must be .*") as caught:
        small(name, **arguments)

    assert repr(value) in str(caught.value)


def test_the_default_number_of_steps_goes_beyond_the_random_ones():
    for name in MODEL_FREE:
        algorithm = algos.ALL[name]
        starts = parameters_of(algorithm)["learning_starts"].default
        assert algorithm.default_timesteps >= 2 * starts, name


@pytest.mark.parametrize("name", ["droq", "td7"])
def test_returns_of_several_steps_and_compressed_buffers_are_learned_from(name):
    longer = small(name, n_steps=3, gamma=0.9).learn(30)
    buffer = {"handle_timeout_termination": False}
    compressed = small(name, optimize_memory_usage=True, replay_buffer_kwargs=buffer).learn(30)

    assert longer._n_updates > 0 and compressed._n_updates > 0
    discounts = batches_of(longer, 4, 16, 4).discount
    assert discounts.min() == pytest.approx(0.9**3)
    batch, env = batches_of(compressed, 1, 16, 1), gymnasium.make("Pendulum-v1").unwrapped
    env.reset()
    for obs, action, next_obs in zip(batch.obs[0], batch.action[0], batch.next_obs[0], strict=True):
        env.state = np.array([np.arctan2(obs[1], obs[0]), obs[2]], np.float64)
        np.testing.assert_allclose(env.step(2.0 * action)[0], next_obs, atol=2e-5)


@pytest.mark.parametrize("name", ["droq", "td7"])
def test_the_replay_buffer_is_that_of_the_arguments_that_a_model_is_loaded_with(name):
    plain = small(name)

    longer = reloaded(plain, n_steps=3, gamma=0.9).learn(20)
    shorter = reloaded(longer, gamma=0.8).learn(20)
    again = reloaded(longer, n_steps=1).learn(20)

    discounts = [batches_of(model, 1, 16, 1).discount.min() for model in (longer, shorter, again)]
    assert discounts == pytest.approx([0.9**3, 0.8**3, 0.9])
    assert type(again.replay_buffer) is type(plain.replay_buffer)


def test_an_entropy_coefficient_that_a_model_is_loaded_with_is_the_one_that_acts():
    learned = small("droq")
    entropy = learned.policy.learner.log_ent_coef._replace(weights={"params": jnp.float32(-2.0)})
    learned.policy.learner = learned.policy.learner._replace(log_ent_coef=entropy)

    fixed = reloaded(learned, ent_coef=0.3)

    kept = np.exp(fixed.policy.learner.log_ent_coef.weights["params"])
    assert kept == pytest.approx(0.3) and not fixed.policy.recipe.learns_ent_coef
    assert same(reloaded(learned).get_parameters(), learned.get_parameters())


def test_exploration_is_that_of_the_networks_that_are_loaded():
    with pytest.raises(ValueError, match=r"DroQ\(use_sde=True\): use_sde must be False, as when"):
        DroQ.load(saved(small("droq")), use_sde=True)


def test_a_replay_buffer_that_was_passed_is_used_after_loading():
    loaded = reloaded(small("td7", replay_buffer_class=ReplayBuffer))
    changed = reloaded(small("td7"), replay_buffer_class=ReplayBuffer)

    assert type(loaded.replay_buffer) is type(changed.replay_buffer) is ReplayBuffer


@pytest.mark.parametrize("name", ["droq", pytest.param("td7", marks=pytest.mark.expensive)])
def test_hindsight_replay_is_learned_from(name):
    env = BitFlippingEnv(n_bits=3, continuous=True, max_steps=3)
    model = algos.ALL[name](
        "MultiInputPolicy", env, replay_buffer_class=HerReplayBuffer, seed=0, **SMALL[name]
    )

    assert model.learn(40)._n_updates > 0
    batch = batches_of(model, 1, 500, 1)
    achieved, goal = batch.next_obs[0, :, :3], batch.obs[0, :, 3:6]
    reached = (achieved == goal).all(1)
    np.testing.assert_array_equal(batch.reward[0], np.where(reached, 0.0, -1.0))
    # Four of five goals are those that were achieved later.
    assert reached.mean() > 0.3 > (model.replay_buffer.rewards[:40] == 0.0).mean()


def test_batches_are_normalised_as_the_environment_is_and_time_limits_are_no_end():
    env = VecNormalize(DummyVecEnv([lambda: gymnasium.make("Pendulum-v1")]))
    model = small("droq", env, gradient_steps=0).learn(450)

    batch = batches_of(model, 3, 100, 4)

    assert batch.obs.shape == (4, 100, 3) and (batch.obs[3] == 0.0).all()
    assert np.abs(batch.obs[:3].reshape(-1, 3).mean(0)).max() < 0.5
    assert model.replay_buffer.dones.sum() == 2.0 and not batch.terminated.any()


@pytest.mark.parametrize("name", ["crossq_jax", "td7"])
def test_networks_start_afresh_when_told_to(name):
    model = small(name, param_resets=[20]).learn(15)
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
    begun = model.policy.learner.log_ent_coef
    later = jax.tree.map(lambda x: x + 1, begun)
    model.policy.learner = model.policy.learner._replace(log_ent_coef=later)

    model._restart(seed=1)

    after = model.policy.learner.log_ent_coef
    assert jax.tree.leaves(after) == jax.tree.leaves(begun if afresh else later)


def test_entropy_may_be_worth_nothing():
    model = small("gsde_sac", ent_coef=0.0)
    lines = logged(model)

    model.learn(40, log_interval=1).logger.dump()

    assert lines.column("train/ent_coef")[-1] == 0.0
    assert np.isfinite(lines.column("train/critic_loss")[-1])
    assert reloaded(small("droq").learn(20), ent_coef=0.0).get_parameters()


@pytest.mark.parametrize(("gradient_steps", "n"), [(2, 1), (-1, 1)])
def test_bro_starts_afresh_less_often_where_it_makes_few_updates(gradient_steps, n):
    assert len(small("bro", gradient_steps=gradient_steps).param_resets) == n


def test_whether_the_loss_of_the_entropy_coefficient_is_linear_is_an_argument():
    other = small("droq", linear_ent_coef=True)

    assert not small("droq").policy.recipe.linear_ent_coef
    assert other.policy.recipe.linear_ent_coef and reloaded(other).policy.recipe.linear_ent_coef


def trained(learner: Any) -> dict[str, np.ndarray]:
    """:return: all that optimisers change, whatever it belongs to"""
    parts = jax.tree_util.tree_leaves_with_path(learner, is_leaf=lambda x: isinstance(x, Trained))
    return {
        jax.tree_util.keystr(path + inside): np.array(leaf)
        for path, part in parts
        if isinstance(part, Trained)
        for inside, leaf in jax.tree_util.tree_leaves_with_path(part.weights["params"])
    }


@pytest.mark.parametrize("name", ["bro", "td7"])
def test_schedules_act_on_all_that_learns(name):
    model = small(
        name,
        learning_rate=lambda left: 1e-3 * left,
        qf_learning_rate="lin_2e-3",
        policy_delay=1,
    ).learn(20)
    begun = trained(model.policy.learner)

    model._current_progress_remaining = 0.0
    model.train(2, 16)
    ended = trained(model.policy.learner)
    model._current_progress_remaining = 1.0
    model.train(2, 16)
    again = trained(model.policy.learner)

    further = {"bro": ".extra['optimism']", "td7": ".encoder"}[name]
    assert any(further in key for key in begun)
    for key, weights in begun.items():
        np.testing.assert_array_equal(ended[key], weights, err_msg=key)
        assert (again[key] != weights).any(), key


@pytest.mark.parametrize(
    ("argument", "rate"),
    [("learning_rate", "lin_-1e-3"), ("qf_learning_rate", "-1e-3"), ("learning_rate", "lin_nan")],
)
def test_a_negative_learning_rate_is_refused_also_as_a_string(argument, rate):
    with pytest.raises(ValueError, match="A learning rate is a number of at least 0"):
        small("droq", **{argument: rate})


def test_a_schedule_ends_where_training_was_to_end():
    model = small("droq", learning_rate=lambda left: 1e-3 * left, train_freq=20)
    lines = logged(model)

    model.learn(30).logger.dump()

    assert model.num_timesteps == 40
    assert lines.column("train/learning_rate")[-1] == 0.0


@pytest.mark.parametrize("argument", ["learning_rate", "qf_learning_rate"])
def test_a_schedule_that_becomes_negative_is_named_where_it_does(argument):
    model = small("droq", **{argument: lambda left: left - 0.5})
    model._current_progress_remaining = 0.25

    with pytest.raises(ValueError, match=rf"{argument} must be .* 0\.25 of the .* says -0\.25"):
        model.train(1, 16)


def test_learning_rates_of_every_form_may_be_changed_while_loading():
    model = small("droq", learning_rate=1e-4, qf_learning_rate=2e-4)
    assert model.qf_learning_rate == 2e-4

    changed = reloaded(model, learning_rate="lin_3e-4", qf_learning_rate="lin_5e-4")

    assert reloaded(model).learning_rates() == (1e-4, 2e-4)
    assert changed.learning_rates() == pytest.approx((3e-4, 5e-4))
    changed._current_progress_remaining = 0.5
    assert changed.learning_rates() == pytest.approx((1.5e-4, 2.5e-4))
    assert reloaded(changed).qf_learning_rate == "lin_5e-4"


@pytest.mark.parametrize("held", [None, 2e-4])
def test_the_rate_of_the_critics_is_read_from_older_files(held):
    model = small("droq", learning_rate=1e-4)
    # Beside SBX's number, which was the first one of the other rate.
    model.critic_learning_rate, model.qf_learning_rate = held, 1e-4

    loaded, changed = reloaded(model), reloaded(model, qf_learning_rate=5e-4)

    assert loaded.qf_learning_rate == held and changed.qf_learning_rate == 5e-4


@pytest.mark.parametrize("name", ["crossq_jax", pytest.param("td7", marks=pytest.mark.expensive)])
def test_losses_of_the_actor_are_logged_where_it_was_updated(name):
    model = small(name, policy_delay=3, gradient_steps=1, train_freq=1)
    logged(model)
    model.learn(15)
    told, begun = [], model._n_updates

    for _ in range(6):
        model.logger.name_to_value.clear()
        model.train(1, 16)
        told.append(model.logger.name_to_value.get("train/actor_loss"))
        assert "train/critic_loss" in model.logger.name_to_value

    expected = [(begun + i) % 3 == 0 for i in range(1, 7)]
    assert [loss is not None for loss in told] == expected and 0.0 not in told


def test_a_call_of_many_updates_logs_the_last_one_of_the_actor(monkeypatch):
    monkeypatch.setattr(soft_actor_critic, "_MOST_UPDATES", 2)
    model = small("droq", policy_delay=4, learning_starts=0).learn(5)
    lines = logged(model)
    assert model._n_updates == 2

    model.train(3, 16)  # up to the fifth; the fourth is made in another call of the program
    model.logger.dump()

    assert lines.column("train/ent_coef") == [pytest.approx(1.0)]
    assert lines.column("train/actor_loss") != [0.0]


def test_simba_sees_observations_in_units_of_what_it_saw():
    model = small("simba", learning_starts=100).learn(60)
    scales = model.policy.learner.seen

    assert float(scales.count) == 60.0
    speeds = model.replay_buffer.next_observations[:60, 0, 2]
    assert float(scales.mean[2]) == pytest.approx(speeds.mean(), rel=1e-3)


def test_networks_of_simba_serve_other_algorithms():
    model = small("droq", policy="SimbaPolicy", learning_starts=50).learn(30)

    assert isinstance(model.policy.actor_network.body, SimbaBody)
    assert isinstance(model.policy.critic_network.body, SimbaBody)
    assert float(model.policy.learner.seen.count) == 30.0
    assert model.policy.optimizers[0].make is optax.adamw
    assert model.policy.critic_network.body.dropout_rate == 0.01


def test_deviations_of_actions_are_squashed_where_the_authors_of_the_algorithm_do_so():
    squashed = lambda name, **how: small(name, **how).policy.actor_network.squash_log_std  # noqa: E731
    told = {"net_arch": [8], "squash_log_std": True}

    assert squashed("simba") and not squashed("simba", policy=SimbaPolicy)
    assert not squashed("droq", policy="SimbaPolicy")
    assert squashed("droq", policy="SimbaPolicy", policy_kwargs=told)
    assert not squashed("bro", policy_kwargs=told | {"squash_log_std": False})


@pytest.mark.parametrize(
    ("name", "last"), [("gsde_sac", True), ("tqc_jax", True), ("crossq_jax", False)]
)
def test_layers_start_orthogonal_where_that_is_asked_for(name, last):
    told = {"net_arch": [16, 16], "ortho_init": True if last else "hidden"}
    learner = small(name, policy_kwargs=told).policy.learner

    for weights in (learner.actor.weights, learner.critic.weights):
        inner = weights["params"]["body"]["Dense_1"]["kernel"].reshape(-1, 16, 16)
        gained = np.matmul(inner.swapaxes(-1, -2), inner)
        np.testing.assert_allclose(
            gained, np.broadcast_to(2.0 * np.eye(16), gained.shape), atol=1e-5
        )
    mean = learner.actor.weights["params"]["Dense_0"]["kernel"]
    of_values = learner.critic.weights["params"]["Dense_0"]["kernel"][0]
    for kernel in (mean, of_values):
        gains = np.linalg.svd(kernel, compute_uv=False)
        assert np.allclose(gains, np.sqrt(2.0), atol=1e-5) == last
    if name != "gsde_sac":  # whose noise matrix is no layer
        gains = np.linalg.svd(learner.actor.weights["params"]["Dense_1"]["kernel"])[1]
        assert np.allclose(gains, 1.0, atol=1e-5) == last


@pytest.mark.parametrize(("name", "gain"), [("simba", 1.0), ("bro", np.sqrt(2.0))])
def test_last_layers_start_as_in_the_code_of_the_authors(name, gain):
    learner = small(name).policy.learner

    actor, critics = learner.actor.weights["params"], learner.critic.weights["params"]
    for layer, expected in {"Dense_0": gain, "Dense_1": 1.0}.items():
        np.testing.assert_allclose(np.linalg.svd(actor[layer]["kernel"])[1], expected, atol=1e-5)
    np.testing.assert_allclose(np.linalg.svd(critics["Dense_0"]["kernel"])[1], gain, atol=1e-5)
    exploring = small(name, use_sde=True).policy.learner.actor
    mean = exploring.weights["params"]["Dense_0"]["kernel"]
    np.testing.assert_allclose(np.linalg.svd(mean)[1], gain, atol=1e-5)


@pytest.mark.parametrize("name", ["simba", "bro"])
def test_networks_that_start_as_in_their_papers_refuse_another_start(name):
    with pytest.raises(ValueError, match=r"'ortho_init': True.*do not use ortho_init"):
        small(name, policy_kwargs={"ortho_init": True})


@pytest.mark.parametrize(("name", "updates"), [("droq", off_policy), ("td7", td7_update)])
def test_all_updates_run_one_program(name, updates):
    model = small(name).learn(20)
    before = updates.update._cache_size()

    model.learn(50, reset_num_timesteps=False)

    assert model._n_updates > 2 and updates.update._cache_size() == before
