"""What model-free algorithms are made of, beside references, and what only they can do."""

import dataclasses
import inspect
import re
from functools import partial
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
import sbx
import torch as th
from gymnasium import spaces
from small_models import OFF_POLICY, PLANNERS, SMALL, logged, same, saved, small
from stable_baselines3 import SAC, HerReplayBuffer
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.distributions import (
    SquashedDiagGaussianDistribution,
    StateDependentNoiseDistribution,
)
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import BitFlippingEnv
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from rl_zoo_plugin.lazy import parameters_of
from sb3_hds import GSDESAC, TD7, DroQ, SimbaSAC, algos
from sb3_hds.algos import learn_compiled, off_policy, soft_actor_critic, td7_update
from sb3_hds.algos.bodies import BatchRenorm, Dropout, Mlp, SimbaBody
from sb3_hds.algos.gaussian_policy import SimbaPolicy
from sb3_hds.algos.heads import ExploringActor
from sb3_hds.algos.lap import LapReplayBuffer, SumTree
from sb3_hds.algos.learner import GENERATOR
from sb3_hds.algos.observations import Seen, flattener, seen
from sb3_hds.algos.off_policy import (
    Knobs,
    Trained,
    act,
    average,
    judge,
    least,
    mean,
    pessimistic,
)
from sb3_hds.algos.optimizers import optimizer_of
from sb3_hds.algos.quantiles import (
    Truncated,
    all_targets,
    quantile_huber,
    sorted_by_columns,
    sorted_by_rows,
    target_by_target,
)
from sb3_hds.algos.sampling import batches_of
from sb3_hds.algos.squashed import Gaussian, exploration_std, log_probability, marginal_std
from sb3_hds.errors import EnvironmentMismatchError

MODEL_FREE = [name for name in OFF_POLICY if name not in PLANNERS]
SOFT = [name for name in MODEL_FREE if name != "td7"]
every_algorithm = pytest.mark.parametrize("name", MODEL_FREE)
every_soft = pytest.mark.parametrize("name", SOFT)


def mostly_expensive(*quick: str) -> pytest.MarkDecorator:
    """:return: every algorithm, of which only these are not among the expensive tests"""
    mark = pytest.mark.expensive
    names = [n if n in quick else pytest.param(n, marks=mark) for n in MODEL_FREE]
    return pytest.mark.parametrize("name", names)


# --- gSDE beside SB3's


def both_noises(full_std: bool, use_expln: bool) -> tuple[Gaussian, np.ndarray, Any]:
    """:return: our Gaussian, actions before tanh, and SB3's distribution in double precision"""
    rng = np.random.default_rng(0)
    latent, means, before = rng.normal(size=(3, 7, 5))
    means, before = means[:, :2], 2.0 * before[:, :2]
    before[0, 0] = 5.0  # where the action is 1 but for 1e-4
    log_std = rng.normal(size=(5, 2 if full_std else 1)) - 1.0
    theirs = StateDependentNoiseDistribution(
        2, full_std, use_expln=use_expln, squash_output=True, learn_features=True
    )
    theirs.latent_sde_dim = 5
    theirs.sample_weights(th.as_tensor(log_std), 7)
    # SB3 expands a single column by ones of single precision; these are of double.
    wide = th.as_tensor(np.broadcast_to(log_std, (5, 2)).copy())
    theirs.full_std = True
    theirs.proba_distribution(th.as_tensor(means), wide, th.as_tensor(latent))
    std = exploration_std(jnp.broadcast_to(jnp.asarray(log_std), (5, 2)), use_expln)
    return (
        Gaussian(jnp.asarray(means), marginal_std(jnp.asarray(latent), std), latent),
        before,
        theirs,
    )


@pytest.mark.parametrize("use_expln", [False, True])
@pytest.mark.parametrize("full_std", [False, True])
def test_state_dependent_noise_is_that_of_stable_baselines(full_std, use_expln, x64):
    gaussian, before, theirs = both_noises(full_std, use_expln)
    actions = th.tanh(th.as_tensor(before))

    # SB3 has to find these from rounded actions again, which costs digits where they are near 1.
    np.testing.assert_allclose(gaussian.std, theirs.distribution.stddev, rtol=1e-12)
    np.testing.assert_allclose(jnp.tanh(gaussian.mean), theirs.mode(), rtol=1e-12)
    np.testing.assert_allclose(
        log_probability(gaussian, before), theirs.log_prob(actions), rtol=1e-9
    )


@pytest.mark.parametrize("use_expln", [False, True])
def test_single_precision_does_not_cost_log_probabilities_their_digits(use_expln):
    gaussian, before, theirs = both_noises(True, use_expln)
    expected = theirs.log_prob(th.tanh(th.as_tensor(before)))

    found = log_probability(gaussian, jnp.asarray(before))

    assert found.dtype == jnp.float32
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5)


def test_an_exploring_actor_is_that_of_stable_baselines_with_its_weights(x64):
    theirs = SAC("MlpPolicy", "Pendulum-v1", use_sde=True, buffer_size=10, seed=0).actor.double()
    ours = ExploringActor(Mlp((256, 256), jax.nn.relu), 1, -3.0, True, False, 2.0)
    obs = np.random.default_rng(0).normal(size=(20, 3))
    before = np.random.default_rng(1).normal(size=(20, 1))
    layer = lambda given: {"kernel": given.weight.T.numpy(), "bias": given.bias.numpy()}  # noqa: E731

    with th.no_grad():
        theirs.log_std += 0.3 * th.randn_like(theirs.log_std)
        latent = theirs.latent_pi(th.as_tensor(obs))
        noise = theirs.action_dist.proba_distribution(theirs.mu(latent), theirs.log_std, latent)
        expected = noise.log_prob(th.tanh(th.as_tensor(before)))
        hidden, last = (theirs.latent_pi[0], theirs.latent_pi[2]), theirs.mu[0]
        body = {f"Dense_{i}": layer(each) for i, each in enumerate(hidden)}
        params = {"body": body, "Dense_0": layer(last), "log_std": theirs.log_std.numpy()}
        gaussian = ours.apply({"params": params}, jnp.asarray(obs))

    np.testing.assert_allclose(gaussian.mean, noise.distribution.mean, rtol=1e-9)
    np.testing.assert_allclose(gaussian.std, noise.distribution.stddev, rtol=1e-9)
    np.testing.assert_allclose(log_probability(gaussian, before), expected, rtol=1e-9, atol=1e-5)


def test_a_squashed_gaussian_is_that_of_stable_baselines(x64):
    rng = np.random.default_rng(0)
    means, log_std, before = rng.normal(size=(3, 7, 2))
    before[0, 0] = 5.0  # where the action is 1 but for 1e-4
    theirs = SquashedDiagGaussianDistribution(2)
    theirs.proba_distribution(th.as_tensor(means), th.as_tensor(log_std))
    expected = theirs.log_prob(th.tanh(th.as_tensor(before)), th.as_tensor(before))

    gaussian = Gaussian(jnp.asarray(means), jnp.exp(log_std), jnp.zeros((7, 0)))

    np.testing.assert_allclose(jnp.tanh(gaussian.mean), theirs.mode(), rtol=1e-12)
    # 1 - tanh^2 + 1e-6 has lost eight digits where SB3 takes it of the action.
    np.testing.assert_allclose(log_probability(gaussian, before), expected, rtol=1e-8)


def test_noise_depends_on_the_state_and_stays_until_it_is_drawn_again():
    model = small("gsde_sac", policy_kwargs={"net_arch": [8], "log_std_init": 0.0})
    obs = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 2.0]], np.float32)

    model.policy.reset_noise()
    before = lambda **how: np.arctanh(np.clip(model.predict(obs, **how)[0] / 2.0, -0.999, 0.999))  # noqa: E731
    deviations = [before() - before(deterministic=True) for _ in range(2)]
    model.policy.reset_noise()

    np.testing.assert_array_equal(*deviations)
    assert abs(deviations[0][0] - deviations[0][1]) > 1e-3
    assert np.abs(before() - before(deterministic=True) - deviations[0]).min() > 1e-3
    assert model.policy.get_std().shape == (8, 1)
    assert model.policy.get_std().mean() == pytest.approx(1.0)


def test_each_environment_has_its_noise_matrix_and_the_deviation_is_logged():
    env = DummyVecEnv([lambda: gymnasium.make("Pendulum-v1")] * 3)
    model = small("gsde_sac", env, train_freq=5)
    lines = logged(model)

    model.learn(700, log_interval=1)

    policy, obs = model.policy, np.ones((3, 3), np.float32)
    gaussian, _ = act(policy.actor_network, policy.learner.actor.weights, obs)
    noise = np.stack([gaussian.latent[0] @ matrix for matrix in policy.matrices])
    wanted = 2.0 * np.tanh(gaussian.mean + noise)
    np.testing.assert_allclose(model.predict(obs)[0], wanted, rtol=1e-4, atol=1e-6)
    assert len(np.unique(wanted)) == 3
    stds = lines.column("train/std")
    assert stds and stds[-1] == pytest.approx(np.exp(-3.0), rel=0.5)
    assert isinstance(model.policy.actor_network, ExploringActor)


@pytest.mark.parametrize("compiled", [False, True])
def test_a_noise_matrix_lasts_over_as_many_collections_as_it_takes(compiled):
    how = {"train_freq": 5, "sde_sample_freq": 20, "use_sde_at_warmup": True}
    how |= {"learning_starts": 50, "policy_kwargs": {"net_arch": [8], "log_std_init": -3.0}}
    model = small("gsde_sac", **how)
    model = learn_compiled(model, 40)[0][0] if compiled else model.learn(40)

    buffer, policy = model.replay_buffer, model.policy
    gaussian, _ = act(
        policy.actor_network, policy.learner.actor.weights, buffer.observations[:40, 0]
    )
    apart = np.arctanh(buffer.actions[:40, 0]) - gaussian.mean

    def misfit(steps: slice) -> float:
        """Of the one noise matrix that explains these steps best."""
        latent = np.asarray(gaussian.latent[steps])
        matrix, *_ = np.linalg.lstsq(latent, apart[steps], rcond=None)
        return float(np.abs(latent @ matrix - apart[steps]).max())

    assert misfit(slice(0, 20)) < 1e-5 and misfit(slice(20, 40)) < 1e-5
    assert misfit(slice(10, 30)) > 1e-3


@pytest.mark.parametrize(
    ("train_freq", "drawn"), [(1, [150, 300]), ((1, "episode"), [150, 200, 350])]
)
def test_a_noise_matrix_lasts_if_each_step_is_a_collection_and_ends_with_an_episode_that_is(
    train_freq, drawn
):
    how = {"train_freq": train_freq, "sde_sample_freq": 150, "learning_starts": 1_000}
    model, matrices = small("tqc_jax", use_sde=True, **how), []

    def keep(*_) -> bool:
        matrices.append(model.policy.matrices)
        return True

    model.learn(400, callback=keep)

    changes = [i for i in range(1, 400) if (matrices[i] != matrices[i - 1]).any()]
    assert changes == drawn


def test_noise_that_is_drawn_at_each_step_is_warned_of():
    with pytest.warns(UserWarning, match="draws a new noise matrix at each step"):
        small("droq", use_sde=True, train_freq=1)


@pytest.mark.parametrize("at_warmup", [True, False])
def test_noise_acts_before_learning_starts_only_where_it_is_told_to(at_warmup):
    how = {"learning_starts": 100, "train_freq": 10, "use_sde_at_warmup": at_warmup}
    model = small("gsde_sac", **how).learn(10)
    seen, taken = model.replay_buffer.observations[:10, 0], model.replay_buffer.actions[:10, 0]

    # One matrix in the whole collection: the policy's actions can be had again.
    explored = model.policy.scale_action(model.predict(seen)[0])

    assert np.allclose(explored, taken, atol=1e-5) == at_warmup
    assert model._n_updates == 0


@pytest.mark.parametrize("name", ["tqc_jax", "crossq_jax"])
def test_other_algorithms_explore_by_the_same_noise(name):
    model = small(name, use_sde=True, sde_sample_freq=2).learn(30)

    assert model.policy.matrices is not None and model.policy.get_std().mean() > 0.0


# --- the parts


def test_how_critics_become_targets_and_what_they_are_worth():
    values = jnp.array([[[4.0, 1.0]], [[2.0, 3.0]]])  # two critics, one state, two quantiles

    np.testing.assert_array_equal(least(values), [[2.0, 1.0]])
    np.testing.assert_array_equal(average(values), [[3.0, 2.0]])
    np.testing.assert_array_equal(Truncated(1)(values), [[1.0, 2.0]])
    optimist = jnp.array([[[4.0, 3.0]], [[2.0, 1.0]]])
    np.testing.assert_array_equal(Truncated(1)(optimist), [[1.0, 2.0]])
    assert mean(values) == pytest.approx(2.5)
    assert pessimistic(values) == pytest.approx(2.5)


def test_the_quantile_loss_is_least_at_the_quantiles():
    targets = jnp.linspace(-1.0, 1.0, 2001)[None]
    best = (jnp.arange(4) + 0.5) / 2.0 - 1.0
    loss = lambda shift: quantile_huber((best + shift)[None, None], targets)  # noqa: E731

    # The Huber part smooths within 1: the slopes at the quantiles are those of an expectile.
    assert loss(0.0) < min(loss(0.5), loss(-0.5))

    def by_hand(level, y, q):
        size = abs(y - q)
        return abs(level - (y < q)) * (0.5 * size**2 if size <= 1.0 else size - 0.5)

    expected = np.mean(
        [
            by_hand((i + 0.5) / 4.0, y, q)
            for i, q in enumerate(np.asarray(best))
            for y in np.asarray(targets[0])
        ]
    )
    assert float(loss(0.0)) == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("n_targets", [1, 6, 8])
def test_the_slope_of_the_quantile_loss_is_that_of_all_pairs(n_targets):
    rng = np.random.default_rng(0)
    values, targets = (
        jnp.asarray(3.0 * rng.normal(size=shape)) for shape in ((3, 5, 4), (5, n_targets))
    )
    level = (jnp.arange(4) + 0.5) / 4.0

    def of_pairs(values):
        delta = targets[None, :, None, :] - values[..., None]
        loss = optax.losses.huber_loss(delta)
        weight = jnp.where(delta < 0.0, 1.0 - level[:, None], level[:, None])
        return jnp.sum(jnp.mean(weight * loss, (1, 2, 3)))

    loss, slope = jax.value_and_grad(quantile_huber)(values, targets)
    expected, slope_of_pairs = jax.value_and_grad(of_pairs)(values)

    np.testing.assert_allclose(loss, expected, rtol=1e-5)
    np.testing.assert_allclose(slope, slope_of_pairs, rtol=1e-5, atol=1e-7)
    for processor in (target_by_target, all_targets):
        losses, slopes = processor(values, targets)
        np.testing.assert_allclose(losses.sum() / (20 * n_targets), expected, rtol=1e-5)
        np.testing.assert_allclose(slopes / (20 * n_targets), slope_of_pairs, rtol=1e-5, atol=1e-7)
    assert not jax.grad(quantile_huber, 1)(values, targets).any()


@pytest.mark.parametrize(("n_quantiles", "n_dropped"), [(1, 0), (3, 0), (3, 1), (25, 2), (33, 5)])
def test_the_least_quantiles_stay(n_quantiles, n_dropped):
    values = np.random.default_rng(0).normal(size=(2, 7, n_quantiles)).astype(np.float32)
    values[1] = values[1].round(1)  # some are equal

    kept = np.asarray(Truncated(n_dropped)(jnp.asarray(values)))

    pool = np.sort(np.concatenate(list(values), -1), -1)
    np.testing.assert_array_equal(np.sort(kept, -1), pool[:, : 2 * (n_quantiles - n_dropped)])


@pytest.mark.parametrize("processor", [sorted_by_columns, sorted_by_rows])
def test_every_processor_sorts_alike(processor):
    values = np.random.default_rng(0).normal(size=(7, 50)).astype(np.float32)
    values[3, 4] = np.nan

    rows = np.asarray(processor(jnp.asarray(values)))

    assert np.isnan(rows[3]).all()
    np.testing.assert_array_equal(np.delete(rows, 3, 0), np.sort(np.delete(values, 3, 0), -1))


def test_a_quantile_that_is_no_number_makes_no_number_of_all_that_are_kept():
    values = jnp.zeros((2, 3, 4)).at[1, 1, 2].set(jnp.nan)

    kept = np.isnan(Truncated(1)(values))

    assert kept[1].all() and not kept[[0, 2]].any()
    assert np.isnan(quantile_huber(values, Truncated(1)(values)))


def test_one_critic_is_judged_as_one_of_several():
    policy = small("crossq_jax", policy_kwargs={"n_critics": 1, "net_arch": [4]}).learn(20).policy
    recipe, weights = policy.recipe, policy.learner.critic.weights
    rng = np.random.default_rng(0)
    obs, action = (
        jnp.asarray(rng.normal(size=(9, n)), jnp.float32) for n in (policy.n_obs, policy.n_act)
    )

    alone = judge(recipe, weights, obs, action, jax.random.key(0), train=True)
    both = jax.tree.map(lambda x: jnp.concatenate([x, x]), weights)
    pair = judge(
        dataclasses.replace(recipe, n_critics=2), both, obs, action, jax.random.key(0), train=True
    )

    first = jax.tree.map(lambda x: x[:1], pair)
    assert jax.tree.structure(alone) == jax.tree.structure(first)
    for found, expected in zip(jax.tree.leaves(alone), jax.tree.leaves(first), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-6)


def test_dropout_zeroes_its_share_independently_and_keeps_the_mean():
    x = jnp.ones((400, 500))
    masks = [
        np.asarray(Dropout(0.1).apply({}, x, rngs={"dropout": jax.random.key(seed)})) == 0.0
        for seed in (0, 1)
    ]

    for mask in masks:
        # Six standard deviations of a share of 200,000.
        assert mask.mean() == pytest.approx(0.1, abs=6 * np.sqrt(0.09 / mask.size))
        assert mask.mean(0).std() == pytest.approx(np.sqrt(0.09 / 400), rel=0.2)
    together = (masks[0] & masks[1]).mean()
    assert together == pytest.approx(0.01, abs=6 * np.sqrt(0.01 / x.size))
    assert (masks[0][:, 1:] & masks[0][:, :-1]).mean() == pytest.approx(0.01, abs=0.002)


def test_batch_renormalisation_normalises_by_the_batch_and_remembers():
    x = jnp.asarray(np.random.default_rng(0).normal(3.0, 2.0, (64, 4)), jnp.float32)
    layer = BatchRenorm(warmup=10, momentum=0.9)
    weights = layer.init(jax.random.key(0), x, True)

    for _ in range(100):
        y, changed = layer.apply(weights, x, True, mutable=["statistics"])
        weights = {**weights, **changed}

    np.testing.assert_allclose(y.mean(0), 0.0, atol=1e-3)
    np.testing.assert_allclose(y.std(0), 1.0, atol=1e-2)
    np.testing.assert_allclose(weights["statistics"]["mean"], x.mean(0), rtol=1e-3)
    np.testing.assert_allclose(layer.apply(weights, x, False), y, atol=1e-2)


def test_running_statistics_are_those_of_all_observations():
    rows = np.random.default_rng(0).normal(5.0, 3.0, (50, 2)).astype("f")
    scales = Seen.nothing(2)
    for part in np.split(rows, 10):
        scales = scales.with_more(part)

    np.testing.assert_allclose(scales.mean, rows.mean(0), rtol=1e-5)
    np.testing.assert_allclose(scales.variance, rows.var(0), rtol=1e-4)
    np.testing.assert_allclose(seen(scales, rows).std(0), 1.0, rtol=1e-3)
    np.testing.assert_array_equal(seen(Seen.nothing(2), rows), rows)


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
    assert set(steps) == {2} and set(copies) == {1}
    assert buffer.highest == 5.0
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


def test_choices_become_one_hot_and_dictionaries_one_row():
    space = spaces.Dict(
        {
            "box": spaces.Box(-1, 1, (2, 2)),
            "choice": spaces.Discrete(3, start=5),
            "choices": spaces.MultiDiscrete([2, 3]),
            "flags": spaces.MultiBinary(2),
        }
    )
    sample = {name: value[None] for name, value in space.sample().items()}
    sample |= {"choice": np.array([6]), "choices": np.array([[1, 2]])}

    [flat] = flattener(space)(sample)

    assert flat.shape == (spaces.flatdim(space),)
    np.testing.assert_array_equal(flat[4:7], [0, 1, 0])
    np.testing.assert_array_equal(flat[7:12], [0, 1, 0, 0, 1])


@mostly_expensive("td7")
def test_all_updates_run_one_program(name):
    program = td7_update.update if name == "td7" else off_policy.update
    model = small(name, batch_size=17)  # as no other test has
    before = program._cache_size()

    model.learn(50)

    assert program._cache_size() == before + 1


DECOMPOSITION = re.compile(r"@lapack_\w+qr\w*\(.*: \(tensor<(\w+)xf32>")


@every_soft
def test_no_batch_is_decomposed_at_once(name):
    """With two in one program, both threads of two could wait for the other one for ever."""
    args: Any = {"policy_kwargs": {"ortho_init": True}} if name not in ("simba", "bro") else {}
    model = small(name, **args)
    recipe, n_obs, n_act = (getattr(model.policy, each) for each in ("recipe", "n_obs", "n_act"))

    program = off_policy.begin.lower(recipe, n_obs, n_act, 1.0, jax.random.key(0)).as_text()

    shapes = DECOMPOSITION.findall(program)
    assert shapes
    assert all(shape.count("x") == 1 for shape in shapes)


# --- what an algorithm takes


class Constant(gymnasium.Env):
    """An environment with any spaces, of ten steps."""

    def __init__(self, observation_space, action_space) -> None:
        self.observation_space, self.action_space = observation_space, action_space

    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        self._left = 10
        return self.observation_space.sample(), {}

    def step(self, action):
        assert self.action_space.contains(action)
        self._left -= 1
        return self.observation_space.sample(), 1.0, False, self._left == 0, {}


SPACES = {
    "box of two axes": spaces.Box(-1, 1, (2, 3)),
    "discrete": spaces.Discrete(4),
    "multi-discrete": spaces.MultiDiscrete([2, 3]),
    "multi-binary": spaces.MultiBinary(3),
    "dict": spaces.Dict({"a": spaces.Box(-1, 1, (2,)), "b": spaces.Discrete(3)}),
}


@pytest.mark.parametrize("space", SPACES)
def test_observations_of_numbers_and_choices_are_learned_from(space):
    env = Constant(SPACES[space], spaces.Box(-2.0, 3.0, (2, 2)))
    policy = "MultiInputPolicy" if space == "dict" else "MlpPolicy"

    model = DroQ(policy, env, seed=0, **SMALL["droq"]).learn(30)

    action, _ = model.predict(env.reset()[0])
    assert env.action_space.contains(action)


@mostly_expensive("gsde_sac", "td7", "bro")
@pytest.mark.parametrize("shape", [(2, 2), (3, 1)])
def test_actions_have_the_shape_of_the_action_space(name, shape):
    # It refuses what the space does not contain.
    env = Constant(spaces.Box(-1, 1, (3,)), spaces.Box(-2.0, 3.0, shape))

    model = small(name, env).learn(30)

    assert model.predict(np.zeros(3, np.float32))[0].shape == shape
    assert model.replay_buffer.actions.shape[2:] == (int(np.prod(shape)),)


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
    seeds = np.random.SeedSequence(0).generate_state(1)

    one, other = small("droq", seed=seeds[0]), small("droq", seed=int(seeds[0]))

    assert same(one.get_parameters(), other.get_parameters())
    with pytest.raises(TypeError, match="seed must be None or a whole number"):
        small("droq", seed=0.5)


@pytest.mark.parametrize(
    ("name", "policy_kwargs", "message"),
    [
        (
            "droq",
            {"net_arc": [8]},
            r"GaussianPolicy has no such argument.*mean 'net_arch'",
        ),
        ("hds", {"net_arc": [8]}, r"TwinPolicy has no such argument.*mean 'net_arch'"),
        ("td7", {"critics": 3}, r"TD7Policy has no such argument\. Did you mean 'n_critics'"),
        ("droq", {"size": 3}, r"It has: net_arch, activation_fn, n_critics"),
        ("simba", {"normalize_images": False}, r"for modules of torch, .*: leave it out"),
    ],
)
def test_arguments_that_a_policy_does_not_have_are_refused(name, policy_kwargs, message):
    with pytest.raises(TypeError, match=message):
        algos.ALL[name]("Pendulum-v1", policy_kwargs=policy_kwargs)


def test_critics_of_one_value_have_no_quantiles():
    with pytest.raises(ValueError, match=r"'n_quantiles': 5.*one value each: leave it out, or use"):
        DroQ("Pendulum-v1", policy_kwargs={"n_quantiles": 5})


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
        algos.ALL[name]("Pendulum-v1", **arguments)


def test_models_that_were_given_the_same_dictionary_do_not_share_it():
    kwargs = {"net_arch": [8]}
    exploring = GSDESAC("Pendulum-v1", policy_kwargs=kwargs)
    DroQ("Pendulum-v1", policy_kwargs=kwargs)

    buffer = {"handle_timeout_termination": False}
    longer = DroQ("Pendulum-v1", n_steps=3, replay_buffer_kwargs=buffer, buffer_size=10)

    assert kwargs == {"net_arch": [8]} and exploring.policy_kwargs["use_sde"]
    assert buffer == {"handle_timeout_termination": False}
    assert longer.replay_buffer_kwargs["n_steps"] == 3


@pytest.mark.parametrize("shape", [(3, 36, 36), (36, 36)])
def test_images_are_refused(shape):
    env = Constant(spaces.Box(0, 255, shape, np.uint8), spaces.Box(-1, 1, (1,)))

    with pytest.raises(EnvironmentMismatchError, match="is an image"):
        DroQ("MlpPolicy", env)


@pytest.mark.parametrize(
    ("space", "message"),
    [
        (spaces.MultiDiscrete([[2, 3], [3, 4]]), "MultiDiscrete with 2 axes"),
        (spaces.Box(-1, 1, (0,)), "has no numbers"),
        (spaces.Dict({}), "has no numbers"),
        (spaces.Dict({"angle": spaces.Box(-1, 1, ())}), r"'angle' is a number without an axis"),
    ],
    ids=str,
)
def test_observations_that_cannot_be_learned_from_are_refused(space, message):
    with pytest.raises(EnvironmentMismatchError, match=message):
        DroQ(env=Constant(space, spaces.Box(-1, 1, (1,))))


@pytest.mark.parametrize(
    ("space", "message"),
    [
        (spaces.Box(0, 5, (2,), np.int32), "whole numbers"),
        (spaces.Box(np.array([0.0, -1.0], "f"), np.array([0.0, 1.0], "f")), "have no range"),
    ],
    ids=str,
)
def test_actions_that_cannot_be_scaled_are_refused(space, message):
    with pytest.raises(EnvironmentMismatchError, match=message):
        DroQ(env=Constant(spaces.Box(-1, 1, (3,)), space))


@pytest.mark.parametrize(
    ("space", "obs"),
    [
        (spaces.Discrete(4, start=2), 1),
        (spaces.Discrete(4, start=2), 6),
        (spaces.MultiDiscrete([2, 3]), [2, 0]),
        (spaces.MultiDiscrete([2, 3]), [0, -1]),
    ],
)
def test_a_choice_that_there_is_not_gets_no_action(space, obs):
    model = small("droq", Constant(space, spaces.Box(-1, 1, (1,))))

    with pytest.raises(ValueError, match="none of the choices that its space has"):
        model.predict(np.array(obs))


def test_parts_of_an_observation_come_in_equal_numbers():
    env = Constant(SPACES["dict"], spaces.Box(-1, 1, (1,)))
    model = small("droq", env, policy="MultiInputPolicy")

    with pytest.raises(ValueError, match=r"different numbers of observations \(a: 1, b: 2\)"):
        model.predict({"a": np.zeros((1, 2), np.float32), "b": np.array([1, 2])})


# --- what SB3's own tests ask for


@mostly_expensive("droq", "td7")
@pytest.mark.parametrize("net_arch", [[], {"pi": [8, 4], "qf": [6]}])
def test_networks_may_have_no_hidden_layer_or_layers_of_several_widths(name, net_arch):
    kwargs = SMALL[name]["policy_kwargs"] | {"net_arch": net_arch}

    assert np.isfinite(small(name, policy_kwargs=kwargs).predict(np.zeros(3, np.float32))[0]).all()


@every_algorithm
def test_values_of_the_critics_can_be_looked_at(name):
    model = small(name)
    obs = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, -2.0]], np.float32)

    actions = model.actor(th.as_tensor(obs), deterministic=True)
    values = model.critic(th.as_tensor(obs), th.as_tensor(actions))

    assert len(values) == 2 and {value.shape for value in values} == {(2, 1)}
    np.testing.assert_allclose(2.0 * actions, model.predict(obs, deterministic=True)[0], rtol=1e-5)
    assert not np.array_equal(values[0], model.critic(obs, -np.ones((2, 1)))[0])


def test_critics_agree_with_the_values_that_targets_are_made_of():
    model = small("tqc_jax")
    obs, action = np.ones((1, 3), np.float32), np.full((1, 1), 0.3, np.float32)
    weights = model.policy.learner.critic.weights

    [[one], [other]] = model.critic(obs, action)

    values, _ = judge(model.policy.recipe, weights, obs, action, jax.random.key(1))
    np.testing.assert_allclose([one[0], other[0]], values.mean(-1)[:, 0], rtol=1e-6)


def test_a_replay_buffer_that_is_read_belongs_to_the_models_device(tmp_path):
    model = small("droq", n_steps=2).learn(30)
    model.save_replay_buffer(tmp_path / "buffer")
    model.device = th.device("cuda")

    model.load_replay_buffer(tmp_path / "buffer")

    assert model.replay_buffer.device.type == "cuda"
    assert batches_of(model, 1, 4, 1).obs.shape == (1, 4, 3)


def test_returns_of_several_steps_need_a_buffer_that_has_them():
    env = Constant(SPACES["dict"], spaces.Box(-1, 1, (1,)))
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
        ("bro", "MlpPolicy", {"renorm_warmup_steps": 100}),
        ("bro", "MlpPolicy", {"dropout_rate": 0.1}),
        ("gsde_sac", "MlpPolicy", {"batch_norm_momentum": 0.9}),
    ],
)
def test_arguments_that_the_networks_do_not_use_are_refused(name, policy, argument):
    with pytest.raises(ValueError, match=f"do not use {next(iter(argument))}"):
        small(name, policy=policy, policy_kwargs={"net_arch": [8], **argument})


def test_batch_normalisation_of_crossq_begins_where_it_is_told_to():
    steps = {}
    for told in (None, 7):
        kwargs = {"net_arch": [8], "renorm_warmup_steps": told}
        steps[told] = small("crossq_jax", policy_kwargs=kwargs).policy.renorm_warmup_steps

    assert steps == {None: 100_000, 7: 7}
    with pytest.raises(ValueError, match="renorm_warmup_steps must be a whole number"):
        small("crossq_jax", policy_kwargs={"renorm_warmup_steps": -1})


@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        ("droq", {"param_resets": 50}),
        ("droq", {"param_resets": np.array([5, 10])}),
        ("droq", {"train_freq": 0}),
        ("droq", {"train_freq": (-1, "episode")}),
        ("td7", {"train_freq": 0}),
        ("droq", {"action_noise": "normal"}),
        ("droq", {"replay_buffer_class": "HerReplayBuffer"}),
        ("droq", {"policy_kwargs": {"dropout_rate": None}}),
        ("gsde_sac", {"policy_kwargs": {"log_std_init": np.nan}}),
        ("gsde_sac", {"policy_kwargs": {"clip_mean": -1.0}}),
        ("crossq_jax", {"policy_kwargs": {"batch_norm_momentum": 1.5}}),
        ("bro", {"gradient_steps": "many"}),
        ("droq", {"param_resets": ["a", -3]}),
        ("droq", {"param_resets": [500, 100]}),
        ("droq", {"sde_sample_freq": 2.5}),
        ("tqc_jax", {"top_quantiles_to_drop_per_net": 1.5}),
        ("tqc_jax", {"policy_kwargs": {"n_quantiles": None}}),
        ("gsde_sac", {"policy_kwargs": {"n_quantiles": 2.0}}),
        ("gsde_sac", {"policy_kwargs": {"n_critics": 0}}),
        ("gsde_sac", {"policy_kwargs": {"ortho_init": "last"}}),
        ("td7", {"policy_kwargs": {"n_critics": 0}}),
        ("td7", {"policy_kwargs": {"embedding_size": 0}}),
        ("bro", {"kl_target": -1}),
        ("bro", {"std_multiplier": -2}),
        ("bro", {"multiplier_rate": -1}),
        ("simba", {"clipped_double_q": "no"}),
        ("droq", {"linear_ent_coef": "yes"}),
    ],
    ids=str,
)
def test_an_argument_out_of_range_is_refused_by_name(name, arguments):
    [(argument, value)] = (arguments.get("policy_kwargs") or arguments).items()

    with pytest.raises(ValueError, match=rf"{argument} must be .*") as caught:
        small(name, **arguments)

    assert repr(value) in str(caught.value)


@every_algorithm
def test_the_default_number_of_steps_goes_beyond_the_random_ones(name):
    algorithm = algos.ALL[name]

    assert algorithm.default_timesteps >= 2 * parameters_of(algorithm)["learning_starts"].default


@pytest.mark.parametrize(
    ("make", "arguments"),
    [
        (th.optim.Adam, {"betas": (0.8, 0.99), "eps": 1e-5}),
        (th.optim.AdamW, {}),
        (th.optim.AdamW, {"weight_decay": 0.1}),
        (th.optim.RMSprop, {}),
        (th.optim.RMSprop, {"alpha": 0.9, "momentum": 0.5}),
        (th.optim.RAdam, {}),
        (th.optim.SGD, {"momentum": 0.9, "nesterov": True}),
        (th.optim.Adamax, {}),
        (th.optim.Adadelta, {"rho": 0.8}),
        (th.optim.Adagrad, {}),
    ],
)
def test_a_torch_class_means_what_it_does_in_torch(make, arguments):
    rng = np.random.default_rng(0)
    # RAdam's rectification begins with the sixth step.
    w, slopes = rng.normal(size=(5, 2)), rng.normal(size=(8, 5, 2))
    theirs = th.nn.Parameter(th.tensor(w))
    torch_optimizer = make([theirs], lr=0.03, **arguments)
    ours = optimizer_of(make, arguments)

    with jax.enable_x64(True):
        trained = Trained({"params": jnp.asarray(w)}, ours.init(jnp.asarray(w)))
        for slope in slopes:
            trained = ours.apply(jnp.asarray(slope), trained, 0.03)
            theirs.grad = th.tensor(slope)
            torch_optimizer.step()

        np.testing.assert_allclose(trained.weights["params"], theirs.detach(), rtol=1e-6)


def test_an_optimiser_of_ones_own_may_have_a_known_name():
    def adam(learning_rate):
        return optax.sgd(learning_rate)

    class Adam(th.optim.Adam):
        pass

    assert optimizer_of(adam, {}).make is adam
    assert optimizer_of(optax.adam, {}).make is optax.adam
    with pytest.raises(ValueError, match="use optimizer_class='adam'"):
        optimizer_of(Adam, {})


def test_torch_classes_are_understood():
    kwargs = {
        "activation_fn": th.nn.ELU,
        "optimizer_class": th.optim.AdamW,
        "optimizer_kwargs": {"betas": (0.8, 0.99), "weight_decay": 1e-3},
    }
    model = small("droq", policy_kwargs=SMALL["droq"]["policy_kwargs"] | kwargs).learn(20)

    assert dict(model.policy.optimizers[0].arguments)["b1"] == 0.8


@every_algorithm
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
    algorithm, pendulum = algos.ALL[name], gymnasium.make("Pendulum-v1")
    plain = small(name)

    longer = algorithm.load(saved(plain), env=pendulum, n_steps=3, gamma=0.9).learn(20)
    shorter = algorithm.load(saved(longer), env=pendulum, gamma=0.8).learn(20)
    again = algorithm.load(saved(longer), env=pendulum, n_steps=1).learn(20)

    discounts = [batches_of(model, 1, 16, 1).discount.min() for model in (longer, shorter, again)]
    assert discounts == pytest.approx([0.9**3, 0.8**3, 0.9])
    assert type(again.replay_buffer) is type(plain.replay_buffer)


def test_an_entropy_coefficient_that_a_model_is_loaded_with_is_the_one_that_acts():
    learned = small("droq", policy_delay=1).learn(20)
    pendulum = gymnasium.make("Pendulum-v1")

    fixed = DroQ.load(saved(learned), env=pendulum, ent_coef=0.3)
    lines = logged(fixed)
    fixed.learn(20).logger.dump()

    assert lines.column("train/ent_coef")[-1] == pytest.approx(0.3)
    as_saved = DroQ.load(saved(learned), env=pendulum)
    assert same(as_saved.get_parameters(), learned.get_parameters())


def test_exploration_is_that_of_the_networks_that_are_loaded():
    with pytest.raises(ValueError, match=r"DroQ\(use_sde=True\): use_sde must be False, as when"):
        DroQ.load(saved(small("droq")), use_sde=True)


def test_a_replay_buffer_that_was_passed_is_used_after_loading():
    uniform = small("td7", replay_buffer_class=ReplayBuffer)

    loaded = TD7.load(saved(uniform), env=gymnasium.make("Pendulum-v1"))
    changed = TD7.load(saved(small("td7")), replay_buffer_class=ReplayBuffer)

    assert type(loaded.replay_buffer) is type(changed.replay_buffer) is ReplayBuffer


@mostly_expensive("droq", "td7")
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


@every_algorithm
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


def test_bro_starts_afresh_with_its_temperature_and_others_keep_theirs():
    for name, afresh in (("bro", True), ("droq", False)):
        model = small(name, policy_delay=1).learn(20)
        before = model.policy.learner.log_ent_coef
        assert float(before.weights["params"]) != 0.0

        model._restart(seed=1)

        after = model.policy.learner.log_ent_coef
        assert (float(after.weights["params"]) == 0.0) == afresh, name
        counts = [int(part[0].count) for part in (before.optimizer, after.optimizer)]
        assert counts[0] > 0 and counts[1] == (0 if afresh else counts[0]), name


def test_entropy_may_be_worth_nothing():
    model = small("gsde_sac", ent_coef=0.0)
    lines = logged(model)

    model.learn(40, log_interval=1).logger.dump()

    assert lines.column("train/ent_coef")[-1] == 0.0
    assert np.isfinite(lines.column("train/critic_loss")[-1])
    assert DroQ.load(saved(small("droq").learn(20)), ent_coef=0.0).get_parameters()


@pytest.mark.parametrize(("gradient_steps", "n"), [(10, 8), (2, 1), (-1, 1)])
def test_bro_starts_afresh_less_often_where_it_makes_few_updates(gradient_steps, n):
    assert len(small("bro", gradient_steps=gradient_steps).param_resets) == n


@every_soft
def test_whether_the_loss_of_the_entropy_coefficient_is_linear_is_an_argument(name):
    usual = small(name)
    other = small(name, linear_ent_coef=not usual.linear_ent_coef)

    assert usual.policy.recipe.linear_ent_coef == (name in ("crossq_jax", "simba", "bro"))
    assert other.policy.recipe.linear_ent_coef != usual.policy.recipe.linear_ent_coef
    loaded = type(other).load(saved(other))
    assert loaded.policy.recipe.linear_ent_coef == other.policy.recipe.linear_ent_coef


def trained(learner: Any) -> dict[str, np.ndarray]:
    """:return: all that optimisers change, whatever it belongs to"""
    parts = jax.tree_util.tree_leaves_with_path(learner, is_leaf=lambda x: isinstance(x, Trained))
    return {
        jax.tree_util.keystr(path + inside): np.array(leaf)
        for path, part in parts
        if isinstance(part, Trained)
        for inside, leaf in jax.tree_util.tree_leaves_with_path(part.weights["params"])
    }


@mostly_expensive("bro", "td7")
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

    further = {"bro": ".extra['optimism']", "td7": ".encoder"}.get(name, ".log_ent_coef")
    assert any(further in key for key in begun)
    for key, weights in begun.items():
        np.testing.assert_array_equal(ended[key], weights, err_msg=key)
        assert (again[key] != weights).any(), key


@pytest.mark.parametrize("rate", ["lin_-1e-3", "-1e-3", "lin_nan"])
@pytest.mark.parametrize("argument", ["learning_rate", "qf_learning_rate"])
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


def test_numbers_of_numpy_are_learning_rates():
    model = small("droq", learning_rate=np.float32(1e-3), qf_learning_rate=np.float64(2e-3))

    assert model.learning_rates() == pytest.approx((1e-3, 2e-3))
    assert DroQ.load(saved(model)).learning_rate == pytest.approx(1e-3)


def test_learning_rates_of_every_form_may_be_changed_while_loading():
    model = small("droq", learning_rate=1e-4, qf_learning_rate=2e-4)
    assert model.qf_learning_rate == 2e-4
    pendulum = gymnasium.make("Pendulum-v1")

    as_saved = DroQ.load(saved(model), env=pendulum)
    changed = DroQ.load(
        saved(model), env=pendulum, learning_rate="lin_3e-4", qf_learning_rate="lin_5e-4"
    )

    assert as_saved.learning_rates() == (1e-4, 2e-4)
    assert changed.learning_rates() == pytest.approx((3e-4, 5e-4))
    changed._current_progress_remaining = 0.5
    assert changed.learning_rates() == pytest.approx((1.5e-4, 2.5e-4))
    assert DroQ.load(saved(changed), env=pendulum).qf_learning_rate == "lin_5e-4"


@pytest.mark.parametrize("held", [None, 2e-4])
def test_the_rate_of_the_critics_is_read_from_older_files(held):
    model = small("droq", learning_rate=1e-4)
    # Beside SBX's number, which was the first one of the other rate.
    model.critic_learning_rate, model.qf_learning_rate = held, 1e-4

    loaded = DroQ.load(saved(model))
    changed = DroQ.load(saved(model), qf_learning_rate=5e-4)

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
    model = small("simba").learn(60)
    assert isinstance(model, SimbaSAC)
    scales = model.policy.learner.seen

    assert float(scales.count) == 60.0
    speeds = model.replay_buffer.next_observations[:60, 0, 2]
    assert float(scales.mean[2]) == pytest.approx(speeds.mean(), rel=1e-3)


@pytest.mark.parametrize("name", ["tqc_jax", "droq"])
def test_networks_of_simba_serve_other_algorithms(name):
    model = small(name, policy="SimbaPolicy").learn(30)

    assert isinstance(model.policy.actor_network.body, SimbaBody)
    assert isinstance(model.policy.critic_network.body, SimbaBody)
    assert float(model.policy.learner.seen.count) == 30.0 and model._n_updates > 0
    assert model.policy.optimizers[0].make is optax.adamw
    assert model.policy.critic_network.body.dropout_rate == (0.01 if name == "droq" else 0.0)


def test_deviations_of_actions_are_squashed_where_the_authors_of_the_algorithm_do_so():
    squashed = lambda name, **how: small(name, **how).policy.actor_network.squash_log_std  # noqa: E731
    told = {"net_arch": [8], "squash_log_std": True}

    assert squashed("simba") and squashed("simba", policy="SimbaPolicy") and squashed("bro")
    assert not squashed("simba", policy=SimbaPolicy)
    for name in ("tqc_jax", "droq"):
        assert not squashed(name, policy="SimbaPolicy")
        assert squashed(name, policy="SimbaPolicy", policy_kwargs=told)
    for name in ("simba", "bro"):
        assert not squashed(name, policy_kwargs=told | {"squash_log_std": False})


def test_state_dependent_noise_of_simba_is_not_squashed():
    model = small("simba", use_sde=True).learn(20)

    assert isinstance(model.policy.actor_network, ExploringActor) and model._n_updates > 0
    # The noise matrix is drawn with e^-3; a squashed logarithm would not be.
    assert model.policy.get_std() == pytest.approx(np.exp(-3.0), rel=0.1)
    with pytest.raises(ValueError, match=r"'squash_log_std': True.*with use_sde=True"):
        small("simba", use_sde=True, policy_kwargs={"squash_log_std": True})


@pytest.mark.parametrize("last", [True, False])
@pytest.mark.parametrize("name", ["gsde_sac", "droq", "tqc_jax", "crossq_jax"])
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
    learner = small(name, policy_kwargs={"net_arch": [16]}).policy.learner

    actor, critics = learner.actor.weights["params"], learner.critic.weights["params"]
    for layer, expected in {"Dense_0": gain, "Dense_1": 1.0}.items():
        np.testing.assert_allclose(np.linalg.svd(actor[layer]["kernel"])[1], expected, atol=1e-5)
    np.testing.assert_allclose(np.linalg.svd(critics["Dense_0"]["kernel"])[1], gain, atol=1e-5)
    exploring = small(name, use_sde=True, policy_kwargs={"net_arch": [16]}).policy.learner.actor
    mean = exploring.weights["params"]["Dense_0"]["kernel"]
    np.testing.assert_allclose(np.linalg.svd(mean)[1], gain, atol=1e-5)


@pytest.mark.parametrize("name", ["simba", "bro"])
def test_networks_that_start_as_in_their_papers_refuse_another_start(name):
    with pytest.raises(ValueError, match=r"'ortho_init': True.*do not use ortho_init"):
        small(name, policy_kwargs={"ortho_init": True})


def of_sbx(params: dict[str, Any]) -> dict[str, Any]:
    """:return: weights of a SimBa network of SBX under the names that they have here"""
    n_blocks = sum(name.startswith("SimbaResidualBlock") for name in params)
    body = {"Dense_0": params["Dense_0"], f"LayerNorm_{n_blocks}": params["LayerNorm_0"]}
    for i in range(n_blocks):
        block = params[f"SimbaResidualBlock_{i}"]
        body |= {f"LayerNorm_{i}": block["LayerNorm_0"]}
        body |= {f"Dense_{2 * i + 1}": block["Dense_0"], f"Dense_{2 * i + 2}": block["Dense_1"]}
    heads = [params[name] for name in ("Dense_1", "Dense_2") if name in params]
    return {"body": body} | {f"Dense_{i}": head for i, head in enumerate(heads)}


def test_simba_with_the_arguments_in_its_docstring_is_that_of_sbx():
    net = {"net_arch": [8, 8], "normalize_observations": False, "squash_log_std": False}
    kwargs = net | {"optimizer_kwargs": {"weight_decay": 1e-4}}
    how = {"ent_coef": "auto", "target_entropy": -1.0, "gradient_steps": 1, "learning_rate": 3e-4}
    how |= {"linear_ent_coef": False}
    ours = SimbaSAC("Pendulum-v1", policy_kwargs=kwargs, buffer_size=10, **how)
    theirs = sbx.SAC(
        "SimbaPolicy", "Pendulum-v1", policy_kwargs={"net_arch": [8, 8]}, buffer_size=10
    )
    rng = np.random.default_rng(0)
    obs, action = rng.normal(size=(5, 3)).astype("f"), rng.uniform(-1.0, 1.0, (5, 1)).astype("f")
    actor, qf = theirs.policy.actor_state, theirs.policy.qf_state
    [critic] = qf.params["params"].values()
    of_actor, of_critic = of_sbx(actor.params["params"]), of_sbx(critic)

    gaussian = ours.policy.recipe.actor.apply({"params": of_actor}, obs)
    values, _ = judge(ours.policy.recipe, {"params": of_critic}, obs, action, jax.random.key(0))

    before_tanh = actor.apply_fn(actor.params, obs).distribution
    np.testing.assert_allclose(gaussian.mean, before_tanh.loc, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(gaussian.std, before_tanh.stddev(), rtol=1e-4)
    np.testing.assert_allclose(values, qf.apply_fn(qf.params, obs, action), rtol=1e-4, atol=1e-6)
    assert ours.knobs() == Knobs(theirs.learning_rate, 3e-4, theirs.tau, theirs.target_entropy)
    assert ours.gradient_steps == theirs.gradient_steps
    [start], entropy = jax.tree.leaves(theirs.ent_coef_state.params), ours.policy.learner
    assert start == entropy.log_ent_coef.weights["params"]
    # A logarithm of 0, times an excess of 3.
    _, loss = theirs.update_temperature(-1.0, theirs.ent_coef_state, 2.0)
    assert loss == 0.0 and not ours.policy.recipe.linear_ent_coef
    assert (
        inspect.signature(theirs.policy.optimizer_class).parameters["weight_decay"].default
        == (dict(ours.policy.optimizers[0].arguments)["weight_decay"])
    )


def test_layers_of_td7_start_as_those_of_torch():
    n = 100  # of each last layer, too: its biases are as many
    env = Constant(spaces.Box(-1, 1, (n,)), spaces.Box(-1, 1, (n,)))
    kwargs = {"net_arch": [n, n], "embedding_size": n, "n_critics": n}
    learner = small("td7", env, policy_kwargs=kwargs).policy.learner
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


def test_td7_does_not_judge_a_policy_by_random_actions():
    model = small("td7", use_checkpoints=True, train_freq=None, learning_starts=250)
    judged = []
    model._assessed = lambda: judged.extend(model._finished) or 0
    model.learn(600)

    # Episodes of 200 steps: the first is random, the second begins so.
    assert judged and {length for _, length in judged} == {200}
    assert len(model._finished) == 1


@pytest.mark.parametrize(
    "arguments",
    [
        {"use_sde": True},
        {"n_steps": 2, "replay_buffer_class": LapReplayBuffer},
        {"optimize_memory_usage": True, "replay_buffer_class": LapReplayBuffer},
    ],
)
@pytest.mark.filterwarnings("ignore:n_steps=2 is ignored")
def test_what_td7_cannot_do_is_refused(arguments):
    with pytest.raises(ValueError, match=next(iter(arguments))):
        TD7("Pendulum-v1", **arguments)


def test_the_optimistic_actor_of_bro_explores_by_gsde_too():
    model = small("bro", use_sde=True, std_multiplier=0.5).learn(20)
    policy, obs = model.policy, np.array([[0.6, 0.8, -1.0], [1.0, 0.0, 3.0]], np.float32)
    learner, recipe = policy.learner, policy.recipe
    gaussian, _ = act(recipe.actor, learner.actor.weights, obs)
    shift = recipe.extra.network.apply(learner.extra["actor"].weights, obs, gaussian.mean)

    explored = policy.scale_action(model.predict(obs)[0])

    apart = gaussian.latent @ policy.matrices[0]
    np.testing.assert_allclose(explored, jnp.tanh(gaussian.mean + shift + 0.5 * apart), atol=1e-5)
    assert np.abs(shift).min() > 1e-6 and np.abs(apart).min() > 1e-4


def test_td7_keeps_its_checkpoint_and_what_that_is_worth_when_networks_start_afresh():
    model = small("td7", use_checkpoints=True, train_freq=None)
    model.policy.keep_checkpoint()
    model.best_worst_return = -150.0
    obs = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, -2.0]], np.float32)
    exploring, kept = (model.predict(obs, deterministic=way)[0] for way in (False, True))

    model._restart(seed=1)

    assert np.abs(model.predict(obs)[0] - exploring).min() > 1e-3
    np.testing.assert_array_equal(model.predict(obs, deterministic=True)[0], kept)
    assert model.best_worst_return == -150.0


def test_td7_takes_no_buffer_without_the_priorities_that_it_draws_by(tmp_path):
    small("droq").learn(20).save_replay_buffer(tmp_path / "buffer")
    model = small("td7").learn(20)
    before = model.replay_buffer

    with pytest.raises(ValueError, match="ReplayBuffer, which has no priorities to draw by"):
        model.load_replay_buffer(tmp_path / "buffer")

    assert model.replay_buffer is before
    uniform = small("td7", replay_buffer_class=ReplayBuffer)
    uniform.load_replay_buffer(tmp_path / "buffer")
    assert uniform.learn(20, reset_num_timesteps=False).replay_buffer.size() == 40


def test_td7_draws_by_priority_where_the_environment_is_normalised():
    env = VecNormalize(DummyVecEnv([lambda: gymnasium.make("Pendulum-v1")]), norm_reward=False)

    model = small("td7", env).learn(30)

    assert model.prioritised and model.replay_buffer.highest > 1.0


def test_td7_judges_policies_by_the_rewards_of_the_environment_itself():
    space = spaces.Box(-1, 1, (3,))
    # Ten steps that earn 1 each; normalised, the same ten earn less and less.
    env = VecNormalize(DummyVecEnv([lambda: Constant(space, spaces.Box(-1, 1, (1,)))]))
    model = small("td7", env, use_checkpoints=True, train_freq=None)
    judged = []
    model._assessed = lambda: judged.extend(model._finished) or 0

    model.learn(60)

    assert {earned for earned, _ in judged} == {10.0}


def test_td7_loaded_with_several_environments_assesses_no_policy(tmp_path):
    model = small("td7", use_checkpoints=None, train_freq=None).learn(10)
    assert model.assesses and model.train_freq.unit.value == "episode"
    model.save(tmp_path / "model")

    loaded = TD7.load(tmp_path / "model", env=make_vec_env("Pendulum-v1", 2))

    assert not loaded.assesses and loaded.learn(40)._n_updates > 0


STATES = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, -2.0]], np.float32)


def actions_of(model) -> tuple[np.ndarray, np.ndarray]:
    """:return: of two states, as the policy is now, and where nothing is explored"""
    exploring, greedy = (
        model.policy.predict(STATES, deterministic=way)[0] for way in (False, True)
    )
    return exploring, greedy


@pytest.mark.parametrize("goes_on", ["counted anew", "saved and loaded"])
def test_an_interrupted_episode_of_td7_is_no_part_of_the_next_one(goes_on):
    # Ten steps that earn 1 each.
    env = Constant(spaces.Box(-1, 1, (3,)), spaces.Box(-1, 1, (1,)))
    model = small("td7", env, use_checkpoints=True, train_freq=None, learning_starts=0)
    model.learn(100, callback=lambda *_: model.num_timesteps < 15)

    if goes_on == "saved and loaded":
        model = TD7.load(saved(model), env=env)
    judged = []
    model._assessed = lambda: judged.extend(model._finished) or 0
    model.learn(10, reset_num_timesteps=goes_on == "counted anew")

    assert judged == [(10.0, 10)]


def test_td7_keeps_no_account_of_episodes_where_it_assesses_no_policy():
    env = Constant(spaces.Box(-1, 1, (3,)), spaces.Box(-1, 1, (1,)))

    assert small("td7", env, use_checkpoints=False).learn(40)._finished == []


def test_td7_trained_with_several_environments_acts_as_it_learned_when_loaded_with_one():
    model = small("td7", make_vec_env("Pendulum-v1", 2), use_checkpoints=None, train_freq=None)
    model.learn(60)
    assert not model.assesses and model._n_updates > 0
    expected, _ = actions_of(model)

    loaded = TD7.load(saved(model), env=gymnasium.make("Pendulum-v1"))

    assert loaded.assesses
    np.testing.assert_array_equal(actions_of(loaded), [expected, expected])
    other = small("td7", use_checkpoints=True, train_freq=None, seed=5)
    other.set_parameters(model.get_parameters())
    np.testing.assert_array_equal(actions_of(other), [expected, expected])


def test_td7_acts_by_its_checkpoint_with_several_environments_until_it_learns_on():
    model = small("td7", use_checkpoints=None, train_freq=None)
    model.policy.keep_checkpoint()
    model.best_worst_return = -150.0
    _, checkpoint = actions_of(model)
    model._restart(seed=1)

    loaded = TD7.load(saved(model), env=make_vec_env("Pendulum-v1", 2))

    exploring, greedy = actions_of(loaded)
    np.testing.assert_array_equal(greedy, checkpoint)
    assert np.abs(exploring - checkpoint).min() > 1e-3
    np.testing.assert_array_equal(*actions_of(loaded.learn(40)))
    assert loaded._n_updates > 0 and loaded.best_worst_return == -np.inf


@pytest.mark.parametrize("was_kept", [True, False])
def test_checkpoints_of_files_without_the_mark_act_if_they_were_worth_something(was_kept):
    model = small("td7", use_checkpoints=True, train_freq=None)
    if was_kept:
        model.policy.keep_checkpoint()
        model.best_worst_return = -150.0
    model._restart(seed=1)
    expected = actions_of(model)
    state_dict = model.policy.state_dict
    model.policy.state_dict = lambda: {
        name: tensor for name, tensor in state_dict().items() if name != "checkpoint.kept"
    }

    loaded = TD7.load(saved(model), env=gymnasium.make("Pendulum-v1"))

    assert loaded.policy.has_checkpoint == was_kept
    np.testing.assert_array_equal(actions_of(loaded), expected)


@pytest.mark.parametrize("n_envs", [1, 2])
def test_what_td7_is_loaded_with_counts(n_envs):
    model = small("td7", make_vec_env("Pendulum-v1", n_envs), use_checkpoints=None, train_freq=None)
    file = saved(model.learn(4))
    one = gymnasium.make("Pendulum-v1")

    loaded = TD7.load(file, env=one, exploration_noise=0.7, train_freq=4)

    np.testing.assert_allclose(loaded.action_noise._sigma, [0.7], rtol=1e-6)
    assert loaded.train_freq.frequency == 4 and loaded.train_freq.unit.value == "step"
    again = TD7.load(saved(loaded), env=one)
    np.testing.assert_allclose(again.action_noise._sigma, [0.7], rtol=1e-6)
    assert again.train_freq == loaded.train_freq
    file.seek(0)
    assert TD7.load(file, env=one).train_freq.unit.value == "episode"


def test_noise_that_td7_was_passed_is_saved():
    noise = NormalActionNoise(np.zeros(1), np.array([0.3]))
    model = small("td7", action_noise=noise)

    loaded = TD7.load(saved(model), exploration_noise=0.7)

    np.testing.assert_array_equal(loaded.action_noise._sigma, [0.3])


def test_uniform_draws_give_td7_the_gradient_of_prioritised_ones():
    model = small("td7")
    prioritised = model.recipe()
    errors = jnp.array([[0.2, 3.0, 5.0, 0.7], [0.9, 1.5, 8.0, 0.1]])
    share = td7_update.priorities_of(prioritised, errors)
    uniform = dataclasses.replace(prioritised, uniform=True)

    slope = jax.grad(partial(td7_update.loss_of, uniform))(errors)

    expected = jnp.clip(errors, -1.0, 1.0) * share / share.sum()
    np.testing.assert_allclose(slope, expected, rtol=1e-6)


def test_a_policy_of_td7_is_kept_only_if_it_did_no_worse():
    model = small("td7", use_checkpoints=True, train_freq=None)
    model._finished, model.best_worst_return = [(-500.0, 200)], -300.0
    before = model.policy.learner.checkpoint
    assert model._assessed() == 200
    assert model.policy.learner.checkpoint is before

    model._finished = [(-100.0, 200)]
    assert model._assessed() == 200
    assert model.best_worst_return == -100.0
    assert model.policy.learner.checkpoint is not before

    model._n_updates = model.updates_before_checkpointing + 1
    model._finished = [(-50.0, 200)]
    assert model._assessed() == 0 and model.assessed_episodes == 1


def test_td7_assesses_by_more_episodes_once_it_has_gone_beyond_the_mark():
    model = small("td7", use_checkpoints=True, train_freq=None, updates_before_checkpointing=400)
    accounts = []
    for n_updates, earned in ((200, -100.0), (400, -100.0), (600, -50.0)):
        model._n_updates, model._finished = n_updates, [(earned, 200)]
        accounts.append((model._assessed(), model.best_worst_return))

    # As in the authors' code: the update that would be the 401st scales the best assessment.
    assert accounts == [(200, -100.0), (200, -90.0), (0, -90.0)]
