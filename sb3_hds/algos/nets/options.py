"""Activations by name or as functions of JAX or torch, and widths of layers."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import torch as th
from torch.nn import functional

from sb3_hds.algos.nets.optimizers import OPTIMIZERS

Activation = Callable[[jax.Array], jax.Array]
_NAMES = (
    *("tanh", "relu", "elu", "gelu", "gelu_exact", "silu", "leaky_relu", "softplus", "celu"),
    *("selu", "mish", "relu6", "sigmoid", "log_sigmoid", "hard_sigmoid", "hard_swish"),
    *("hard_tanh", "soft_sign"),
)
_GELU_EXACT = partial(jax.nn.gelu, approximate=False)
ACTIVATIONS: dict[str, Activation] = {
    name: _GELU_EXACT if name == "gelu_exact" else getattr(jax.nn, name) for name in _NAMES
}
# Torch's classes have these names without underscores, and its GELU is the exact one.
_BY_LETTERS = {name.replace("_", ""): name for name in ACTIVATIONS}
_TORCH_MODULES: dict[type, str] = {
    kind: _BY_LETTERS[kind.__name__.lower()]
    for kind in vars(th.nn).values()
    if isinstance(kind, type) and kind.__name__.lower() in _BY_LETTERS
} | {th.nn.GELU: "gelu_exact"}
# With functions of the same names, some of which torch has twice; the first entry counts.
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


def activation(choice: str | Activation | type) -> Activation:
    """
    :param choice: a name ("relu", any case; "gelu" is JAX's approximation by tanh, "gelu_exact" is
        torch's ``GELU``), a JAX function, or torch's function, module class, or module with default
        settings
    :raises ValueError: for a name or an object of torch without an equivalent here, and for a
        function that JAX cannot trace or that changes the shape of its input
    """
    name = choice if isinstance(choice, str) else _torch_name(choice)
    letters = name.lower().replace("_", "")
    if letters in _BY_LETTERS:
        return ACTIVATIONS[_BY_LETTERS[letters]]
    if isinstance(choice, str | type | th.nn.Module) or not callable(choice):
        raise ValueError(
            f"activation_fn must be one of {', '.join(ACTIVATIONS)}, a torch class of such a name, "
            f"or a JAX function, which may have settings of its own, got {choice!r}."
        )
    return _checked(choice)


def name_in(table: Mapping[str, Any], choice: Any) -> Any:
    """:return: the name of a function that the table has; anything else unchanged"""
    return next((name for name, known in table.items() if known is choice), choice)


def by_names(policy_kwargs: Mapping[str, Any]) -> dict[str, Any]:
    """
    Replace functions of JAX, which would be pickled by parts of JAX that change, by their names.

    :return: the same arguments with names of activations and optimisers where their functions were
        given, and lists in place of arrays, whose truth value SB3 evaluates
    """
    named = dict(policy_kwargs)
    for argument, value in policy_kwargs.items():
        if isinstance(value, np.ndarray):
            named[argument] = value.tolist()
        elif argument.endswith("activation_fn"):
            named[argument] = name_in(ACTIVATIONS, value)
        elif argument == "optimizer_class":
            named[argument] = name_in(OPTIMIZERS, value)
    return named


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
    """:return: our name of an activation of torch; for anything else, the empty string"""
    if isinstance(choice, th.nn.GELU) and choice.approximate == "tanh":
        return "gelu"
    kind = type(choice)
    if kind in _TORCH_MODULES and choice.extra_repr() == kind().extra_repr():
        choice = kind
    return next((name for ours, name in _OF_TORCH if ours is choice), "")


def _widths_of(given: Any) -> tuple[int, ...] | None:
    """:return: widths of layers as Python integers; None unless all are whole numbers above 0"""
    if isinstance(given, np.ndarray):
        given = given.tolist()
    if not isinstance(given, Sequence):
        return None
    if not all(isinstance(width, int | np.integer) and width > 0 for width in given):
        return None
    return tuple(map(int, given))


def widths(
    net_arch: Sequence[int] | Mapping[str, Sequence[int]] | None,
    critic: str,
    defaults: Mapping[str, Sequence[int]] | None = None,
) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """
    :param critic: the key of the critics' widths, where those of the actor differ
    :param defaults: by key, for keys that are missing or None; None: both keys are required
    :return: hidden widths of the actor and of the critics
    :raises ValueError: for other keys than ``pi`` and that one, or widths that are no counts
    """
    given = net_arch if isinstance(net_arch, Mapping) else {"pi": net_arch, critic: net_arch}
    if defaults is not None:
        given = {**defaults, **{name: each for name, each in given.items() if each is not None}}
    pi, qf = (_widths_of(given.get(name)) for name in ("pi", critic))
    if given.keys() != {"pi", critic} or pi is None or qf is None:
        raise ValueError(
            f"net_arch must be a list of widths such as [256, 256], or {{'pi': [256], '{critic}': "
            f"[256, 256]}}, got {net_arch!r}."
        )
    return pi, qf
