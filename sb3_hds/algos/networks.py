"""Policy and value networks of the algorithms that learn through a twin."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, cast

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import torch as th
from jaxtyping import Array, Float
from torch.nn import functional

Activation = Callable[[jax.Array], jax.Array]

ACTIVATIONS: dict[str, Activation] = {
    "tanh": nn.tanh,
    "relu": nn.relu,
    "elu": nn.elu,
    "gelu": nn.gelu,
    "gelu_exact": partial(nn.gelu, approximate=False),
    "silu": nn.silu,
    "leaky_relu": nn.leaky_relu,
    "softplus": nn.softplus,
    "celu": jax.nn.celu,
    "selu": jax.nn.selu,
    "mish": jax.nn.mish,
    "relu6": jax.nn.relu6,
    "sigmoid": jax.nn.sigmoid,
    "log_sigmoid": jax.nn.log_sigmoid,
    "hard_sigmoid": jax.nn.hard_sigmoid,
    "hard_swish": jax.nn.hard_swish,
    "hard_tanh": jax.nn.hard_tanh,
    "soft_sign": jax.nn.soft_sign,
}

_TORCH_MODULES: dict[type, str] = {
    th.nn.Tanh: "tanh",
    th.nn.ReLU: "relu",
    th.nn.ELU: "elu",
    th.nn.GELU: "gelu_exact",
    th.nn.SiLU: "silu",
    th.nn.LeakyReLU: "leaky_relu",
    th.nn.Softplus: "softplus",
    th.nn.CELU: "celu",
    th.nn.SELU: "selu",
    th.nn.Mish: "mish",
    th.nn.ReLU6: "relu6",
    th.nn.Sigmoid: "sigmoid",
    th.nn.LogSigmoid: "log_sigmoid",
    th.nn.Hardsigmoid: "hard_sigmoid",
    th.nn.Hardswish: "hard_swish",
    th.nn.Hardtanh: "hard_tanh",
    th.nn.Softsign: "soft_sign",
}
# Functions of the same names, of which torch has some twice; the first entry counts.
_OF_TORCH: list[tuple[Any, str]] = [
    *_TORCH_MODULES.items(),
    (functional.gelu, "gelu_exact"),
    *(
        (getattr(home, spelled), name)
        for home in (th, functional)
        for name in ACTIVATIONS
        for spelled in (name, name.replace("_", ""))
        if hasattr(home, spelled)
    ),
]

# Width around zero where the value is linear rather than a square root, in units of the scaled
# reward.
_NEAR_ZERO = 0.3
# Squares in the value.
_N_SQUARES = 8
# Uniform rather than normal: half a second less to compile. Small in a last layer, so that a
# network starts near zero.
_HIDDEN = nn.initializers.variance_scaling(1.0, "fan_in", "uniform")
_SMALL = nn.initializers.variance_scaling(1e-4, "fan_in", "uniform")


def activation(choice: str | Activation | type) -> Activation:
    """
    :param choice: a name ("relu", any case; "gelu" is JAX's approximation by tanh, "gelu_exact"
        what torch means by ``GELU``), a JAX function, which is taken as it is, or of torch a
        function, a module class, or a module without settings of its own
    :raises ValueError: for a name, or something of torch, without an equal here, and for a function
        that JAX cannot trace, or that changes the shape of what it is given
    """
    name = choice if isinstance(choice, str) else _torch_name(choice)
    known = {key.replace("_", ""): function for key, function in ACTIVATIONS.items()}
    found = known.get(name.lower().replace("_", ""))
    if found is not None:
        return found
    if isinstance(choice, str | type | th.nn.Module) or not callable(choice):
        raise ValueError(
            f"activation_fn must be one of {', '.join(ACTIVATIONS)}, a torch class of such a name, "
            f"or a JAX function, which may have settings of its own, got {choice!r}."
        )
    return _checked(choice)


def activation_name(choice: Any) -> Any:
    """:return: of a function that is known here, its name; anything else as it is"""
    names = (name for name, known in ACTIVATIONS.items() if known is choice)
    return next(names, choice)


def _checked(function: Activation) -> Activation:
    given = jax.ShapeDtypeStruct((2, 3), jnp.float32)
    try:
        shape = getattr(jax.eval_shape(function, given), "shape", None)
    except (TypeError, ValueError, AttributeError) as error:
        raise ValueError(
            f"activation_fn={function!r} is no JAX function ({str(error).splitlines()[0]}): use "
            f"one of jax.nn or jax.numpy, or a name among {', '.join(ACTIVATIONS)}."
        ) from error
    if shape != given.shape:
        raise ValueError(
            f"activation_fn={function!r} must keep the shape of an array, and makes {shape} of "
            f"{given.shape}."
        )
    return function


def _torch_name(choice: Any) -> str:
    """:return: of an activation of torch itself; of anything else, the empty string"""
    if isinstance(choice, th.nn.GELU) and choice.approximate == "tanh":
        return "gelu"
    kind = type(choice)
    if kind in _TORCH_MODULES and choice.extra_repr() == kind().extra_repr():
        choice = kind
    return next((name for ours, name in _OF_TORCH if ours is choice), "")


def widths_of(given: Any) -> tuple[int, ...] | None:
    """:return: widths of layers as Python has them; None unless all are whole numbers above 0"""
    if isinstance(given, np.ndarray):
        given = given.tolist()
    if not isinstance(given, Sequence):
        return None
    if not all(isinstance(width, int | np.integer) and width > 0 for width in given):
        return None
    return tuple(map(int, given))


class Actor(nn.Module):
    """
    Observation to control in (-1, 1), with a small last layer, so that it starts near zero.

    :param n_act: number of controls
    :param net_arch: widths of the hidden layers
    :param activation_fn: between the layers
    :param linear_path: whether a linear map goes from input to output beside the hidden layers:
        near a balance the best control is linear in the state, and many units agree on a line
        slowly
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
    """
    Observation to roots :math:`\rho` of the value, see :func:`value_of`.

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
    """:return: what a network puts out for one observation or a batch"""
    return cast(jax.Array, network.apply(weights, obs))


def with_input_scales(weights: Mapping[str, Any], old: Any, new: Any) -> Mapping[str, Any]:
    """
    :param weights: of an ``Actor`` or ``Value`` whose input is ``(obs - old.mean) / old.scale``
    :param new: mean and scale from now on, each of shape ``(n_obs,)``
    :return: weights that compute the same of ``(obs - new.mean) / new.scale``
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

    Near a goal the value is minus a quadratic form. Squares have one without effort, and its
    curvature is known from their slopes.
    """
    return unsquash(roots[..., 0]) - jnp.sum(roots[..., 1:] ** 2, -1)


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


def finite_leaves(tree: Any) -> bool:
    """:return: whether no number in it is infinite or not a number"""
    numbers = (leaf for leaf in jax.tree.leaves(tree) if jnp.issubdtype(leaf.dtype, jnp.inexact))
    return all(np.isfinite(leaf).all() for leaf in numbers)
