"""The equation of motion of a mechanism, and its derivative."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array

from sb3_hds.core import Force, MassMatrix, Params, Position, Velocity
from sb3_hds.twins.mujoco import scalars as s
from sb3_hds.twins.mujoco.dynamics import (
    Triangle,
    factor,
    inverse_dynamics,
    mass_matrix,
    poses,
    solve,
)
from sb3_hds.twins.mujoco.mechanism import BALL, FREE, Link, Mechanism, Place
from sb3_hds.twins.mujoco.parameters import gravity_of, inertias_of, of_plant
from sb3_hds.twins.mujoco.scalars import Number

# Speed over which dry friction builds up [rad/s] or [m/s].
_STANDSTILL = 0.01
# Squared speed, in units of that, below which the series of tanh(x) / x is exact to 1e-16.
_SMALL = 1e-6


class Equation:
    r"""
    :math:`M(q)\,\dot v + c(q, v) = \tau`, with the model's damping, dry friction and springs in
    :math:`c`.

    Of :math:`\dot v = (M + C)^{-1} (\tau - c)` the derivative is taken through inverse dynamics:

    .. math:: (M + C)\,d\dot v = d\tau - dC\,\dot v
              - \frac{\partial (M \dot v + c)}{\partial (q, v, p)}\,d(q, v, p)

    so that neither the mass matrix nor its factors are differentiated.

    Source: Carpentier and Mansard, *Analytical derivatives of rigid body dynamics algorithms*,
    Robotics: Science and Systems 2018.

    :param payload: where an unknown mass may be
    :param masses: whether mass, centre and inertia of each body are parameters
    """

    def __init__(self, mechanism: Mechanism, payload: Place | None, masses: bool) -> None:
        self.mechanism, self.payload, self.masses = mechanism, payload, masses
        self.parameters = of_plant(mechanism, payload, masses)
        self.mass_matrix = jax.jit(self._mass_matrix)
        self.bias = jax.jit(self._bias)
        self._solved = jax.jit(_differentiated(self._solve, self._needed))

    def acceleration(
        self, q: Position, v: Velocity, force: Force, coupling: Triangle, params: Params
    ) -> Velocity:
        r"""
        :param force: generalised, of all but the equation's own
        :param coupling: :math:`C`, symmetric: what an implicit integrator adds to the mass matrix
        :return: the acceleration
        """
        coupling = {place: jnp.asarray(entry, q.dtype) for place, entry in coupling.items()}
        return self._solved(q, v, force, coupling, self._typed(params, q))

    # --- on arrays

    def _mass_matrix(self, q: Position, params: Params) -> MassMatrix:
        p = self._typed(params, q)
        entries, n = self._inertia_at(_unstacked(q), p), self.mechanism.n_v
        rows = [[entries.get((max(i, j), min(i, j)), 0.0) for j in range(n)] for i in range(n)]
        return _stacked([x for row in rows for x in row], q).reshape(n, n)

    def _bias(self, q: Position, v: Velocity, params: Params) -> Force:
        p = self._typed(params, q)
        return _stacked(self._load(_unstacked(q), _unstacked(v), p), q)

    def _typed(self, params: Params, like: Array) -> dict[str, Array]:
        return {name: jnp.asarray(params[name], like.dtype) for name in self.parameters}

    # --- on scalars

    def _solve(self, q: Any, v: Any, force: Any, coupling: Triangle, p: Any) -> tuple[Any, Any]:
        """The acceleration, and the factors of the matrix that was solved."""
        matrix = self._inertia_at(q, p)
        for place, entry in coupling.items():
            matrix[place] = s.add(matrix.get(place, 0.0), entry)
        factors = factor(matrix, self.mechanism.n_v)
        load = self._load(q, v, p)
        return solve(factors, [s.sub(f, c) for f, c in zip(force, load, strict=True)]), factors

    def _needed(self, q: Any, v: Any, a: Any, coupling: Triangle, p: Any) -> list[Number]:
        """The force under which an acceleration happens."""
        found = self._load(q, v, p, a)
        for link in self.mechanism.links:
            for i in link.dofs:
                found[i] = s.add(found[i], s.mul(_armature(link, p), a[i]))
        for (i, j), entry in coupling.items():
            found[i] = s.add(found[i], s.mul(entry, a[j]))
            if i != j:
                found[j] = s.add(found[j], s.mul(entry, a[i]))
        return found

    def _inertia_at(self, q: Any, p: Any) -> Triangle:
        links = self.mechanism.links
        inertia = inertias_of(self.mechanism, self.payload, self.masses, p)
        matrix = mass_matrix(links, poses(links, q), inertia)
        for link in links:
            for i in link.dofs:
                matrix[i, i] = s.add(matrix[i, i], _armature(link, p))
        return matrix

    def _load(self, q: Any, v: Any, p: Any, a: Any = None) -> list[Number]:
        links = self.mechanism.links
        inertia = inertias_of(self.mechanism, self.payload, self.masses, p)
        gravity = gravity_of(self.mechanism, p)
        found = inverse_dynamics(links, poses(links, q), inertia, v, gravity, a)
        for link in links:
            for i, pull in zip(link.dofs, _spring(link, q, p), strict=True):
                found[i] = s.add(found[i], pull)
            for i, axis in zip(link.dofs, range(len(link.dofs)), strict=True):
                found[i] = s.add(found[i], s.mul(resistance(link, axis, v[i], p), v[i]))
        return found


def resistance(link: Link, axis: int, v: Number, p: Any) -> Number:
    """
    :param axis: which of the link's degrees of freedom
    :return: the force of damping and dry friction per speed
    """
    found = damping(link, axis, v, p)
    dry = p.get(f"{link.joint}_frictionloss", 0.0)
    return found if isinstance(dry, float) else s.add(found, s.mul(dry, _tanh_per(v)))


def damping(link: Link, axis: int, v: Number, p: Any, slope: bool = False) -> Number:
    """:return: the force of damping per speed; or its slope by the speed"""
    found: Number = p.get(f"{link.joint}_damping", 0.0)
    power: Number = 1.0
    for order, coefficient in enumerate(link.damping[axis][1:], 2):
        power = s.mul(power, lax.abs(v))
        found = s.add(found, s.mul((order if slope else 1.0) * coefficient, power))
    return found


def _tanh_per(v: Array) -> Array:
    """``tanh(v / w) / v`` for ``w = _STANDSTILL``, smooth at standstill."""
    x = lax.mul(v, 1.0 / _STANDSTILL)
    squared = lax.mul(x, x)
    near = squared < _SMALL
    away = jnp.where(near, 1.0, x)
    return jnp.where(near, 1.0 - squared / 3.0, lax.tanh(away) / away) / _STANDSTILL


def _armature(link: Link, p: Any) -> Number:
    return p.get(f"{link.joint}_armature", 0.0)


def _spring(link: Link, q: Any, p: Any) -> list[Number]:
    """The load of a joint's spring, by degree of freedom."""
    if not link.stiffness:
        return [0.0] * len(link.dofs)
    first = p.get(f"{link.joint}_stiffness", link.stiffness[0])

    def stiffness(excursion: Number) -> Number:
        found, power = first, excursion
        for coefficient in link.stiffness[1:]:
            found, power = s.add(found, s.mul(coefficient, power)), s.mul(power, excursion)
        return found

    if link.kind not in (BALL, FREE):
        away = s.sub(q[link.q], link.rest[0])
        return [s.mul(stiffness(away), away)]
    start = link.q + (3 if link.kind == FREE else 0)
    turn, rest = jnp.stack(q[start : start + 4]), jnp.asarray(link.rest[-4:], q[start].dtype)
    parts = [list(s.turn_between(turn, rest))]
    if link.kind == FREE:
        parts.insert(0, [s.sub(q[link.q + i], link.rest[i]) for i in range(3)])
    # Only a spring of higher order asks how far it is stretched, which has a kink at rest.
    far = len(link.stiffness) > 1
    sizes = [jnp.sqrt(s.dot(part, part)) if far else 0.0 for part in parts]
    return [s.mul(stiffness(r), x) for part, r in zip(parts, sizes, strict=True) for x in part]


# --- the derivative


def _differentiated(solve_for: Callable[..., Any], needed: Callable[..., Any]) -> Any:
    """Forward dynamics on arrays, whose derivative is that of inverse dynamics."""

    def solved(q: Array, v: Array, force: Array, coupling: Triangle, p: Any) -> Any:
        return solve_for(_unstacked(q), _unstacked(v), _unstacked(force), coupling, p)

    @jax.custom_jvp
    def acceleration(q: Array, v: Array, force: Array, coupling: Triangle, p: Any) -> Array:
        return _stacked(solved(q, v, force, coupling, p)[0], q)

    def rule(primals: Any, tangents: Any) -> tuple[Array, Array]:
        q, v, force, coupling, p = primals
        a, factors = solved(*primals)
        where, form = jax.tree.flatten((q, v, coupling, p))
        ways = jax.tree.leaves((*tangents[:2], *tangents[3:]))
        moving = [i for i, way in enumerate(ways) if not isinstance(way, SymbolicZero)]

        def load(*moved: Array) -> list[Array]:
            now = list(where)
            for i, x in zip(moving, moved, strict=True):
                now[i] = x
            q, v, coupling, p = jax.tree.unflatten(form, now)
            return _arrays(needed(_unstacked(q), _unstacked(v), a, coupling, p), q[0])

        right: list[Number] = [0.0] * len(a)
        if not isinstance(tangents[2], SymbolicZero):
            right = _unstacked(tangents[2])
        if moving:
            _, more = jax.jvp(load, [where[i] for i in moving], [ways[i] for i in moving])
            right = [s.sub(f, c) for f, c in zip(right, more, strict=True)]
        return _stacked(a, q), _stacked(solve(factors, right), q)

    acceleration.defjvp(rule, symbolic_zeros=True)
    return acceleration


def _unstacked(x: Array) -> list[Array]:
    return [lax.squeeze(part, (0,)) for part in lax.split(x, (1,) * x.shape[0])]


def _stacked(numbers: list[Number], like: Array) -> Array:
    return lax.concatenate([lax.expand_dims(x, (0,)) for x in _arrays(numbers, like)], 0)


def _arrays(numbers: list[Number], like: Array) -> list[Array]:
    return [lax.full((), x, like.dtype) if isinstance(x, float) else x for x in numbers]
