"""What model-free algorithms are made of, beside formulas and libraries."""

import dataclasses
import re
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
import torch as th
from gymnasium import spaces
from small_models import STATES, small

from sb3_hds.algos import off_policy
from sb3_hds.algos.bodies import Dropout
from sb3_hds.algos.observations import flattener
from sb3_hds.algos.off_policy import Trained, judge
from sb3_hds.algos.optimizers import optimizer_of
from sb3_hds.algos.quantiles import (
    Truncated,
    all_targets,
    quantile_huber,
    sorted_by_columns,
    sorted_by_rows,
    target_by_target,
)

pytestmark = pytest.mark.usefixtures("quick_compilation")


@pytest.mark.parametrize("n_targets", [1, 8])
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


@pytest.mark.parametrize(("n_quantiles", "n_dropped"), [(1, 0), (33, 5)])
def test_the_least_quantiles_stay_and_what_is_no_number_spoils_its_row(n_quantiles, n_dropped):
    values = np.random.default_rng(0).normal(size=(2, 7, n_quantiles)).astype(np.float32)
    values[1] = values[1].round(1)  # some are equal
    values[1, 3, 0] = np.nan

    kept = np.asarray(Truncated(n_dropped)(jnp.asarray(values)))

    assert np.isnan(kept[3]).any() and (np.isnan(kept[3]).all() or not n_dropped)
    pool = np.sort(np.concatenate(list(values), -1), -1)[:, : 2 * (n_quantiles - n_dropped)]
    np.testing.assert_array_equal(np.sort(np.delete(kept, 3, 0), -1), np.delete(pool, 3, 0))
    assert np.isnan(quantile_huber(values, kept))


@pytest.mark.parametrize("processor", [sorted_by_columns, sorted_by_rows])
def test_every_processor_sorts_alike(processor):
    values = np.random.default_rng(0).normal(size=(7, 50)).astype(np.float32)
    values[3, 4] = np.nan

    rows = np.asarray(processor(jnp.asarray(values)))

    assert np.isnan(rows[3]).all()
    np.testing.assert_array_equal(np.delete(rows, 3, 0), np.sort(np.delete(values, 3, 0), -1))


def test_one_critic_is_judged_as_one_of_several():
    policy = small("crossq_jax", policy_kwargs={"n_critics": 1, "net_arch": [4]}).policy
    one, weights = policy.recipe, policy.learner.critic.weights
    action, key = STATES[:, :1], jax.random.key(0)

    def judged(recipe, weights):
        program = jax.jit(partial(judge, recipe, train=True))
        return program(weights, STATES, action, key=key)

    twice = jax.tree.map(lambda x: jnp.concatenate([x, x]), weights)
    pair = judged(dataclasses.replace(one, n_critics=2), twice)

    first = jax.tree.map(lambda x: x[:1], pair)
    near = partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-6)
    jax.tree.map(near, judged(one, weights), first)


def test_dropout_zeroes_its_share():
    x, key = jnp.ones((400, 500)), jax.random.key(0)

    zeroed = np.asarray(Dropout(0.1).apply({}, x, rngs={"dropout": key})) == 0.0

    # Six standard deviations of a share of 200,000, and neighbours are independent.
    assert zeroed.mean() == pytest.approx(0.1, abs=6 * np.sqrt(0.09 / x.size))
    assert (zeroed[:, 1:] & zeroed[:, :-1]).mean() == pytest.approx(0.01, abs=0.002)


def test_choices_become_one_hot_and_dictionaries_one_row():
    space = spaces.Dict(
        box=spaces.Box(-1, 1, (2, 2)),
        choice=spaces.Discrete(3, start=5),
        choices=spaces.MultiDiscrete([2, 3]),
        flags=spaces.MultiBinary(2),
    )
    sample = {name: value[None] for name, value in space.sample().items()}
    sample |= {"choice": np.array([6]), "choices": np.array([[1, 2]])}

    [flat] = flattener(space)(sample)

    assert flat.shape == (spaces.flatdim(space),)
    np.testing.assert_array_equal(flat[4:7], [0, 1, 0])
    np.testing.assert_array_equal(flat[7:12], [0, 1, 0, 0, 1])


@pytest.mark.parametrize(
    ("make", "arguments"),
    [
        (th.optim.Adam, {"betas": (0.8, 0.99), "eps": 1e-5}),
        (th.optim.AdamW, {"weight_decay": 0.1}),
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


DECOMPOSITION = re.compile(r"@lapack_\w+qr\w*\(.*: \(tensor<(\w+)xf32>")


def test_no_batch_is_decomposed_at_once():
    """With two in one program, both threads of two could wait for the other one for ever."""
    model = small("bro")
    recipe, n_obs, n_act = (getattr(model.policy, each) for each in ("recipe", "n_obs", "n_act"))

    program = off_policy.begin.lower(recipe, n_obs, n_act, 1.0, jax.random.key(0)).as_text()

    shapes = DECOMPOSITION.findall(program)
    assert shapes
    assert all(shape.count("x") == 1 for shape in shapes)
