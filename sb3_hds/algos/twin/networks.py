"""Policy and value networks of the algorithms that learn through a twin."""

from collections.abc import Mapping, Sequence
from typing import Any, cast

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sb3_hds.algos.nets.options import Activation

# Scale of the value below which its root is linear, in units of the scaled reward.
_NEAR_ZERO = 0.3
# Number of squares in the value.
_N_SQUARES = 8
# Uniform rather than normal saves half a second of compilation. Small in last layers, so that
# networks start near zero.
_HIDDEN = nn.initializers.variance_scaling(1.0, "fan_in", "uniform")
_SMALL = nn.initializers.variance_scaling(1e-4, "fan_in", "uniform")


class Actor(nn.Module):
    """
    Map an observation to a control in (-1, 1), near zero at first.

    :param n_act: number of controls
    :param net_arch: widths of the hidden layers
    :param activation_fn: between the layers
    :param linear_path: whether a linear map from input to output is added: near a balance, the best
        control is linear in the state, which hidden layers learn slowly
    """

    n_act: int
    net_arch: Sequence[int]
    activation_fn: Activation
    linear_path: bool = True

    @nn.compact
    def __call__(self, obs: Float[Array, "*batch obs"]) -> Float[Array, "*batch act"]:
        hidden = _mlp(obs, self.net_arch, self.activation_fn)
        control = nn.Dense(self.n_act, kernel_init=_SMALL, name="last")(hidden)
        if self.linear_path:
            control += nn.Dense(self.n_act, False, kernel_init=_SMALL, name="linear")(obs)
        return jnp.tanh(control)


class Value(nn.Module):
    r"""
    Map an observation to roots :math:`\rho` of the value, see :func:`value_of`.

    :param net_arch: widths of the hidden layers
    :param activation_fn: between the layers
    """

    net_arch: Sequence[int]
    activation_fn: Activation

    @nn.compact
    def __call__(self, obs: Float[Array, "*batch obs"]) -> Float[Array, "*batch roots"]:
        hidden = _mlp(obs, self.net_arch, self.activation_fn)
        return nn.Dense(1 + _N_SQUARES, kernel_init=_SMALL)(hidden)


def output(network: Actor | Value, weights: Mapping[str, Any], obs: jax.Array) -> jax.Array:
    """:return: output of a network for one observation or a batch"""
    return cast(jax.Array, network.apply(weights, obs))


def with_input_scales(weights: Mapping[str, Any], old: Any, new: Any) -> Mapping[str, Any]:
    """
    :param weights: of an ``Actor`` or ``Value`` whose input is ``(obs - old.mean) / old.scale``
    :param new: mean and scale of the new input, each of shape ``(n_obs,)``
    :return: weights of the same function of the input ``(obs - new.mean) / new.scale``
    """
    layers = dict(weights["params"])
    first = "Dense_0" if "Dense_0" in layers else "last"
    kernel, bias = layers[first]["kernel"], layers[first]["bias"]
    layers[first] = {
        "kernel": kernel * (new.scale / old.scale)[:, None],
        "bias": bias + ((new.mean - old.mean) / old.scale) @ kernel,
    }
    if "linear" in layers:
        slope, last = layers["linear"]["kernel"], layers["last"]
        layers["linear"] = {"kernel": slope * (new.scale / old.scale)[:, None]}
        bias = last["bias"] + ((new.mean - old.mean) / old.scale) @ slope
        layers["last"] = {"kernel": last["kernel"], "bias": bias}
    return {**weights, "params": layers}


def value_of(roots: Float[Array, "*batch roots"]) -> Float[Array, "*batch"]:
    r"""
    :math:`V = u(\rho_0) - \sum_{i \geq 1} \rho_i^2`, with :func:`unsquash` for :math:`u`.

    Near a goal the value is minus a quadratic form. Squares represent it exactly, and their slopes
    give its curvature.
    """
    return unsquash(roots[..., 0]) - jnp.sum(roots[..., 1:] ** 2, -1)


def squash(value: jax.Array) -> jax.Array:
    r"""
    The root :math:`y` that the value network learns: :math:`y\,(|y| + 0.3) = V`.

    The error of a network is a share of its range. For V itself, that exceeds the remaining gain
    near the goal; the root has relative precision there.
    """
    return jnp.sign(value) * (jnp.sqrt(_NEAR_ZERO**2 + 4.0 * jnp.abs(value)) - _NEAR_ZERO) / 2.0


def unsquash(root: jax.Array) -> jax.Array:
    """:return: the value of a root; the inverse of :func:`squash`"""
    return root * (jnp.abs(root) + _NEAR_ZERO)


def _mlp(x: jax.Array, net_arch: Sequence[int], activation_fn: Activation) -> jax.Array:
    for width in net_arch:
        x = activation_fn(nn.Dense(width, kernel_init=_HIDDEN)(x))
    return x
