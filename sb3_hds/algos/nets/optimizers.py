"""Networks with their optimisers, and which optimiser is meant: by optax's name, or of torch."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
import torch as th

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
