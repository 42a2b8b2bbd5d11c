"""Networks with their optimisers, by name or as functions of optax or classes of torch."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
import torch as th

Weights = Mapping[str, Any]
OPTIMIZERS = {
    name: getattr(optax, name)
    for name in (
        *("adam", "adamw", "sgd", "rmsprop", "nadam", "radam"),
        *("adabelief", "lion", "adamax", "adadelta", "adagrad"),
    )
}
# Torch's optimisers with the defaults that differ from optax's. NAdam's momentum schedule has no
# equivalent in optax.
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


class TrainState(NamedTuple):
    """
    A network and its optimiser.

    :param weights: flax variables: ``"params"`` and, with batch normalisation, ``"statistics"``
    :param optimizer: state of the optimiser of ``"params"``
    """

    weights: Weights
    optimizer: Any


@dataclasses.dataclass(frozen=True)
class Optimizer:
    """
    An optax optimiser without its learning rate, so that schedules do not recompile programs.

    :param make: ``optax.adam`` or a function with the same signature
    :param arguments: besides the learning rate
    """

    make: Callable[..., optax.GradientTransformation]
    arguments: tuple[tuple[str, Any], ...] = ()

    def train_state(self, weights: Weights) -> TrainState:
        """:return: the network with the initial state of its optimiser"""
        return TrainState(weights, self._transformation.init(weights["params"]))

    def apply(self, gradient: Any, trained: TrainState, rate: Any) -> TrainState:
        """:return: the network and the optimiser after a step with this learning rate"""
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
    :param make: name or function of optax, with its defaults, or torch class, with torch's defaults
    :param arguments: of optax's function, or torch's ``betas`` and ``alpha``
    :raises ValueError: for an unknown optimiser and for arguments that it does not have
    """
    arguments = dict(arguments)
    if "betas" in arguments:
        arguments["b1"], arguments["b2"] = arguments.pop("betas")
    if "alpha" in arguments:
        arguments["decay"] = arguments.pop("alpha")
    name = make if isinstance(make, str) else getattr(make, "__name__", "")
    of_torch = isinstance(make, type) and issubclass(make, th.optim.Optimizer)
    # A function is used as given, whatever its name.
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
        optimizer.train_state({"params": jnp.zeros(1)})
    except TypeError as error:
        raise ValueError(f"optimizer_kwargs {arguments!r} do not fit {name}: {error}.") from None
    return optimizer


def finite_leaves(tree: Any) -> bool:
    """:return: whether all numbers of the pytree are finite"""
    numbers = (leaf for leaf in jax.tree.leaves(tree) if jnp.issubdtype(leaf.dtype, jnp.inexact))
    return all(np.isfinite(leaf).all() for leaf in numbers)
