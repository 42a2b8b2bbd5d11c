"""The equation of motion of a mechanism, and its derivative."""

from collections.abc import Callable
from functools import cache
from itertools import zip_longest
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array

from sb3_hds.core import Force, MassMatrix, Params, Position, Velocity
from sb3_hds.twins.mujoco.dynamics import (
    Frames,
    Tree,
    frames,
    inverse_dynamics,
    mass_matrix,
    slopes,
)
from sb3_hds.twins.mujoco.mechanism import BALL, FREE, Link, Mechanism, Place
from sb3_hds.twins.mujoco.parameters import gravity_of, held_of, inertias_of, of_plant
from sb3_hds.twins.mujoco.quaternions import turn_between, turning

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

    so that neither the mass matrix nor its factors are differentiated, and all directions share
    the slopes of inverse dynamics, which are written down.

    Source: Carpentier and Mansard, *Analytical derivatives of rigid body dynamics algorithms*,
    Robotics: Science and Systems 2018.

    :param payload: where an unknown mass may be
    :param masses: whether mass, centre and inertia of each body are parameters
    """

    def __init__(self, mechanism: Mechanism, payload: Place | None, masses: bool) -> None:
        self.mechanism, self.payload, self.masses = mechanism, payload, masses
        self.parameters = of_plant(mechanism, payload, masses)
        self.tree_of = cache(lambda dtype: Tree(mechanism.links, dtype))
        self._held = held_of(mechanism)
        powers = [row[1:] for link in mechanism.links for row in link.damping]
        #: coefficients of powers of the speed, from the second on, by degree of freedom
        self._powers = np.array(list(zip_longest(*powers, fillvalue=0.0)))
        self.mass_matrix = jax.jit(self._mass_matrix)
        self.bias = jax.jit(self._bias)
        self._solved = jax.jit(self._with_derivative())

    def acceleration(
        self, q: Position, v: Velocity, force: Force, coupling: MassMatrix, params: Params
    ) -> Velocity:
        r"""
        :param force: generalised, of all but the equation's own
        :param coupling: :math:`C`, symmetric: what an implicit integrator adds to the mass matrix
        :return: the acceleration
        """
        return self._solved(q, v, force, coupling, self._typed(params, q))

    def resistance(self, v: Velocity, params: Params) -> tuple[Force, Force]:
        """
        :return: the force of damping and dry friction at each joint, per speed; and what its slope
            by the speed is taken to be, which is the force itself, per speed, for dry friction
        """
        p, powers = self._typed(params, v), self._powers.astype(v.dtype)
        steady = self._by_dof(p, "damping", v) + self._by_dof(p, "frictionloss", v) * _tanh_per(v)
        size, power = jnp.abs(v), jnp.ones_like(v)
        slope = steady
        for order, coefficients in enumerate(powers, 2):
            power = power * size
            steady, slope = steady + coefficients * power, slope + order * coefficients * power
        return steady, slope

    def _mass_matrix(self, q: Position, params: Params) -> MassMatrix:
        p = self._typed(params, q)
        matrix = mass_matrix(self.tree_of(q.dtype), self._frames(q, p))
        return matrix + jnp.diag(self._by_dof(p, "armature", q))

    def _bias(self, q: Position, v: Velocity, params: Params) -> Force:
        p = self._typed(params, q)
        load = self._inverse(self._frames(q, p), v, p)
        return load + self._joints(q, v, p)

    def _solve(
        self, q: Array, v: Array, force: Array, coupling: Array, p: Any
    ) -> tuple[Array, Array]:
        """The acceleration, and the Cholesky factor of the matrix that was solved."""
        factor = lax.linalg.cholesky(self._mass_matrix(q, p) + coupling, symmetrize_input=False)
        return _solved(factor, force - self._bias(q, v, p)), factor

    def _with_derivative(self) -> Any:
        """Forward dynamics, whose derivative is that of inverse dynamics."""

        @jax.custom_jvp
        def acceleration(q: Array, v: Array, force: Array, coupling: Array, p: Any) -> Array:
            return self._solve(q, v, force, coupling, p)[0]

        def rule(primals: Any, tangents: Any) -> tuple[Array, Array]:
            q, v, _, coupling, p = primals
            dq, dv, df = tangents[:3]
            a, factor = self._solve(*primals)
            right = jnp.zeros_like(v) if _zero(df) else df
            if not (_zero(dq) and _zero(dv)):
                gravity = gravity_of(self.mechanism, p)
                tree, at = self.tree_of(q.dtype), self._frames(q, p)
                by_q, by_v = slopes(tree, at, v, gravity, a)
                if not _zero(dq):
                    right = right - jnp.sum(by_q * self.way_of(q, dq), -1)
                if not _zero(dv):
                    right = right - jnp.sum(by_v * dv, -1)
            inertial = not all(map(_zero, jax.tree.leaves(tangents[4])))

            def rest(there: Any) -> Array:
                """What :func:`slopes` leaves out."""
                q_there, v_there, coupling, p = there
                load = self._joints(q_there, v_there, p) + self._by_dof(p, "armature", q) * a
                if inertial:
                    load = load + self._inverse(self._frames(q, p), v, p, a)
                return load + jnp.sum(coupling * a, -1)

            more = _along(rest, (q, v, coupling, p), (dq, dv, *tangents[3:]))
            right = right if more is None else right - more
            return a, _solved(factor, right)

        acceleration.defjvp(rule, symbolic_zeros=True)
        return acceleration

    def way_of(self, q: Position, change: Array) -> Array:
        """:return: the ways and turns that a change of the numbers of a position makes"""
        if not self.tree_of(q.dtype).curved:
            return change
        parts = []
        for link in self.mechanism.links:
            start = link.q + (3 if link.kind == FREE else 0)
            if link.kind in (BALL, FREE):
                parts.append(change[link.q : start])
                turn = slice(start, start + 4)
                parts.append(turning(q[turn], change[turn]))
            else:
                parts.append(change[link.q : link.q + 1])
        return jnp.concatenate(parts)

    # --- its parts

    def _typed(self, params: Params, like: Array) -> dict[str, Array]:
        return {name: jnp.asarray(params[name], like.dtype) for name in self.parameters}

    def _frames(self, q: Array, p: Any) -> Frames:
        inertias = inertias_of(self.mechanism, self.payload, self.masses, p)
        return frames(self.tree_of(q.dtype), _unstacked(q), inertias, self._held)

    def _inverse(self, at: Frames, v: Array, p: Any, a: Array | None = None) -> Array:
        gravity = gravity_of(self.mechanism, p)
        return inverse_dynamics(self.tree_of(v.dtype), at, v, gravity, a)

    def _by_dof(self, p: Any, name: str, like: Array) -> Array:
        """A parameter of joints, zero where they have none."""
        zero = jnp.zeros((), like.dtype)
        links = self.mechanism.links
        return jnp.stack([p.get(f"{x.joint}_{name}", zero) for x in links for _ in x.dofs])

    def _joints(self, q: Array, v: Array, p: Any) -> Array:
        """The load of damping, dry friction and springs."""
        load = self.resistance(v, p)[0] * v
        for link in self.mechanism.links:
            if link.stiffness:
                spring = _spring(link, q, p.get(f"{link.joint}_stiffness", link.stiffness[0]))
                load = load.at[np.array(link.dofs)].add(spring)
        return load


def _spring(link: Link, q: Array, linear: Any) -> Array:
    """The load of a joint's spring, by degree of freedom."""

    def pull(way: Array, far: Array) -> Array:
        stiffness, power = linear, far
        for coefficient in link.stiffness[1:]:
            stiffness, power = stiffness + coefficient * power, power * far
        return stiffness * way

    rest = jnp.asarray(link.rest, q.dtype)
    here = q[link.q : link.q + len(link.rest)]
    if link.kind not in (BALL, FREE):
        return pull(here - rest, here - rest)
    turn = turn_between(here[-4:], rest[-4:])
    ways = [here[:3] - rest[:3], turn] if link.kind == FREE else [turn]
    # Only a spring of higher order asks how far it is stretched, which has a kink at rest.
    curved = len(link.stiffness) > 1
    size = lambda way: jnp.sqrt(jnp.sum(way**2)) if curved else jnp.zeros(())  # noqa: E731
    return jnp.concatenate([pull(way, size(way)) for way in ways])


def _tanh_per(v: Array) -> Array:
    """``tanh(v / w) / v`` for ``w = _STANDSTILL``, smooth at standstill."""
    x = v / _STANDSTILL
    near = x**2 < _SMALL
    away = jnp.where(near, 1.0, x)
    return jnp.where(near, 1.0 - x**2 / 3.0, jnp.tanh(away) / away) / _STANDSTILL


def _solved(factor: Array, right: Array) -> Array:
    """``x`` of ``L L^T x = right``."""
    half = lax.linalg.triangular_solve(factor, right[:, None], left_side=True, lower=True)
    whole = lax.linalg.triangular_solve(
        factor, half, left_side=True, lower=True, transpose_a=True
    )
    return whole[:, 0]


def _zero(tangent: Any) -> bool:
    return isinstance(tangent, SymbolicZero)


def _along(function: Callable[[Any], Array], where: Any, ways: Any) -> Array | None:
    """The derivative of a function of a tree, along those ways that are not nothing."""
    here, form = jax.tree.flatten(where)
    leaves = jax.tree.leaves(ways)
    moving = [i for i, way in enumerate(leaves) if not _zero(way)]
    if not moving:
        return None

    def moved(*numbers: Array) -> Array:
        there = dict(enumerate(here)) | dict(zip(moving, numbers, strict=True))
        return function(jax.tree.unflatten(form, list(there.values())))

    return jax.jvp(moved, [here[i] for i in moving], [leaves[i] for i in moving])[1]


def _unstacked(x: Array) -> list[Array]:
    return [lax.squeeze(part, (0,)) for part in lax.split(x, (1,) * x.shape[0])]
