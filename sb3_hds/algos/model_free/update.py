"""What the updates of all model-free algorithms share: batches, and a schedule of their steps."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

AnyMetrics = TypeVar("AnyMetrics", bound=NamedTuple)
AnyState = TypeVar("AnyState", bound=NamedTuple)
Found = TypeVar("Found")


class Batch(NamedTuple):
    """
    Transitions. ``discount`` is that of the next value: :math:`\\gamma^n` for n-step returns.
    """

    obs: Float[Array, "*batch obs"]
    action: Float[Array, "*batch act"]
    next_obs: Float[Array, "*batch obs"]
    reward: Float[Array, "*batch"]
    terminated: Float[Array, "*batch"]
    discount: Float[Array, "*batch"]


class UpdateStep(NamedTuple):
    """
    One step of an update.

    :param fields: of the state, which it changes
    :param interval: updates from one time that it is due to the next
    :param apply: maps the state, the metrics so far and a key to the new values of these fields and
        the new metrics
    """

    fields: tuple[str, ...]
    interval: int
    apply: Callable[[Any, Any, PRNGKeyArray], tuple[tuple[Any, ...], Any]]


def apply_schedule(state: AnyState, found: Found, *steps: UpdateStep) -> tuple[AnyState, Found]:
    """
    One update: its steps in order, each where it is due, with a random key of its own.

    :param state: has a ``key`` and counts its updates in ``n_updates``
    :param found: metrics, or more
    :param steps: each sees what those before it have changed
    :return: both after an update
    """
    now: Any = state
    key, *keys = jax.random.split(now.key, 1 + len(steps))
    now = now._replace(key=key, n_updates=now.n_updates + 1)
    for step, key in zip(steps, keys, strict=True):
        apply = partial(step.apply, now, found, key)
        if step.interval == 1:
            fields, found = apply()
        else:
            # Other fields stay outside: what a branch hands through is copied.
            before = tuple(getattr(now, name) for name in step.fields), found
            due = now.n_updates % step.interval == 0
            fields, found = jax.lax.cond(due, apply, lambda before=before: before)
        now = now._replace(**dict(zip(step.fields, fields, strict=True)))
    return now, found


def zero_metrics(kind: type[AnyMetrics]) -> AnyMetrics:
    """
    :param kind: a named tuple of numbers
    :return: one before any update
    """
    # Of NumPy: JAX would dispatch each as a program of its own, at every step.
    zero: Any = np.zeros((), jnp.result_type(float))
    return kind._make(zero for _ in kind._fields)
