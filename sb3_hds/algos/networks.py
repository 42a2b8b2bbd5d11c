"""Policy and value networks of the algorithms that learn through a twin."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, cast

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

Activation = Callable[[jax.Array], jax.Array]

ACTIVATIONS: dict[str, Activation] = {
    "tanh": nn.tanh,
    "relu": nn.relu,
    "elu": nn.elu,
    "gelu": nn.gelu,
    "silu": nn.silu,
    "leaky_relu": nn.leaky_relu,
    "softplus": nn.softplus,
}

# Width around zero where the value is linear rather than a square root, in units of the scaled
# reward.
_NEAR_ZERO = 0.3
# Uniform rather than normal: half a second less to compile. Small in a last layer, so that a
# network starts near zero.
_HIDDEN = nn.initializers.variance_scaling(1.0, "fan_in", "uniform")
_SMALL = nn.initializers.variance_scaling(1e-4, "fan_in", "uniform")


def activation(choice: str | Activation | type) -> Activation:
    """
    :param choice: a name ("relu", any case), a JAX function, or a torch module class of the same
        name
    :raises ValueError: for a name without an equal here
    """
    name = choice if isinstance(choice, str) else getattr(choice, "__name__", "")
    known = {key.replace("_", ""): function for key, function in ACTIVATIONS.items()}
    found = known.get(name.lower().replace("_", ""))
    if found is not None:
        return found
    if isinstance(choice, str | type) or not callable(choice):
        raise ValueError(
            f"activation_fn must be one of {', '.join(ACTIVATIONS)}, or a JAX function, "
            f"got {choice!r}."
        )
    return choice


class Actor(nn.Module):
    """
    Observation to control in (-1, 1), with a small last layer, so that it starts near zero.

    :param n_act: number of controls
    :param net_arch: widths of the hidden layers
    :param activation_fn: between the layers
    """

    n_act: int
    net_arch: Sequence[int]
    activation_fn: Activation

    @nn.compact
    def __call__(self, obs: Float[Array, "*batch obs"]) -> Float[Array, "*batch act"]:
        hidden = _mlp(obs, self.net_arch, self.activation_fn)
        return jnp.tanh(nn.Dense(self.n_act, kernel_init=_SMALL)(hidden))


class Value(nn.Module):
    """
    Observation to the signed square root of the value, see :func:`unsquash`.

    :param net_arch: widths of the hidden layers
    :param activation_fn: between the layers
    """

    net_arch: Sequence[int]
    activation_fn: Activation

    @nn.compact
    def __call__(self, obs: Float[Array, "*batch obs"]) -> Float[Array, "*batch"]:
        hidden = _mlp(obs, self.net_arch, self.activation_fn)
        return nn.Dense(1, kernel_init=_SMALL)(hidden)[..., 0]


def output(network: Actor | Value, weights: Mapping[str, Any], obs: jax.Array) -> jax.Array:
    """:return: what a network puts out for one observation or a batch"""
    return cast(jax.Array, network.apply(weights, obs))


def with_input_scales(weights: Mapping[str, Any], old: Any, new: Any) -> Mapping[str, Any]:
    """
    :param weights: of an ``Actor`` or ``Value`` whose input is ``(obs - old.mean) / old.scale``
    :param new: mean and scale from now on, each of shape ``(n_obs,)``
    :return: weights that compute the same of ``(obs - new.mean) / new.scale``
    """
    layers = dict(weights["params"])
    kernel, bias = layers["Dense_0"]["kernel"], layers["Dense_0"]["bias"]
    layers["Dense_0"] = {
        "kernel": kernel * (new.scale / old.scale)[:, None],
        "bias": bias + ((new.mean - old.mean) / old.scale) @ kernel,
    }
    return {**weights, "params": layers}


def squash(value: jax.Array) -> jax.Array:
    r"""
    The root that the value network learns: :math:`y\,(|y| + 0.3) = V`.

    A network that learns V itself errs by a share of its range, which near the goal is more than
    all that is left to gain; the root has relative precision there.
    """
    return jnp.sign(value) * (jnp.sqrt(_NEAR_ZERO**2 + 4.0 * jnp.abs(value)) - _NEAR_ZERO) / 2.0


def unsquash(root: jax.Array) -> jax.Array:
    """:return: the value for what the network puts out; the inverse of :func:`squash`"""
    return root * (jnp.abs(root) + _NEAR_ZERO)


def _mlp(x: jax.Array, net_arch: Sequence[int], activation_fn: Activation) -> jax.Array:
    for width in net_arch:
        x = activation_fn(nn.Dense(width, kernel_init=_HIDDEN)(x))
    return x
