r"""
The Gaussian before :math:`\tanh` that actors of the SAC family act by, and its state-dependent
exploration.

Both are written as SB3 has them (:math:`\log(1 - a^2 + 10^{-6})` rather than the limit), so that
log-probabilities agree with its ``SquashedDiagGaussianDistribution`` and
``StateDependentNoiseDistribution``.
"""

import math
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from sb3_hds.algos.nets.dense import product

_EPSILON = 1e-6
_LOG_SQRT_TAU = 0.5 * math.log(2.0 * math.pi)


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
