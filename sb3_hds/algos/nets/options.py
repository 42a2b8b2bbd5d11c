"""Activations, widths and optimisers as users give them: by name, of JAX, optax or torch."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax
import torch as th
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
Weights = Mapping[str, Any]
OPTIMIZERS = {
    "adam": optax.adam,
    "adamw": optax.adamw,
    "sgd": optax.sgd,
    "rmsprop": optax.rmsprop,
    "nadam": optax.nadam,
    "radam": optax.radam,
    "adabelief": optax.adabelief,
    "lion": optax.lion,
    "adamax": optax.adamax,
    "adadelta": optax.adadelta,
    "adagrad": optax.adagrad,
}
# Of torch's classes: where their defaults are not those of optax. NAdam's momentum has a schedule
# that optax does not have.
_TORCH: dict[str, dict[str, Any]] = {
    "adam": {},
    "adamw": {"weight_decay": 1e-2},
    "sgd": {},
    "rmsprop": {"decay": 0.99, "eps_in_sqrt": False},
    "radam": {},
    "adamax": {},
    "adadelta": {},
    "adagrad": {"initial_accumulator_value": 0.0, "eps": 1e-10},
}


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


def widths(
    net_arch: Sequence[int] | Mapping[str, Sequence[int]], critic: str
) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """
    :param critic: the key of the critics' widths, where those of the actor differ
    :return: hidden widths of the actor and of the critics
    :raises ValueError: for other keys than ``pi`` and that one, or widths that are no counts
    """
    given = net_arch if isinstance(net_arch, Mapping) else {"pi": net_arch, critic: net_arch}
    pi, qf = (widths_of(given.get(name)) for name in ("pi", critic))
    if given.keys() != {"pi", critic} or pi is None or qf is None:
        raise ValueError(
            f"net_arch must be a list of widths such as [256, 256], or {{'pi': [256], '{critic}': "
            f"[256, 256]}}, got {net_arch!r}."
        )
    return pi, qf


def finite_leaves(tree: Any) -> bool:
    """:return: whether no number in it is infinite or not a number"""
    numbers = (leaf for leaf in jax.tree.leaves(tree) if jnp.issubdtype(leaf.dtype, jnp.inexact))
    return all(np.isfinite(leaf).all() for leaf in numbers)


class TrainState(NamedTuple):
    """
    :param weights: flax variables, ``"params"`` and, where there are some, ``"statistics"``
    :param optimizer: state of the optimiser of the params
    """

    weights: Weights
    optimizer: Any


@dataclasses.dataclass(frozen=True)
class Optimizer:
    """
    An optax optimiser, without its learning rate, so that schedules act without compiling again.

    :param make: ``optax.adam`` or one that is called like it
    :param arguments: besides the learning rate
    """

    make: Callable[..., optax.GradientTransformation]
    arguments: tuple[tuple[str, Any], ...] = ()

    def init(self, params: Any) -> Any:
        return self._transformation.init(params)

    def apply(self, gradient: Any, trained: TrainState, rate: Any) -> TrainState:
        params = trained.weights["params"]
        step, state = self._transformation.update(gradient, trained.optimizer, params)
        step = jax.tree.map(lambda s: rate * s, step)
        weights = {**trained.weights, "params": optax.apply_updates(params, step)}
        return TrainState(weights, state)

    @property
    def _transformation(self) -> optax.GradientTransformation:
        return self.make(learning_rate=1.0, **dict(self.arguments))


def optimizer_of(make: str | Callable[..., Any], arguments: Mapping[str, Any]) -> Optimizer:
    """
    :param make: name or function of optax, with its defaults, or torch class, with those of torch
    :param arguments: of optax's function, or torch's ``betas`` and ``alpha``
    :raises ValueError: for one that is not known here
    """
    arguments = dict(arguments)
    if "betas" in arguments:
        arguments["b1"], arguments["b2"] = arguments.pop("betas")
    if "alpha" in arguments:
        arguments["decay"] = arguments.pop("alpha")
    name = make if isinstance(make, str) else getattr(make, "__name__", "")
    of_torch = isinstance(make, type) and issubclass(make, th.optim.Optimizer)
    # A function is taken as it is, whatever its name.
    found = OPTIMIZERS.get(name.lower()) if isinstance(make, str) or of_torch else None
    if of_torch:
        if name.lower() not in _TORCH or getattr(th.optim, name) is not make:
            other = f"optimizer_class='{name.lower()}'" if found else "one of these names"
            raise ValueError(
                f"optimizer_class={name} of {make.__module__} has no equal in optax, as "
                f"{', '.join(_TORCH)} of torch have: use {other}."
            )
        arguments = _TORCH[name.lower()] | arguments
    if found is None and (isinstance(make, str | type) or not callable(make)):
        raise ValueError(
            f"optimizer_class must be one of {', '.join(OPTIMIZERS)}, an optax function or a "
            f"torch class of one of these names, got {make!r}."
        )
    optimizer = Optimizer(found or make, tuple(sorted(arguments.items())))  # type: ignore[arg-type]
    try:
        optimizer.init({"w": jnp.zeros(1)})
    except TypeError as error:
        raise ValueError(f"optimizer_kwargs {arguments!r} do not fit {name}: {error}.") from None
    return optimizer


def optimizer_name(choice: Any) -> Any:
    """:return: of a function of optax that is known here, its name; anything else as it is"""
    return next((name for name, known in OPTIMIZERS.items() if known is choice), choice)
