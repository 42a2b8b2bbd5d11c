"""What lies between the input of an actor or a critic and its last layer."""

import math
from collections.abc import Callable, Sequence
from functools import partial, reduce
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sb3_hds.algos.nets.options import Activation

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


def orthogonal(gain: float) -> nn.initializers.Initializer:
    """
    Flax's ``orthogonal``, one kernel after the other under ``vmap``: jaxlib 0.10 hands the
    decompositions of a batch to the pool that runs the program and waits for them there, and a
    program in which as many wait as the pool has threads never ends.

    :param gain: what an orthogonal kernel is multiplied by
    """
    draw = nn.initializers.orthogonal(gain)

    def init(key: Array, shape: Sequence[int], dtype: Any = jnp.float32) -> Array:
        return jax.custom_batching.sequential_vmap(lambda key: draw(key, shape, dtype))(key)

    return init


#: where kernels start, with gains of the square root of 2 and of 1
ORTHOGONAL, ORTHONORMAL = orthogonal(math.sqrt(2)), orthogonal(1.0)
_HE = nn.initializers.he_normal()
# BatchRenorm's limits (Ioffe 2017, section 3), and the variance's floor in SBX's CrossQ.
_R_MAX, _D_MAX, _RENORM_EPSILON = 3.0, 5.0, 1e-3


class Mlp(nn.Module):
    """
    Dense layers, each followed by dropout, layer norm or batch renormalisation as asked, and the
    activation.

    :param net_arch: their widths
    :param activation_fn: after each
    :param dropout_rate: DroQ's; 0: none
    :param layer_norm: DroQ's, after the dropout
    :param renorm_warmup_steps: CrossQ's: updates of plain batch normalisation before batch
        renormalisation; None: neither of them
    :param momentum: of its running statistics
    :param ortho_init: whether kernels start orthogonal, with a gain of the square root of 2, rather
        than normal, with a gain of 1
    """

    net_arch: Sequence[int]
    activation_fn: Activation
    dropout_rate: float = 0.0
    layer_norm: bool = False
    renorm_warmup_steps: int | None = None
    momentum: float = 0.99
    ortho_init: bool = False

    @nn.compact
    def __call__(self, x: Float[Array, "*batch n"], train: bool) -> Float[Array, "*batch m"]:
        kernels = ORTHOGONAL if self.ortho_init else nn.initializers.lecun_normal()
        if self.renorm_warmup_steps is not None:
            x = BatchRenorm(self.renorm_warmup_steps, self.momentum)(x, train)
        for width in self.net_arch:
            x = Hidden(width, kernel_init=kernels)(x)
            x = Dropout(self.dropout_rate)(x)
            x = nn.LayerNorm()(x) if self.layer_norm else x
            x = self.activation_fn(x)
            if self.renorm_warmup_steps is not None:
                x = BatchRenorm(self.renorm_warmup_steps, self.momentum)(x, train)
        return x


class SimbaNet(nn.Module):
    """
    Residual blocks on a linear path: layer norm, a layer four times as wide, and back.

    Source: Lee et al., *SimBa: Simplicity Bias for Scaling Up Parameters in Deep Reinforcement
    Learning*, ICLR 2025, section 4.

    :param net_arch: width of each block; where it changes, a dense layer leads to the next; none:
        the input itself
    :param activation_fn: inside a block
    :param dropout_rate: after each block, as in SBX
    """

    net_arch: Sequence[int]
    activation_fn: Activation
    dropout_rate: float = 0.0

    @nn.compact
    def __call__(self, x: Float[Array, "*batch n"], train: bool) -> Float[Array, "*batch m"]:
        for i, width in enumerate(self.net_arch):
            if i == 0 or x.shape[-1] != width:
                x = Hidden(width, kernel_init=ORTHONORMAL)(x)
            inside = Hidden(4 * width, kernel_init=_HE)(nn.LayerNorm()(x))
            x = x + Hidden(width, kernel_init=_HE)(self.activation_fn(inside))
            x = Dropout(self.dropout_rate)(x)
        return nn.LayerNorm()(x) if self.net_arch else x


class BroNet(nn.Module):
    """
    Residual blocks with layer norm after each dense layer.

    Source: Nauman et al., *Bigger, Regularized, Optimistic: scaling for compute and
    sample-efficient continuous control*, NeurIPS 2024, section 3 (BroNet).

    :param net_arch: width of each block; where it changes, a dense layer leads to the next; none:
        the input itself
    :param activation_fn: between the layers
    """

    net_arch: Sequence[int]
    activation_fn: Activation

    @nn.compact
    def __call__(self, x: Float[Array, "*batch n"], train: bool) -> Float[Array, "*batch m"]:
        dense = lambda width: Hidden(width, kernel_init=ORTHOGONAL)  # noqa: E731
        for i, width in enumerate(self.net_arch):
            if i == 0 or x.shape[-1] != width:
                x = self.activation_fn(nn.LayerNorm()(dense(width)(x)))
            inside = self.activation_fn(nn.LayerNorm()(dense(width)(x)))
            x = x + nn.LayerNorm()(dense(width)(inside))
        return x


class Dropout(nn.Module):
    """
    Zeroes each entry with the probability ``rate`` and scales the others up; always on, as in
    DroQ, where the mask is what makes an ensemble of two critics behave like one of many.

    Half of an update of DroQ is spent on JAX's counter-based random bits. Masks need no such
    quality: here, two words of the key are mixed with each entry's index (the finaliser of
    MurmurHash3, A. Appleby, public domain).

    :param rate: 0: nothing is zeroed
    """

    rate: float

    @nn.compact
    def __call__(self, x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        if not self.rate or self.is_initializing():
            return x
        seed = jax.random.bits(self.make_rng("dropout"), (2,), jnp.uint32)
        index = jnp.arange(math.prod(x.shape), dtype=jnp.uint32).reshape(x.shape)
        threshold = jnp.uint32(min(round(self.rate * 2.0**32), 2**32 - 1))
        keep = _mixed(_mixed(index ^ seed[0]) + seed[1]) >= threshold
        return jnp.where(keep, x / (1.0 - self.rate), 0.0)


class BatchRenorm(nn.Module):
    """
    Batch normalisation for ``warmup`` updates, then batch renormalisation: by the batch, corrected
    towards the running statistics. Where not training, by the running statistics.

    Source: Ioffe, *Batch Renormalization*, NeurIPS 2017; with a step in the place of the slow
    relaxation of its limits, as CrossQ (Bhatt et al., ICLR 2024) has it.

    :param warmup: updates of plain batch normalisation
    :param momentum: of the running statistics
    """

    warmup: int
    momentum: float

    @nn.compact
    def __call__(self, x: Float[Array, "*batch n"], train: bool) -> Float[Array, "*batch n"]:
        n = x.shape[-1]
        mean = self.variable("statistics", "mean", jnp.zeros, n)
        variance = self.variable("statistics", "var", jnp.ones, n)
        steps = self.variable("statistics", "steps", jnp.zeros, ())
        scale = self.param("scale", nn.initializers.ones, (n,))
        bias = self.param("bias", nn.initializers.zeros, (n,))
        running = jnp.sqrt(variance.value + _RENORM_EPSILON)
        if not train or self.is_initializing():
            return (x - mean.value) * (scale / running) + bias
        axes = tuple(range(x.ndim - 1))
        now_mean = x.mean(axes)
        centred = x - now_mean
        now_var = (centred**2).mean(axes)
        now = jnp.sqrt(now_var + _RENORM_EPSILON)
        r = jnp.clip(jax.lax.stop_gradient(now / running), 1.0 / _R_MAX, _R_MAX)
        d = jnp.clip(jax.lax.stop_gradient((now_mean - mean.value) / running), -_D_MAX, _D_MAX)
        warm = steps.value >= self.warmup
        r, d = jnp.where(warm, r, 1.0), jnp.where(warm, d, 0.0)
        for held, value in ((mean, now_mean), (variance, now_var)):
            held.value = self.momentum * held.value + (1.0 - self.momentum) * value
        steps.value = steps.value + 1
        return centred * (r / now * scale) + (d * scale + bias)


def _mixed(word: jax.Array) -> jax.Array:
    word = (word ^ (word >> 16)) * jnp.uint32(0x85EBCA6B)
    word = (word ^ (word >> 13)) * jnp.uint32(0xC2B2AE35)
    return word ^ (word >> 16)
