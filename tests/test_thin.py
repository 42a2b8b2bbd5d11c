"""Products with thin matrices beside plain ones."""

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import each

from sb3_hds.algos.model_free.sac.networks import Hidden, Last, hidden_product, product

pytestmark = pytest.mark.usefixtures("x64")


def drawn(*shape):
    return jnp.asarray(np.random.default_rng(sum(shape)).normal(size=shape))


def assert_same(ours, theirs):
    jax.tree.map(lambda *both: np.testing.assert_allclose(*both, rtol=1e-12), ours, theirs)


# Where a kernel has few rows, one column, and both.
@each((hidden_product, (3, 2), ()), (hidden_product, (9, 1), (2, 4)), (product, (3, 1), (2, 4)))
def test_a_product_and_its_slopes_are_those_of_any_other_also_in_an_ensemble(thin, shape, batch):
    x, kernel, weight = drawn(*batch, shape[0]), drawn(*shape), drawn(*batch, shape[1])
    worth = lambda of: lambda *given: jnp.sum(weight * jnp.sin(of(*given)))  # noqa: E731
    total = lambda of: lambda *given: jnp.sum(jax.vmap(of, (None, 0))(*given) ** 2)  # noqa: E731

    assert_same(thin(x, kernel), x @ kernel)
    assert_same(*(jax.grad(worth(of), (0, 1))(x, kernel) for of in (thin, jnp.matmul)))
    # Its members share their inputs.
    kernels = drawn(3, *shape)
    assert_same(*(jax.grad(total(of), (0, 1))(x, kernels) for of in (thin, jnp.matmul)))


@pytest.mark.parametrize("layer", [Hidden, Last])
def test_a_layer_is_one_of_flax(layer):
    x, key = drawn(4, 3), jax.random.key(0)
    ours, theirs = layer(1), nn.Dense(1)
    weights = theirs.init(key, x)

    jax.tree.map(np.testing.assert_array_equal, ours.init(key, x), weights)
    assert_same(ours.apply(weights, x), theirs.apply(weights, x))
