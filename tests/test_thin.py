"""Products with thin matrices beside plain ones."""

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sb3_hds.algos.thin import Hidden, Last, hidden_product, product

pytestmark = pytest.mark.usefixtures("x64", "quick_compilation")

SHAPES = [(n, m) for n in (1, 3, 9) for m in (1, 2)]
BATCHES = [(), (2, 4)]


def drawn(*shape: int) -> jax.Array:
    return jnp.asarray(np.random.default_rng(sum(shape)).normal(size=shape))


def plain(x: jax.Array, kernel: jax.Array) -> jax.Array:
    return jnp.einsum("...n,nm->...m", x, kernel)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("batch", BATCHES)
@pytest.mark.parametrize("thin", [product, hidden_product])
def test_a_product_and_its_slopes_are_those_of_any_other(thin, shape, batch):
    x, kernel = drawn(*batch, shape[0]), drawn(*shape)
    weight = drawn(*batch, shape[1])
    worth = lambda of: lambda x, kernel: jnp.sum(weight * jnp.sin(of(x, kernel)))  # noqa: E731
    np.testing.assert_allclose(thin(x, kernel), plain(x, kernel), rtol=1e-12)
    slopes = [jax.grad(worth(of), (0, 1))(x, kernel) for of in (thin, plain)]
    jax.tree.map(lambda *both: np.testing.assert_allclose(*both, rtol=1e-12), *slopes)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("thin", [product, hidden_product])
def test_an_ensemble_may_share_its_inputs(thin, shape):
    x, kernels = drawn(4, shape[0]), drawn(3, *shape)

    def slopes(of):
        total = lambda x, kernels: jnp.sum(jax.vmap(of, (None, 0))(x, kernels) ** 2)  # noqa: E731
        return jax.grad(total, (0, 1))(x, kernels)

    jax.tree.map(
        lambda *both: np.testing.assert_allclose(*both, rtol=1e-12), slopes(thin), slopes(plain)
    )


@pytest.mark.parametrize("layer", [Hidden, Last])
def test_a_layer_is_one_of_flax(layer):
    x, key = drawn(4, 3), jax.random.key(0)
    ours, theirs = layer(1), nn.Dense(1)
    weights = theirs.init(key, x)
    jax.tree.map(np.testing.assert_array_equal, ours.init(key, x), weights)
    np.testing.assert_allclose(ours.apply(weights, x), theirs.apply(weights, x), rtol=1e-12)
