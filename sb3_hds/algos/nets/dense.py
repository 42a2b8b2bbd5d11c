"""
Products with thin matrices.

Networks that control robots have few inputs, and critics have one output. XLA gives products of
such matrices to the kernels of large ones, and their slopes too; written out, they become part of
the loops over the activations around them.
"""

from collections.abc import Callable
from functools import partial, reduce
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

_FEW = 8


def product(x: Float[Array, "*batch n"], kernel: Float[Array, "n m"]) -> Float[Array, "*batch m"]:
    """:return: ``x @ kernel``, without a derivative in forward mode where ``m`` is 1"""
    return _to_one(x, kernel) if kernel.shape[1] == 1 else x @ kernel


def hidden_product(
    x: Float[Array, "*batch n"], kernel: Float[Array, "n m"]
) -> Float[Array, "*batch m"]:
    """
    :return: the same; of few inputs, it may be computed more than once, and rounded otherwise, so
        that it must not be compared with itself (the slope of a maximum is)
    """
    return _of_few(x, kernel) if kernel.shape[0] <= _FEW else product(x, kernel)


def _dense(product: Callable[[Array, Array], Array]) -> type[nn.Dense]:
    def dot_general(x: Array, kernel: Array, _: Any, precision: Any = None) -> Array:
        return product(x, kernel)

    layer: Any = partial(nn.Dense, dot_general=dot_general)
    return layer


# Layers of flax, with these.
Hidden, Last = map(_dense, (hidden_product, product))


@jax.custom_vjp
def _to_one(x: Array, kernel: Array) -> Array:
    return x @ kernel


@jax.custom_vjp
def _of_few(x: Array, kernel: Array) -> Array:
    columns = jnp.split(x, len(kernel), -1)
    return reduce(jnp.add, map(jnp.multiply, columns, kernel))


def _to_one_back(seen: tuple[Array, Array], slope: Array) -> tuple[Array, Array]:
    x, kernel = seen
    return slope * kernel[:, 0], _of_kernel(x, slope)


def _of_few_back(seen: tuple[Array, Array], slope: Array) -> tuple[Array, Array]:
    x, kernel = seen
    return slope @ kernel.T, _of_kernel(x, slope)


def _of_kernel(x: Array, slope: Array) -> Array:
    rows = [part.reshape(-1, part.shape[-1]) for part in (x, slope)]
    return rows[0].T @ rows[1]


_to_one.defvjp(lambda x, kernel: (_to_one(x, kernel), (x, kernel)), _to_one_back)
_of_few.defvjp(lambda x, kernel: (_of_few(x, kernel), (x, kernel)), _of_few_back)
