"""What model-free algorithms are made of, beside formulas and libraries."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
import torch as th
from cases import each
from gymnasium import spaces
from small_models import small

from sb3_hds.algos.model_free.sac import update as off_policy
from sb3_hds.algos.model_free.sac.networks import Dropout
from sb3_hds.algos.model_free.sac.tqc import (
    all_targets,
    sorted_by_columns,
    sorted_by_rows,
    target_by_target,
)
from sb3_hds.algos.nets.observations import flattener
from sb3_hds.algos.nets.optimizers import optimizer_of


def test_every_processor_sorts_and_compares_quantiles_alike():
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(7, 50)).astype(np.float32)
    rows[3, 4] = np.nan
    for processor in (sorted_by_columns, sorted_by_rows):
        found = np.asarray(processor(jnp.asarray(rows)))
        assert np.isnan(found[3]).all()  # what is no number spoils its row
        np.testing.assert_array_equal(np.delete(found, 3, 0), np.sort(np.delete(rows, 3, 0), -1))

    values, targets = rng.normal(size=(3, 5, 4)), rng.normal(size=(5, 8))
    (losses, slopes), other = (
        compare(jnp.asarray(3.0 * values), jnp.asarray(3.0 * targets))
        for compare in (target_by_target, all_targets)
    )
    np.testing.assert_allclose(losses, other[0], rtol=1e-5)
    np.testing.assert_allclose(slopes, other[1], rtol=1e-5, atol=1e-5)


def test_dropout_zeroes_its_share():
    x, key = jnp.ones((400, 500)), jax.random.key(0)
    zeroed = np.asarray(Dropout(0.1).apply({}, x, rngs={"dropout": key})) == 0.0
    # Six standard deviations of a share of 200,000.
    assert zeroed.mean() == pytest.approx(0.1, abs=6 * np.sqrt(0.09 / x.size))


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


@each(
    (th.optim.Adam, {"betas": (0.8, 0.99), "eps": 1e-5}),
    (th.optim.AdamW, {"weight_decay": 0.1}),
    (th.optim.RMSprop, {"alpha": 0.9, "momentum": 0.5}),
    (th.optim.RAdam, {}),
    (th.optim.SGD, {"momentum": 0.9, "nesterov": True}),
    (th.optim.Adamax, {}),
    (th.optim.Adadelta, {"rho": 0.8}),
    (th.optim.Adagrad, {}),
)
def test_a_torch_class_means_what_it_does_in_torch(make, arguments):
    rng = np.random.default_rng(0)
    # RAdam's rectification begins with the sixth step.
    w, slopes = rng.normal(size=(5, 2)), rng.normal(size=(8, 5, 2))
    theirs = th.nn.Parameter(th.tensor(w))
    torch_optimizer = make([theirs], lr=0.03, **arguments)
    ours = optimizer_of(make, arguments)

    with jax.enable_x64(True):
        trained = ours.train_state({"params": jnp.asarray(w)})
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

    assert optimizer_of(adam, {}).make is adam and optimizer_of(optax.adam, {}).make is optax.adam
    with pytest.raises(ValueError, match="use optimizer_class='adam'"):
        optimizer_of(Adam, {})


def test_no_batch_is_decomposed_at_once():
    """With two in one program, both threads of two could wait for the other one for ever."""
    model = small("bro")
    recipe, n_obs, n_act = (
        getattr(model.policy, each) for each in ("update_config", "n_obs", "n_act")
    )

    program = off_policy.init_state.lower(recipe, n_obs, n_act, 1.0, jax.random.key(0)).as_text()

    shapes = re.findall(r"@lapack_\w+qr\w*\(.*: \(tensor<(\w+)xf32>", program)
    assert shapes and all(shape.count("x") == 1 for shape in shapes)
