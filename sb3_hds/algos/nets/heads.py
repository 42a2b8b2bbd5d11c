r"""
Actors and critics of the SAC family: a network, and what is read off at its end.

The Gaussian before :math:`\tanh`, and its state-dependent exploration, are written as SB3 has them
(:math:`\log(1 - a^2 + 10^{-6})` rather than the limit), so that log-probabilities agree with its
``SquashedDiagGaussianDistribution`` and ``StateDependentNoiseDistribution``.
"""

import math
from typing import NamedTuple

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

from sb3_hds.algos.nets.mlp import Last, product

_EPSILON = 1e-6
_LOG_SQRT_TAU = 0.5 * math.log(2.0 * math.pi)
# Of the logarithm of the deviation of actions: where it is clipped (SAC), and where it is squashed.
_CLIPPED, _SQUASHED = (-20.0, 2.0), (-10.0, 2.0)
#: where last layers start, as flax has them
USUAL = nn.initializers.lecun_normal()


class Gaussian(NamedTuple):
    """
    Of the action before :math:`\tanh`.

    :param mean: shape ``(*batch, act)``
    :param std: its marginal standard deviation, of the same shape
    :param latent: what state-dependent exploration multiplies its noise matrix by, shape
        ``(*batch, latent)``
    """

    mean: Float[Array, "*batch act"]
    std: Float[Array, "*batch act"]
    latent: Float[Array, "*batch latent"]


class GaussianActor(nn.Module):
    r"""
    Maps an observation to a Gaussian whose standard deviation has an output layer of its own.

    :param body: see ``mlp.py``
    :param n_act: number of controls
    :param squash_log_std: whether :math:`\tanh` squashes the logarithm of the deviation into
        [-10, 2], as in ``NormalTanhPolicy`` of the authors' code of SimBa and BRO, so that it
        starts near -4; otherwise, it is clipped to [-20, 2] and starts near 0
    :param of_mean: draws the kernel of the mean
    :param of_std: draws that of the logarithm of the deviation
    """

    body: nn.Module
    n_act: int
    squash_log_std: bool = False
    of_mean: nn.initializers.Initializer = USUAL
    of_std: nn.initializers.Initializer = USUAL

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
    Maps an observation to a Gaussian with the standard deviation of :math:`\theta^T z` over noise
    matrices :math:`\theta` (generalised state-dependent exploration).

    :param body: its output is :math:`z`
    :param n_act: number of controls
    :param log_std_init: where the logarithm of the matrix's standard deviation starts
    :param full_std: whether each pair of feature and control has its own, or each feature
    :param use_expln: see :func:`sb3_hds.algos.nets.heads.exploration_std`
    :param clip_mean: the mean is clipped to this, which helps where :math:`\tanh` saturates; 0: not
    :param of_mean: draws the kernel of the mean
    """

    body: nn.Module
    n_act: int
    log_std_init: float
    full_std: bool
    use_expln: bool
    clip_mean: float
    of_mean: nn.initializers.Initializer = USUAL

    @nn.compact
    def __call__(self, obs: Float[Array, "*batch obs"], train: bool = False) -> Gaussian:
        latent = self.body(obs, train)
        mean = Last(self.n_act, kernel_init=self.of_mean)(latent)
        if self.clip_mean > 0.0:
            mean = jnp.clip(mean, -self.clip_mean, self.clip_mean)
        shape = (latent.shape[-1], self.n_act if self.full_std else 1)
        log_std = self.param("log_std", nn.initializers.constant(self.log_std_init), shape)
        std = exploration_std(log_std, self.use_expln)
        return Gaussian(
            mean, marginal_std(latent, jnp.broadcast_to(std, (shape[0], self.n_act))), latent
        )


class Critic(nn.Module):
    """
    Observation and action to values.

    :param body: see ``mlp.py``
    :param n_values: 1, or the number of quantiles
    :param of_values: draws their kernel
    """

    body: nn.Module
    n_values: int = 1
    of_values: nn.initializers.Initializer = USUAL

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
    :return: standard deviation of the entries of its noise matrix
    """
    log_std = weights["params"]["log_std"]
    wide = jnp.broadcast_to(log_std, (log_std.shape[0], actor.n_act))
    return exploration_std(wide, actor.use_expln)


def squashed_between(
    raw: Float[Array, "*shape"], low: float, high: float
) -> Float[Array, "*shape"]:
    r""":return: :math:`\tanh` of it, moved and scaled from (-1, 1) to those limits"""
    return low + 0.5 * (high - low) * (1.0 + jnp.tanh(raw))


def log_probability(
    gaussian: Gaussian, before: Float[Array, "*batch act"]
) -> Float[Array, "*batch"]:
    """
    :param before: actions before :math:`\tanh`
    :return: log-density of the actions after it
    """
    scaled = (before - gaussian.mean) / gaussian.std
    density = -0.5 * scaled**2 - jnp.log(gaussian.std) - _LOG_SQRT_TAU
    return jnp.sum(density - jnp.log(_tanh_slope(before) + _EPSILON), -1)


def exploration_std(
    log_std: Float[Array, "latent act"], use_expln: bool
) -> Float[Array, "latent act"]:
    r"""
    Standard deviation of the entries of gSDE's noise matrix.

    :param log_std: learned; with one column, it holds for all actions
    :param use_expln: :math:`e^x` for :math:`x \leq 0` and :math:`\log(1 + x + 10^{-6}) + 1` above,
        which grows slower than the exponential

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
    :math:`\sqrt{\sum_i z_i^2 \sigma_{ij}^2 + 10^{-6}}`: how far actions scatter over
    noise matrices.

    Source: Raffin, Kober and Stulp, *Smooth Exploration for Robotic Reinforcement Learning*, CoRL
    2021, equation 6.
    """
    return jnp.sqrt(product(latent**2, std**2) + _EPSILON)


def _tanh_slope(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    r""":math:`1 - \tanh^2 x`, whose digits cancel where :math:`\tanh` is near 1, without that."""
    t = jnp.exp(-2.0 * jnp.abs(x))
    return 4.0 * t / (1.0 + t) ** 2
