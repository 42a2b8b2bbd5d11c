r"""
Networks of the SAC family: hidden layers, and actors and critics on top of them.

The Gaussian before :math:`\tanh` and gSDE follow SB3's ``SquashedDiagGaussianDistribution`` and
``StateDependentNoiseDistribution`` (:math:`\log(1 - a^2 + 10^{-6})` rather than the limit), so that
log-probabilities agree.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial, reduce
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sb3_hds.algos.nets.options import Activation

_FEW = 8  # inputs up to which a product of hidden layers is summed column by column
_EPSILON = 1e-6
_LOG_SQRT_TAU = 0.5 * math.log(2.0 * math.pi)
# Range of ``log_std``: where it is clipped (SAC), and where it is squashed (SimBa, BRO).
_CLIPPED, _SQUASHED = (-20.0, 2.0), (-10.0, 2.0)
# Limits of BatchRenorm (Ioffe 2017, section 3), and the floor of the variance in SBX's CrossQ.
_R_MAX, _D_MAX, _RENORM_EPSILON = 3.0, 5.0, 1e-3
#: flax's default initialiser of kernels
LECUN_NORMAL = nn.initializers.lecun_normal()


def product(x: Float[Array, "*batch n"], kernel: Float[Array, "n m"]) -> Float[Array, "*batch m"]:
    """:return: ``x @ kernel``; no forward-mode derivative where ``m`` is 1"""
    return _to_one(x, kernel) if kernel.shape[1] == 1 else x @ kernel


def hidden_product(
    x: Float[Array, "*batch n"], kernel: Float[Array, "n m"]
) -> Float[Array, "*batch m"]:
    """
    :return: ``x @ kernel``; with few inputs, XLA may compute it twice with different rounding, so
        it must not be compared with itself, as in the derivative of a maximum
    """
    return _of_few(x, kernel) if kernel.shape[0] <= _FEW else product(x, kernel)


def _dense(product: Callable[[Array, Array], Array]) -> Any:
    return partial(nn.Dense, dot_general=lambda x, kernel, *_, **__: product(x, kernel))


# Dense layers of flax with these products.
Hidden, Last = map(_dense, (hidden_product, product))


def _with_slopes(primal: Callable, slope_of_x: Callable) -> Callable[[Array, Array], Array]:
    """:return: the product of rows and a kernel, with a derivative in reverse mode only"""
    product = jax.custom_vjp(primal)

    def backward(seen: tuple[Array, Array], slope: Array) -> tuple[Array, Array]:
        x, kernel = seen
        rows = [part.reshape(-1, part.shape[-1]) for part in (x, slope)]
        return slope_of_x(slope, kernel), rows[0].T @ rows[1]

    product.defvjp(lambda x, kernel: (product(x, kernel), (x, kernel)), backward)
    return product


def _by_columns(x: Array, kernel: Array) -> Array:
    return reduce(jnp.add, map(jnp.multiply, jnp.split(x, len(kernel), -1), kernel))


_to_one = _with_slopes(lambda x, kernel: x @ kernel, lambda slope, kernel: slope * kernel[:, 0])
_of_few = _with_slopes(_by_columns, lambda slope, kernel: slope @ kernel.T)


def orthogonal(gain: float) -> nn.initializers.Initializer:
    """
    Flax's ``orthogonal``, sequential under ``vmap``: jaxlib 0.10 runs a batch of decompositions in
    the thread pool of the program and waits for them there, a deadlock if all threads wait.

    :param gain: factor on the orthogonal kernel
    """
    draw = nn.initializers.orthogonal(gain)

    def init(key: Array, shape: Sequence[int], dtype: Any = jnp.float32) -> Array:
        return jax.custom_batching.sequential_vmap(lambda key: draw(key, shape, dtype))(key)

    return init


#: orthogonal initialisers with gains of the square root of 2 and of 1
ORTHOGONAL, ORTHONORMAL = orthogonal(math.sqrt(2)), orthogonal(1.0)
_HE = nn.initializers.he_normal()


class Mlp(nn.Module):
    """
    Dense layers with activations and optional dropout, layer norm and batch normalisation.

    :param net_arch: widths of the layers
    :param activation_fn: of each layer
    :param dropout_rate: DroQ's, always on (``train`` concerns batch normalisation); 0: no dropout
    :param layer_norm: DroQ's, after the dropout
    :param renorm_warmup_steps: CrossQ's: updates of plain batch normalisation before batch
        renormalisation; None: neither
    :param momentum: of the running statistics of batch normalisation
    :param ortho_init: whether kernels start orthogonal with a gain of the square root of 2, rather
        than normal with a gain of 1
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
        kernels = ORTHOGONAL if self.ortho_init else LECUN_NORMAL
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
    Residual blocks of layer norm, a layer four times as wide, and one of the block's width.

    Source: Lee et al., *SimBa: Simplicity Bias for Scaling Up Parameters in Deep Reinforcement
    Learning*, ICLR 2025, section 4.

    :param net_arch: width of each block; a dense layer precedes a block of another width; empty:
        the identity
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


class Dropout(nn.Module):
    """
    Zero each entry with probability ``rate`` and scale the others up; always on, as in DroQ, where
    masks make an ensemble of two critics behave like a larger one.

    JAX's counter-based random bits would take half of the time of an update of DroQ. Masks do not
    need their quality: here, two words of the key are mixed with the index of each entry (finaliser
    of MurmurHash3, A. Appleby, public domain).

    :param rate: 0: no dropout
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
    Batch normalisation for ``warmup`` updates, then batch renormalisation: statistics of the batch,
    corrected towards the running ones. Outside training, the running statistics.

    Source: Ioffe, *Batch Renormalization*, NeurIPS 2017, whose limits are relaxed in one step
    instead of slowly, as in CrossQ (Bhatt et al., ICLR 2024).

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


class Gaussian(NamedTuple):
    r"""
    Distribution of the action before :math:`\tanh`.

    :param mean: shape ``(*batch, act)``
    :param std: marginal standard deviation, shape ``(*batch, act)``
    :param latent: features that gSDE multiplies by its noise matrix, shape ``(*batch, latent)``
    """

    mean: Float[Array, "*batch act"]
    std: Float[Array, "*batch act"]
    latent: Float[Array, "*batch latent"]


class GaussianActor(nn.Module):
    r"""
    Map an observation to a Gaussian whose standard deviation has its own output layer.

    :param body: hidden layers, such as :class:`Mlp`
    :param n_act: number of actions
    :param squash_log_std: whether :math:`\tanh` squashes ``log_std`` into [-10, 2], as in
        ``NormalTanhPolicy`` of the authors' code of SimBa and BRO, so that it starts near -4;
        otherwise, it is clipped to [-20, 2] and starts near 0
    :param of_mean: initialiser of the kernel of the mean
    :param of_std: initialiser of the kernel of ``log_std``
    """

    body: nn.Module
    n_act: int
    squash_log_std: bool = False
    of_mean: nn.initializers.Initializer = LECUN_NORMAL
    of_std: nn.initializers.Initializer = LECUN_NORMAL

    @nn.compact
    def __call__(self, obs: Float[Array, "*batch obs"], train: bool = False) -> Gaussian:
        latent = self.body(obs, train)
        mean = Last(self.n_act, kernel_init=self.of_mean)(latent)
        raw = Last(self.n_act, kernel_init=self.of_std)(latent)
        if self.squash_log_std:
            log_std = squashed_between(raw, *_SQUASHED)
        else:
            log_std = jnp.clip(raw, *_CLIPPED)
        return Gaussian(mean, jnp.exp(log_std), latent)


class ExploringActor(nn.Module):
    r"""
    Map an observation to a Gaussian with the standard deviation of :math:`\theta^T z` over noise
    matrices :math:`\theta` (generalised state-dependent exploration).

    :param body: hidden layers, whose output is :math:`z`
    :param n_act: number of actions
    :param log_std_init: initial ``log_std`` of the noise matrix
    :param full_std: one ``log_std`` per feature and action instead of one per feature
    :param use_expln: see :func:`exploration_std`
    :param clip_mean: limit of the mean, which helps where :math:`\tanh` saturates; 0: no limit
    :param of_mean: initialiser of the kernel of the mean
    """

    body: nn.Module
    n_act: int
    log_std_init: float
    full_std: bool
    use_expln: bool
    clip_mean: float
    of_mean: nn.initializers.Initializer = LECUN_NORMAL

    @nn.compact
    def __call__(self, obs: Float[Array, "*batch obs"], train: bool = False) -> Gaussian:
        latent = self.body(obs, train)
        mean = Last(self.n_act, kernel_init=self.of_mean)(latent)
        if self.clip_mean > 0.0:
            mean = jnp.clip(mean, -self.clip_mean, self.clip_mean)
        shape = (latent.shape[-1], self.n_act if self.full_std else 1)
        log_std = self.param("log_std", nn.initializers.constant(self.log_std_init), shape)
        std = jnp.broadcast_to(exploration_std(log_std, self.use_expln), (shape[0], self.n_act))
        return Gaussian(mean, marginal_std(latent, std), latent)


class Critic(nn.Module):
    """
    Map observation and action to values.

    :param body: hidden layers, such as :class:`Mlp`
    :param n_values: 1, or the number of quantiles
    :param of_values: initialiser of the last kernel
    """

    body: nn.Module
    n_values: int = 1
    of_values: nn.initializers.Initializer = LECUN_NORMAL

    @nn.compact
    def __call__(
        self,
        obs: Float[Array, "*batch obs"],
        action: Float[Array, "*batch act"],
        train: bool = False,
    ) -> Float[Array, "*batch values"]:
        latent = self.body(jnp.concatenate([obs, action], -1), train)
        return Last(self.n_values, kernel_init=self.of_values)(latent)


def noise_std(actor: ExploringActor, weights: dict) -> Float[Array, "latent act"]:
    """
    :param weights: of the actor
    :return: standard deviation of each entry of its noise matrix
    """
    log_std = weights["params"]["log_std"]
    wide = jnp.broadcast_to(log_std, (log_std.shape[0], actor.n_act))
    return exploration_std(wide, actor.use_expln)


def squashed_between(
    raw: Float[Array, "*shape"], low: float, high: float
) -> Float[Array, "*shape"]:
    r""":return: :math:`\tanh` of ``raw``, scaled from (-1, 1) to the limits"""
    return low + 0.5 * (high - low) * (1.0 + jnp.tanh(raw))


def log_probability(
    gaussian: Gaussian, before: Float[Array, "*batch act"]
) -> Float[Array, "*batch"]:
    r"""
    :param before: actions before :math:`\tanh`
    :return: log-density of the actions after :math:`\tanh`
    """
    scaled = (before - gaussian.mean) / gaussian.std
    density = -0.5 * scaled**2 - jnp.log(gaussian.std) - _LOG_SQRT_TAU
    return jnp.sum(density - jnp.log(_tanh_slope(before) + _EPSILON), -1)


def exploration_std(
    log_std: Float[Array, "latent act"], use_expln: bool
) -> Float[Array, "latent act"]:
    r"""
    Standard deviation of the entries of gSDE's noise matrix.

    :param log_std: learned; a single column holds for all actions
    :param use_expln: :math:`e^x` for :math:`x \leq 0` and :math:`\log(1 + x + 10^{-6}) + 1` above,
        which grows more slowly than the exponential

    Source: Rueckstiess et al., *State-dependent exploration for policy gradient methods*, 2008.
    """
    if not use_expln:
        return jnp.exp(log_std)
    above = jnp.where(log_std > 0.0, log_std, 0.0) + _EPSILON
    return jnp.where(log_std > 0.0, jnp.log1p(above) + 1.0, jnp.exp(jnp.minimum(log_std, 0.0)))


def marginal_std(
    latent: Float[Array, "*batch latent"], std: Float[Array, "latent act"]
) -> Float[Array, "*batch act"]:
    r"""
    :math:`\sqrt{\sum_i z_i^2 \sigma_{ij}^2 + 10^{-6}}`: standard deviation of actions over noise
    matrices.

    Source: Raffin, Kober and Stulp, *Smooth Exploration for Robotic Reinforcement Learning*, CoRL
    2021, equation 6.
    """
    return jnp.sqrt(product(latent**2, std**2) + _EPSILON)


def _tanh_slope(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    r""":return: :math:`1 - \tanh^2 x`, without cancellation where :math:`\tanh` is near 1"""
    t = jnp.exp(-2.0 * jnp.abs(x))
    return 4.0 * t / (1.0 + t) ** 2
