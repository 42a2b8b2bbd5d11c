"""Actors and critics of the SAC family: a body, and what is read off at its end."""

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

from sb3_hds.algos.nets.dense import Last
from sb3_hds.algos.nets.squashed import Gaussian, exploration_std, marginal_std, squashed_between

# Of the logarithm of the deviation of actions: where it is clipped (SAC), and where it is squashed.
_CLIPPED, _SQUASHED = (-20.0, 2.0), (-10.0, 2.0)
#: where last layers start, as flax has them
USUAL = nn.initializers.lecun_normal()


class GaussianActor(nn.Module):
    r"""
    Observation to a Gaussian whose spread is a layer of its own.

    :param body: see ``bodies.py``
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
    Observation to a Gaussian whose spread is that of :math:`\theta^T z` over noise matrices
    :math:`\theta` (generalised state-dependent exploration).

    :param body: its output is :math:`z`
    :param n_act: number of controls
    :param log_std_init: where the logarithm of the matrix's standard deviation starts
    :param full_std: whether each pair of feature and control has its own, or each feature
    :param use_expln: see :func:`sb3_hds.algos.nets.squashed.exploration_std`
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

    :param body: see ``bodies.py``
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
