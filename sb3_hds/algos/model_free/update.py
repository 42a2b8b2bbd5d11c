"""The schedule of a model-free update: its steps in order, each in its interval."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray

AnyMetrics = TypeVar("AnyMetrics", bound=NamedTuple)
AnyState = TypeVar("AnyState", bound=NamedTuple)
Metrics = TypeVar("Metrics")


class UpdateStep(NamedTuple):
    """
    One step of an update.

    :param fields: of the state that it changes
    :param interval: updates between two applications
    :param apply: maps the state, the metrics so far and a key to the new values of these fields and
        the new metrics
    """

    fields: tuple[str, ...]
    interval: int
    apply: Callable[[Any, Any, PRNGKeyArray], tuple[tuple[Any, ...], Any]]


def apply_schedule(
    state: AnyState, metrics: Metrics, *steps: UpdateStep
) -> tuple[AnyState, Metrics]:
    """
    One update: apply its steps in order, each in its interval and with its own random key.

    :param state: has a ``key`` and counts its updates in ``n_updates``
    :param metrics: of the updates before, or a pytree that contains them
    :param steps: each receives the state and the metrics that the previous ones returned
    :return: state and metrics after the update
    """
    now: Any = state
    key, *keys = jax.random.split(now.key, 1 + len(steps))
    now = now._replace(key=key, n_updates=now.n_updates + 1)
    for step, key in zip(steps, keys, strict=True):
        apply = partial(step.apply, now, metrics, key)
        if step.interval == 1:
            fields, metrics = apply()
        else:
            # Only these fields pass through the branches, which copy their arguments.
            before = tuple(getattr(now, name) for name in step.fields), metrics
            due = now.n_updates % step.interval == 0
            fields, metrics = jax.lax.cond(due, apply, lambda before=before: before)
        now = now._replace(**dict(zip(step.fields, fields, strict=True)))
    return now, metrics


def zero_metrics(kind: type[AnyMetrics]) -> AnyMetrics:
    """:return: metrics before the first update, of a named tuple of numbers"""
    # NumPy: JAX would dispatch a program for each of them at every step.
    zero: Any = np.zeros((), jnp.result_type(float))
    return kind._make(zero for _ in kind._fields)
