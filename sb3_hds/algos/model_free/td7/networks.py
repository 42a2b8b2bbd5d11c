"""
Networks of TD7: embeddings of states and actions, and actor and critics on top of them.

Source: Fujimoto et al., *For SALE: State-Action Representation Learning for Deep Reinforcement
Learning*, NeurIPS 2023.
"""

import math
from collections.abc import Sequence
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from sb3_hds.algos.nets.options import Activation

_EPSILON = 1e-8
# Uniform, of variance 1 / (3 n) with n inputs.
_KERNELS = nn.initializers.variance_scaling(1.0 / 3.0, "fan_in", "uniform")


def average_l1_norm(x: Float[Array, "*batch n"]) -> Float[Array, "*batch n"]:
    """:return: ``x``, scaled to a mean absolute value of 1 (section 4.1 of the paper)"""
    return x / jnp.maximum(jnp.mean(jnp.abs(x), -1, keepdims=True), _EPSILON)


class Encoder(nn.Module):
    """
    Map the state to its embedding :math:`z^s`, and :math:`z^s` and the action to :math:`z^{sa}`, a
    prediction of the next state's embedding.

    :param n: size of the embeddings
    :param net_arch: hidden widths
    :param activation_fn: between the layers
    """

    n: int
    net_arch: Sequence[int]
    activation_fn: Activation

    def setup(self) -> None:
        # Flax derives initial weights from these names: a seed's networks depend on them.
        self.of_state = _Dense((*self.net_arch, self.n), self.activation_fn)
        self.of_both = _Dense((*self.net_arch, self.n), self.activation_fn)

    def __call__(self, obs: Array, action: Array) -> tuple[Array, Array]:
        zs = average_l1_norm(self.of_state(obs))
        return zs, self.of_both(jnp.concatenate([zs, action], -1))


class Actor(nn.Module):
    """
    Map an observation and its embedding to an action.

    :param n_act: number of actions
    :param net_arch: hidden widths; the embedding is concatenated after the first layer
    :param activation_fn: between the layers
    """

    n_act: int
    net_arch: Sequence[int]
    activation_fn: Activation

    @nn.compact
    def __call__(
        self, obs: Float[Array, "*batch obs"], zs: Float[Array, "*batch z"]
    ) -> Float[Array, "*batch act"]:
        own = average_l1_norm(_first(obs, self.net_arch))
        hidden = _Dense((*self.net_arch, self.n_act), self.activation_fn)
        return jnp.tanh(hidden(jnp.concatenate([own, zs], -1)))


class Critic(nn.Module):
    """
    Map observation, action and both embeddings to a value.

    :param net_arch: hidden widths; the embeddings are concatenated after the first layer
    :param activation_fn: between the layers
    """

    net_arch: Sequence[int]
    activation_fn: Activation

    @nn.compact
    def __call__(
        self,
        obs: Float[Array, "*batch obs"],
        action: Float[Array, "*batch act"],
        zsa: Float[Array, "*batch z"],
        zs: Float[Array, "*batch z"],
    ) -> Float[Array, "*batch"]:
        own = _first(jnp.concatenate([obs, action], -1), self.net_arch)
        hidden = _Dense((*self.net_arch, 1), self.activation_fn)
        return hidden(jnp.concatenate([average_l1_norm(own), zsa, zs], -1))[..., 0]


def _first(x: Array, net_arch: Sequence[int]) -> Array:
    """A layer of the first width; the identity without hidden layers."""
    return _linear(x, net_arch[0]) if net_arch else x


class _Dense(nn.Module):
    """Layers of these widths, the last one linear."""

    sizes: Sequence[int]
    activation_fn: Activation

    @nn.compact
    def __call__(self, x: Array) -> Array:
        for size in self.sizes[:-1]:
            x = self.activation_fn(_linear(x, size))
        return _linear(x, self.sizes[-1])


def _linear(x: Array, size: int) -> Array:
    r"""
    A layer with the initial values of torch's ``Linear``: weights and biases uniform within
    :math:`\pm 1 / \sqrt{n}` for :math:`n` inputs.
    """
    limit = 1.0 / math.sqrt(x.shape[-1])

    def biases(key: PRNGKeyArray, shape: Sequence[int], dtype: Any) -> Array:
        return jax.random.uniform(key, shape, dtype, -limit, limit)

    return nn.Dense(size, kernel_init=_KERNELS, bias_init=biases)(x)
