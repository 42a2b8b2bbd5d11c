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
from small_models import MODEL_FREE, SMALL, STATES, greedy, logged, reloaded, same, small
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
from sb3_hds.algos.off_policy import Trained, judge
from sb3_hds.algos.sampling import batches_of
from sb3_hds.errors import EnvironmentMismatchError

SPACES = {
    "box of two axes": spaces.Box(-1, 1, (2, 3)),
    "choices": spaces.Dict(
        a=spaces.Box(-1, 1, (2,)),
        b=spaces.Discrete(3),
        c=spaces.MultiDiscrete([2, 3]),
        d=spaces.MultiBinary(3),
    ),
}

pytestmark = pytest.mark.usefixtures("quick_compilation")


@pytest.mark.parametrize(
    ("name", "space"),
    [("droq", "box of two axes"), ("droq", "choices"), ("td7", "box of two axes")],
)
def test_observations_and_actions_of_any_shape_are_learned_from(name, space):
    # It refuses actions that its space does not contain.
    env = AnySpaces(SPACES[space], spaces.Box(-2.0, 3.0, (2, 2)))
    policy = "MultiInputPolicy" if space == "choices" else "MlpPolicy"

    model = small(name, env, policy=policy, learning_starts=5).learn(9)

    assert env.action_space.contains(model.predict(env.reset()[0])[0])
    assert model.replay_buffer.actions.shape[2:] == (4,)


def test_after_the_same_seed_a_model_explores_and_learns_alike():
    models = [small("tqc_jax", use_sde=True, seed=np.uint32(seed)) for seed in (1, 2)]
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


@pytest.mark.parametrize(
    ("name", "arguments", "message"),
    [
        ("droq", {"policy_kwargs": {"log_std_init": -2.0}}, "log_std_init .* without use_sde"),
        ("crossq_jax", {"policy_kwargs": {"batch_norm_momentum": 0.01}}, r"pass 0\.99"),
        ("crossq_jax", {"tau": 0.01}, "does not look at tau"),
        ("td7", {"gradient_steps": 2, "use_checkpoints": True}, "does not look at gradient_steps"),
    ],
)
def test_arguments_that_say_nothing_are_warned_of(name, arguments, message):
    with pytest.warns(UserWarning, match=message):
        small(name, **arguments)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"observation_space": spaces.Box(0, 255, (3, 36, 36), np.uint8)}, "is an image"),
        ({"observation_space": spaces.MultiDiscrete([[2, 3], [3, 4]])}, "with 2 axes"),
        ({"observation_space": spaces.Dict({})}, "has no numbers"),
        ({"observation_space": spaces.Dict({"a": spaces.Box(-1, 1, ())})}, "without an axis"),
        ({"action_space": spaces.Box(0, 5, (2,), np.int32)}, "whole numbers"),
        ({"action_space": spaces.Box(np.float32([0, -1]), np.float32([0, 1]))}, "have no range"),
    ],
    ids=str,
)
def test_spaces_that_cannot_be_learned_in_are_refused(given, message):
    with pytest.raises(EnvironmentMismatchError, match=message):
        DroQ(env=AnySpaces(**given))


@pytest.mark.parametrize(
    ("space", "obs"),
    [(spaces.Discrete(4, start=2), 1), (spaces.MultiDiscrete([2, 3]), [0, -1])],
)
def test_a_choice_that_there_is_not_gets_no_action(space, obs):
    with pytest.raises(ValueError, match="none of the choices"):
        small("droq", AnySpaces(space, ACT)).predict(np.array(obs))


@pytest.mark.parametrize(("name", "net_arch"), [("droq", []), ("td7", {"pi": [8, 4], "qf": []})])
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


def of_policy(**arguments: Any) -> dict[str, Any]:
    return {"policy_kwargs": {"net_arch": [8]} | arguments}


@pytest.mark.parametrize(
    ("name", "arguments", "message"),
    [
        ("droq", {"tau": 2.0}, "tau must be from 0 to 1"),
        ("droq", {"policy_delay": 0}, "policy_delay must be a whole number of at least 1"),
        ("droq", {"ent_coef": "automatic"}, "ent_coef must be"),
        ("droq", {"ent_coef": "auto_0"}, "ent_coef must be"),
        ("droq", {"target_entropy": "low"}, "target_entropy must be"),
        ("droq", {"linear_ent_coef": "yes"}, "linear_ent_coef must be"),
        ("droq", {"n_steps": 3, "optimize_memory_usage": True}, "False where n_steps > 1"),
        ("droq", {"optimize_memory_usage": True}, "handle_timeout_termination"),
        ("droq", {"param_resets": 50}, "param_resets must be .*50"),
        ("droq", {"param_resets": [500, 100]}, "param_resets must be"),
        ("droq", {"replay_buffer_class": "HerReplayBuffer"}, "replay_buffer_class must be"),
        ("droq", {"learning_rate": "lin_-1e-3"}, "learning rate is a number of at least 0"),
        ("droq", {"qf_learning_rate": "-1e-3"}, "learning rate is a number of at least 0"),
        ("droq", of_policy(net_arch={"pi": [8]}), "net_arch must be"),
        ("droq", of_policy(activation_fn="swoosh"), "activation_fn must be"),
        ("droq", of_policy(optimizer_class="magic"), "optimizer_class must be"),
        ("droq", of_policy(optimizer_kwargs={"speed": 1}), "optimizer_kwargs"),
        ("droq", of_policy(optimizer_class=th.optim.NAdam), "optimizer_class='nadam'"),
        ("droq", of_policy(dropout_rate=1.0), "dropout_rate must be at least 0"),
        ("droq", of_policy(n_quantiles=5), "one value each"),
        ("simba", of_policy(batch_norm_momentum=0.9), "do not use batch_norm_momentum"),
        ("simba", of_policy(ortho_init=True), "do not use ortho_init"),
        ("gsde_sac", of_policy(clip_mean=-1.0), "clip_mean must be"),
        ("gsde_sac", of_policy(log_std_init=np.nan), "log_std_init must be"),
        ("gsde_sac", of_policy(ortho_init="last"), "ortho_init must be"),
        ("crossq_jax", of_policy(batch_norm_momentum=1.5), "batch_norm_momentum must be"),
        ("crossq_jax", of_policy(renorm_warmup_steps=-1), "renorm_warmup_steps must be"),
        ("tqc_jax", {"top_quantiles_to_drop_per_net": 1.5}, "top_quantiles_to_drop_per_net must"),
        ("tqc_jax", of_policy(n_quantiles=None), "n_quantiles must be"),
        ("bro", {"kl_target": -1}, "kl_target must be"),
        ("bro", {"std_multiplier": -2}, "std_multiplier must be"),
        ("td7", {"train_freq": 0}, "train_freq must be"),
        ("td7", of_policy(n_critics=0), "n_critics must be"),
        ("td7", of_policy(embedding_size=0), "embedding_size must be"),
    ],
    ids=str,
)
def test_what_cannot_work_is_refused_at_the_door(name, arguments, message):
    with pytest.raises(ValueError, match=message):
        small(name, **arguments)


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
    again = reloaded(longer, n_steps=1).learn(20)

    discounts = [batches_of(model, 1, 16, 1).discount.min() for model in (longer, again)]
    assert discounts == pytest.approx([0.9**3, 0.9])
    assert type(again.replay_buffer) is type(plain.replay_buffer)
    changed = reloaded(plain, replay_buffer_class=ReplayBuffer)
    assert type(reloaded(changed).replay_buffer) is ReplayBuffer


def test_an_entropy_coefficient_that_a_model_is_loaded_with_is_the_one_that_acts():
    learned = small("droq")
    entropy = learned.policy.learner.log_ent_coef._replace(weights={"params": jnp.float32(-2.0)})
    learned.policy.learner = learned.policy.learner._replace(log_ent_coef=entropy)

    fixed = reloaded(learned, ent_coef=0.3)

    kept = np.exp(fixed.policy.learner.log_ent_coef.weights["params"])
    assert kept == pytest.approx(0.3) and not fixed.policy.recipe.learns_ent_coef
    assert same(reloaded(learned).get_parameters(), learned.get_parameters())
    with pytest.raises(ValueError, match="use_sde must be False"):
        reloaded(learned, use_sde=True)


def test_hindsight_replay_is_learned_from():
    env = BitFlippingEnv(n_bits=3, continuous=True, max_steps=3)
    model = small("droq", env, policy="MultiInputPolicy", replay_buffer_class=HerReplayBuffer)

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
    assert len(model.param_resets or ()) == afresh
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


@pytest.mark.parametrize("argument", ["learning_rate", "qf_learning_rate"])
def test_a_schedule_that_becomes_negative_is_named_where_it_does(argument):
    model = small("droq", **{argument: lambda left: left - 0.5})
    model._current_progress_remaining = 0.25

    with pytest.raises(ValueError, match=rf"{argument} must be .* 0\.25 of the .* says -0\.25"):
        model.train(1, 16)


def test_learning_rates_of_every_form_may_be_changed_while_loading():
    model = small("droq", learning_rate=1e-4, qf_learning_rate=2e-4)

    changed = reloaded(model, learning_rate="lin_3e-4", qf_learning_rate="lin_5e-4")

    assert reloaded(model).learning_rates() == (1e-4, 2e-4)
    assert changed.learning_rates() == pytest.approx((3e-4, 5e-4))
    changed._current_progress_remaining = 0.5
    assert changed.learning_rates() == pytest.approx((1.5e-4, 2.5e-4))
    assert reloaded(changed).qf_learning_rate == "lin_5e-4"


def test_the_rate_of_the_critics_is_read_from_older_files():
    model = small("droq", learning_rate=1e-4)
    # Beside SBX's number, which was the first one of the other rate.
    model.critic_learning_rate, model.qf_learning_rate = 2e-4, 1e-4

    assert reloaded(model).qf_learning_rate == 2e-4
    assert reloaded(model, qf_learning_rate=5e-4).qf_learning_rate == 5e-4


def test_losses_of_the_actor_are_logged_where_it_was_updated():
    model = small("crossq_jax", policy_delay=3, gradient_steps=1, train_freq=1)
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


@pytest.mark.parametrize(("name", "last"), [("tqc_jax", True), ("crossq_jax", False)])
def test_layers_start_orthogonal_where_that_is_asked_for(name, last):
    told = {"net_arch": [16, 16], "ortho_init": True if last else "hidden"}
    learner = small(name, policy_kwargs=told).policy.learner

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
    learner, exploring = (small(name, use_sde=sde).policy.learner for sde in (False, True))

    for trained, layer, expected in (
        (learner.actor, "Dense_0", gain),
        (learner.actor, "Dense_1", 1.0),
        (learner.critic, "Dense_0", gain),
        (exploring.actor, "Dense_0", gain),
    ):
        gains = np.linalg.svd(trained.weights["params"][layer]["kernel"])[1]
        np.testing.assert_allclose(gains, expected, atol=1e-5)


@pytest.mark.parametrize(("name", "updates"), [("droq", off_policy), ("td7", td7_update)])
def test_all_updates_run_one_program(name, updates):
    model = small(name).learn(20)
    before = updates.update._cache_size()

    model.learn(50, reset_num_timesteps=False)

    assert model._n_updates > 2 and updates.update._cache_size() == before
