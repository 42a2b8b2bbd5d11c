"""Checks that mass matrix, bias and step describe one mechanical system, by its energy."""

import copy
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sb3_hds.core import AnalyticTwin, Params, Position, Scalar, State, Velocity
from sb3_hds.core.numerics.compilation import QUICKEST_COMPILATION
from sb3_hds.twins.check_result import CheckItem, outcomes

# Rounding errors of a few hundred operations in double precision.
ROUNDING = 1e-9
_SPEEDS = (1.0, 10.0, 100.0)  # factors on typical velocities: at high speed, damping matters less
_N_FREE = 8  # motions without actuators
_LEAST_SUBSTEPS, _MOST_SUBSTEPS = 20, 100  # of each
# With sub-steps a quarter as long, a first-order error falls to a quarter; at hard stops, less.
_FINER, _FALLS = (1, 4, 16), 0.5
_NEGLIGIBLE = 1e-4  # share of the energy
_TINY = 1e-300
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(3)


class Points(NamedTuple):
    """
    Points at which the terms of the equation of motion are compared.

    :param params: by name, the values at all points, shape ``(points,)``
    :param q: positions, shape ``(points, dof)``
    :param v: velocities, shape ``(points, dof)``
    """

    params: dict[str, np.ndarray]
    q: np.ndarray
    v: np.ndarray


def precision(error: float) -> str:
    """:return: a relative error, in words"""
    return f"to {error:.0e}" if error else "exactly"


def check_mechanics(plant: AnalyticTwin, points: Points) -> list[CheckItem]:
    """
    :param points: in double precision
    :return: checks of mass matrix, potential and inertial forces; if these pass, also of the energy
        along a motion
    """

    def terms(params: Params, q: Position, v: Velocity) -> Any:
        load = lambda q: plant.bias(q, jnp.zeros_like(q), params)  # noqa: E731
        speeds = jnp.outer(jnp.array(_SPEEDS), v)
        power, size = jax.vmap(partial(_power, plant, params, q))(speeds)
        return plant.mass_matrix(q, params), jax.jacfwd(load)(q), power / size

    found = _compiled(jax.vmap(terms))(*points)
    mass, slopes, shares = map(np.asarray, found)
    for method, values in (("mass_matrix", mass), ("bias", slopes), ("bias", shares)):
        if not np.isfinite(values).all():
            found = f"{method} is not finite at every position and speed"
            return [CheckItem("equation of motion", False, found, "Look for divisions by zero.")]
    items = [_mass_item(plant, mass), _potential_item(plant, slopes), _power_item(shares)]
    return [*items, _energy_item(plant, points)] if all(item.ok for item in items) else items


def _power(plant: AnalyticTwin, params: Params, q: Position, v: Velocity) -> tuple[Scalar, Scalar]:
    """:return: the power of the twin's own forces without a potential, and the size of its terms"""
    change = jax.jvp(lambda q: plant.mass_matrix(q, params), (q,), (v,))[1]
    static, moving = (plant.bias(q, speed, params) for speed in (jnp.zeros_like(v), v))
    power = 0.5 * v @ change @ v - v @ (moving - static)
    size = jnp.sum(jnp.abs(jnp.outer(v, v) * change))
    return power, size + jnp.abs(v) @ (jnp.abs(moving) + jnp.abs(static)) + _TINY


def _mass_item(plant: AnalyticTwin, mass: Float[np.ndarray, "points dof dof"]) -> CheckItem:
    passed, failed = outcomes("mass matrix")
    size = np.maximum(np.abs(mass).max((1, 2), keepdims=True), _TINY)
    error = np.abs(mass - mass.transpose(0, 2, 1)) / size
    if error.max() > ROUNDING:
        _, i, j = np.unravel_index(error.argmax(), error.shape)
        return failed(
            f"not symmetric: entry ({plant.joints[i].name}, {plant.joints[j].name}) differs from "
            f"its mirror image by {error.max():.1%} of the largest entry",
            "Write both from the same expression.",
        )
    diagonal = np.einsum("nii->ni", mass)
    if diagonal.min() <= 0.0:
        joint = plant.joints[int(diagonal.min(0).argmin())].name
        return failed(
            f"not positive definite: {joint} has an inertia of {diagonal.min():.3g}",
            "Look at its sign, and at the lower bounds of the parameters that it is made of.",
        )
    scale = np.sqrt(diagonal)
    least = np.linalg.eigvalsh(mass / scale[:, :, None] / scale[:, None, :]).min()
    if least <= ROUNDING:
        return failed(
            f"not positive definite: smallest eigenvalue {least:.2g} where the diagonal is one",
            "What couples two joints must stay below the root of the product of their inertias.",
        )
    found = f"at {len(mass)} points, smallest eigenvalue {least:.2g} where the diagonal is one"
    return passed(f"symmetric and positive definite ({found})")


def _potential_item(plant: AnalyticTwin, slopes: Float[np.ndarray, "points dof dof"]) -> CheckItem:
    passed, failed = outcomes("gravity and springs")
    error = np.abs(slopes - slopes.transpose(0, 2, 1)) / np.maximum(np.abs(slopes).max(), _TINY)
    if error.max() > ROUNDING:
        n, i, j = np.unravel_index(error.argmax(), error.shape)
        first, second = plant.joints[i].name, plant.joints[j].name
        return failed(
            f"bias(q, 0) has no potential: the load of {first} changes with {second} by "
            f"{slopes[n, i, j]:.3g}, that of {second} with {first} by {slopes[n, j, i]:.3g}, and "
            "in a mechanical system these are equal",
            f"Derive both loads from one energy: look at the terms that hold {first} and {second}.",
        )
    if len(plant.joints) == 1:
        return passed("bias(q, 0) has a potential, as with any single joint")
    return passed(f"bias(q, 0) has a potential: its Jacobian is symmetric {precision(error.max())}")


def _power_item(shares: Float[np.ndarray, "points speeds"]) -> CheckItem:
    """:param shares: the power relative to the size of its terms"""
    passed, failed = outcomes("forces of inertia")
    if shares.max() > ROUNDING:
        return failed(
            "they add energy: v'(dM/dt v / 2 - bias(q, v) + bias(q, 0)) is positive, up to "
            f"{shares.max():.0%} of its parts, where it must be zero, or negative with damping",
            "Coriolis and centrifugal forces follow from the mass matrix, as dM/dt v - d(v'M v / "
            "2)/dq, and damping is + d v: look at signs and factors in bias.",
        )
    if shares.min() < -ROUNDING:
        return passed("they do no work, and the twin's own damping dissipates")
    return passed(f"they do no work, {precision(np.abs(shares).max())}; no damping")


def _energy_item(plant: AnalyticTwin, points: Points) -> CheckItem:
    """Integrate without actuators, and compare the loss of energy with the work of damping."""
    passed, failed = outcomes("energy")
    h = plant.dt / plant.substeps
    n = min(max(plant.substeps, _LEAST_SUBSTEPS), _MOST_SUBSTEPS)
    first = jax.tree.map(lambda values: values[:_N_FREE], points)
    errors: list[float] = []
    for finer in _FINER:
        error, size = _compiled(jax.vmap(_balance(plant, h / finer, n, finer)))(*first)
        if not np.isfinite(error).all():
            return failed(
                f"undriven, the motion is not finite after {n} sub-steps of {h:g} s",
                "Take more sub-steps, or rk4 as the integrator.",
            )
        largest = float(np.asarray(error).flat[np.abs(error).argmax()])
        errors.append(largest / max(float(np.max(size)), _TINY))
        least = _FALLS * abs(errors[-2]) if len(errors) > 1 else 0.0
        if falls := abs(errors[-1]) <= max(least, _NEGLIGIBLE):
            break
    found = f"undriven for {n} sub-steps of {h:g} s, off by {errors[0]:+.0e} of the largest energy"
    if len(errors) == 1:
        return passed(found)
    found += f", by {errors[-1]:+.0e} with sub-steps {_FINER[len(errors) - 1]} times as short"
    if falls:
        return passed(f"{found}: the integrator's error")
    clips = [
        method
        for method in ("limit", "limit_velocity")
        if getattr(type(plant), method) is not getattr(AnalyticTwin, method)
    ]
    if clips and errors[-1] < 0.0:
        return passed(f"{found}: {' and '.join(clips)} dissipates")
    return failed(
        f"{found}, which is no error of the integrator",
        "Look at the integrator, and at step, limit and limit_velocity, if the twin has its own.",
    )


def _balance(plant: AnalyticTwin, h: float, n: int, finer: int) -> Callable[..., Any]:
    """
    :param h: length of a sub-step [s]
    :param n: number of comparisons
    :param finer: sub-steps from one comparison to the next
    :return: a function that compares the energy along an undriven motion with the work done
    """
    rotary = np.array([joint.unit == "rad" for joint in plant.joints])
    drawn = jax.eval_shape(plant.initial, jax.random.key(0), plant.params)
    memory = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), drawn.memory)
    free: Any = copy.copy(plant.at_interval(h, 1))
    free.actuate = lambda state, action, params: jnp.zeros_like(state.q)

    def balance(params: Params, q: Position, v: Velocity) -> tuple[Float[Array, " n"], Scalar]:
        """:return: error of the energy after each comparison, and the largest energy"""
        nothing = jnp.zeros(len(plant.actuators))
        kinetic = lambda state: 0.5 * state.v @ plant.mass_matrix(state.q, params) @ state.v  # noqa: E731
        power = lambda state: _power(plant, params, state.q, state.v)[0]  # noqa: E731

        def lifted(q: Position, after: Position) -> Scalar:
            """Work against gravity and springs, on a straight path: it depends on the ends only."""
            way = after - q
            # The twin may wrap its angles.
            way = jnp.where(rotary, way - 2.0 * jnp.pi * jnp.round(way / (2.0 * jnp.pi)), way)
            load = lambda s: plant.bias(q + s * way, jnp.zeros_like(q), params)  # noqa: E731
            loads = jax.vmap(load)(jnp.array(0.5 + 0.5 * _NODES))
            return jnp.array(0.5 * _WEIGHTS) @ loads @ way

        def substep(now: tuple[State, Scalar, Scalar], _: None) -> Any:
            state, potential, work = now
            after = free.step(state, nothing, params)
            potential += lifted(state.q, after.q)
            work += 0.5 * h * (power(state) + power(after))
            return (after, potential, work), None

        def compare(now: tuple[State, Scalar, Scalar], _: None) -> Any:
            now = jax.lax.scan(substep, now, length=finer)[0]
            return now, (kinetic(now[0]), now[1], now[2])

        start, zero = State(q, v, memory), jnp.zeros(())
        _, (moving, potential, work) = jax.lax.scan(compare, (start, zero, zero), length=n)
        error = moving + potential - kinetic(start) - work
        return error, jnp.maximum(moving.max(), jnp.abs(potential).max())

    return balance


def _compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    return jax.jit(function, compiler_options=QUICKEST_COMPILATION)
