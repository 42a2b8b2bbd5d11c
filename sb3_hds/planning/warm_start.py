"""Initial sequences: random smooth ones, the best of many, and growing horizons."""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray

from sb3_hds.core import State
from sb3_hds.planning.problem import Controls, Plan, Problem, simulate

_KNOTS = 5


def random_controls(key: PRNGKeyArray, horizon: int, n_act: int, scale: float = 2.0) -> Controls:
    """
    Piecewise linear through five normal knots, clipped: smooth, and often at a limit.

    :param scale: standard deviation of the knots; above 1, much of the sequence is bang-bang
    """
    knots = scale * jax.random.normal(key, (_KNOTS, n_act))
    # The weights of the knots are constants: interpolating inside the program takes a second to
    # compile.
    distance = np.abs(np.linspace(0.0, _KNOTS - 1.0, horizon)[:, None] - np.arange(_KNOTS))
    hats = jnp.asarray(np.maximum(1.0 - distance, 0.0), knots.dtype)
    return jnp.clip(hats @ knots, -1.0, 1.0)


def best_of_random(
    problem: Problem,
    start: State,
    key: PRNGKeyArray,
    horizon: int,
    n_candidates: int,
    scale: float = 2.0,
) -> Plan:
    """:return: the best of ``n_candidates`` random sequences"""
    keys = jax.random.split(key, n_candidates)
    draw = lambda k: random_controls(k, horizon, problem.n_controls, scale)  # noqa: E731
    plans = jax.vmap(lambda k: simulate(problem, start, draw(k)))(keys)
    return jax.tree.map(lambda leaf: leaf[jnp.argmax(plans.value)], plans)


def multi_start(
    problem: Problem,
    start: State,
    initial: Sequence[Controls],
    improve: Callable[[Problem, State, Controls], Plan],
) -> Plan:
    """
    Improve several sequences and keep the best, against local optima.

    :param initial: sequences of one length
    :param improve: an improver, for example ``gauss_newton``
    """
    plans = jax.vmap(lambda u: improve(problem, start, u))(jnp.stack(initial))
    return jax.tree.map(lambda leaf: leaf[jnp.argmax(plans.value)], plans)


def horizon_continuation(
    problem: Problem,
    start: State,
    controls: Controls,
    horizons: Sequence[int],
    improve: Callable[[Problem, State, Controls], Plan],
) -> Plan:
    """
    Improve the first steps, then more and more of them: a long swing-up is found from its
    beginning.

    :param controls: the whole sequence, shape ``(horizon, n_act)``
    :param horizons: growing lengths; the last one is the whole horizon
    :param improve: an improver, for example ``gauss_newton``
    :return: the plan over the whole horizon; never worse than the start, which is kept if it is
        better
    """
    if (
        list(horizons) != sorted(set(horizons))
        or horizons[-1] != controls.shape[0]
        or horizons[0] < 1
    ):
        raise ValueError(
            f"Horizons must grow from at least 1 to the length of the controls, "
            f"{controls.shape[0]}, got {list(horizons)}."
        )
    first = simulate(problem, start, controls)
    current = controls
    for horizon in horizons:
        plan = improve(problem, start, current[:horizon])
        current = jnp.concatenate([plan.controls, current[horizon:]])
    better = plan.value > first.value
    return jax.tree.map(lambda new, old: jnp.where(better, new, old), plan, first)
