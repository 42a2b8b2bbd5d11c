"""One planner over many start states, compiled."""

from collections.abc import Callable, Mapping
from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from sb3_hds.core import State, Twin
from sb3_hds.planning.first_order import gradient_ascent
from sb3_hds.planning.ilqr import gauss_newton, ilqr
from sb3_hds.planning.problem import Plan, Problem, TerminalValue

METHODS: Mapping[str, Callable[..., Plan]] = {
    "first_order": gradient_ascent,
    "gauss_newton": gauss_newton,
    "ilqr": lambda *args, **settings: ilqr(*args, **settings)[0],
}


def solve(
    twin: Twin,
    starts: State,
    controls: Float[Array, "batch horizon act"],
    method: str = "ilqr",
    n_iterations: int = 10,
    discount: float = 1.0,
    terminal_value: TerminalValue | None = None,
    terminal_curvature: bool = False,
    temperature: float = 0.0,
    key: PRNGKeyArray | None = None,
) -> Plan:
    """
    Improve one control sequence for each start state, in the twin as it is now.

    :param twin: any twin; its current parameter values are used
    :param starts: leaves of shape ``(batch, ...)``
    :param controls: scaled to [-1, 1]; clipped to that
    :param method: ``"first_order"``, ``"gauss_newton"`` or ``"ilqr"``
    :param n_iterations: improvements of each sequence
    :param discount: per step, in (0, 1]
    :param terminal_value: of the last observation; the same function object compiles only once
    :param terminal_curvature: whether second-order methods use its Hessian
    :param temperature: annealed acceptance; needs ``key``
    :return: plans, leaves of shape ``(batch, ...)``; a sequence that meets a value that is not
        finite keeps its best finite form, the others are not touched by it
    :raises ValueError: for an unknown method or controls of the wrong shape
    """
    if method not in METHODS:
        raise ValueError(f"method must be one of {', '.join(METHODS)}, got {method!r}.")
    batch, n_act = starts.q.shape[0], len(twin.actuators)
    if controls.ndim != 3 or controls.shape[0] != batch or controls.shape[2] != n_act:
        raise ValueError(
            f"controls must have shape (batch, horizon, n_act) = ({batch}, horizon, {n_act}), "
            f"got {controls.shape}."
        )
    keys = None if key is None else jax.random.split(key, batch)
    settings = (twin, method, n_iterations, discount, terminal_value, terminal_curvature)
    return _solve(settings, twin.params, starts, jnp.clip(controls, -1.0, 1.0), temperature, keys)


@partial(jax.jit, static_argnums=0)
def _solve(settings, params, starts, controls, temperature, keys) -> Plan:
    twin, method, n_iterations, discount, terminal_value, terminal_curvature = settings
    problem = Problem(
        twin,
        params,
        discount,
        terminal_value=terminal_value,
        terminal_curvature=terminal_curvature,
    )
    improve = partial(METHODS[method], problem, n_iterations=n_iterations, temperature=temperature)
    if keys is None:
        return jax.vmap(lambda start, u: improve(start, u))(starts, controls)
    return jax.vmap(lambda start, u, key: improve(start, u, key=key))(starts, controls, keys)
