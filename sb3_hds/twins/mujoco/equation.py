"""The equation of motion of a mechanism, and its derivative."""

from collections.abc import Collection
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
from sb3_hds.core.numerics.linear import Factor, factorised, solve_factored
from sb3_hds.twins.mujoco.mechanism import FREE, Link, Mechanism, Place
from sb3_hds.twins.mujoco.parameters import bodies_of, compensated, gravity_of, of_plant, typical
from sb3_hds.twins.mujoco.rigid_body.dynamics import (
    Configuration,
    Tree,
    configuration,
    derivatives,
    inverse_dynamics,
    mass_matrix,
)
from sb3_hds.twins.mujoco.rigid_body.quaternions import turn_between, turning

# Speed over which dry friction builds up [rad/s] or [m/s].
_STANDSTILL = 0.01
# Parameters of joints besides their armature.
_OF_JOINTS = ("damping", "frictionloss", "stiffness")
# Squared x below which two terms of the series of tanh(x) / x suffice.
_SMALL = 1e-6


class Equation:
    r"""
    :math:`M(q)\,\dot v + c(q, v) = \tau`, with the model's damping, dry friction and springs in
    :math:`c`.

    The derivative of :math:`\dot v = (M + C)^{-1} (\tau - c)` is that of inverse dynamics:

    .. math:: (M + C)\,d\dot v = d\tau - dC\,\dot v
              - \frac{\partial (M \dot v + c)}{\partial (q, v, p)}\,d(q, v, p)

    so neither the mass matrix nor its factors are differentiated, and all directions share the
    analytical derivatives of inverse dynamics.

    Source: Carpentier and Mansard, *Analytical derivatives of rigid body dynamics algorithms*,
    Robotics: Science and Systems 2018.

    :param payload: place of an unknown mass
    :param masses: names of bodies whose mass, centre and inertia are parameters
    """

    def __init__(
        self, mechanism: Mechanism, payload: Place | None, masses: Collection[str]
    ) -> None:
        self.mechanism, self.payload, self.masses = mechanism, payload, masses
        self.typical = typical(mechanism)
        self.parameters = of_plant(mechanism, self.typical, payload, masses)
        joints = {f"{link.joint}_{name}" for link in mechanism.links for name in _OF_JOINTS}
        self._inertial = tuple(name for name in self.parameters if name not in joints)
        self._compensated = compensated(mechanism)
        powers = [row[1:] for link in mechanism.links for row in link.damping]
        #: damping coefficients of the speed squared, cubed, ..., by degree of freedom
        self._powers = np.array(list(zip_longest(*powers, fillvalue=0.0)))
        self._tree_of = cache(lambda dtype: Tree(mechanism.links, dtype))
        self.mass_matrix = jax.jit(self._mass_matrix)
        self._inverse_dynamics = jax.jit(self._inverse)
        self._forward_dynamics = jax.jit(self._with_derivative())

    def bias(self, q: Position, v: Velocity, params: Params, step: float) -> Force:
        """
        :param step: see :meth:`resistance`
        :return: the force at which the acceleration is zero
        """
        load = self._inverse_dynamics(q, v, self._typed(params, q))
        return load + self._load_of_joints(q, v, params, step)

    def acceleration(
        self,
        q: Position,
        v: Velocity,
        force: Force,
        coupling: MassMatrix,
        params: Params,
        step: float,
    ) -> Velocity:
        r"""
        :param force: generalised, besides damping, friction and springs
        :param coupling: :math:`C`, symmetric: what an implicit integrator adds to the mass matrix
        :param step: see :meth:`resistance`
        :return: the acceleration
        """
        force = force - self._load_of_joints(q, v, params, step)
        return self._forward_dynamics(q, v, force, coupling, self._typed(params, q))

    def resistance(self, v: Velocity, params: Params, step: float) -> tuple[Force, Force]:
        """
        :param step: length of the explicit step [s]: dry friction is smoothed over the speed that
            it can stop; 0 if the integrator takes friction at the end of its step
        :return: damping and dry friction of each joint, per speed; and their derivative by the
            speed for an implicit integrator: for dry friction the secant, which never overshoots
        """
        powers = self._powers.astype(v.dtype)
        dry = self._by_dof(params, "frictionloss", v)
        width = dry * (step / self.typical.inertia).astype(v.dtype)
        steady = self._by_dof(params, "damping", v) + dry * _tanh_per(v, width)
        size, power, slope = jnp.abs(v), jnp.ones_like(v), steady
        for order, coefficients in enumerate(powers, 2):
            power = power * size
            steady, slope = steady + coefficients * power, slope + order * coefficients * power
        return steady, slope

    def _mass_matrix(self, q: Position, params: Params) -> MassMatrix:
        p = self._typed(params, q)
        matrix = mass_matrix(self._tree_of(q.dtype), self._configuration(q, p))
        return matrix + jnp.diag(self._by_dof(p, "armature", q))

    def _solve(
        self, q: Array, v: Array, force: Array, coupling: Array, p: Any
    ) -> tuple[Array, Factor]:
        """The acceleration, and the factor of the matrix that was solved."""
        factor = factorised(self._mass_matrix(q, p) + coupling)
        return solve_factored(factor, force - self._inverse(q, v, p)), factor

    def _with_derivative(self) -> Any:
        """Forward dynamics with the derivative of inverse dynamics."""

        @jax.custom_jvp
        def acceleration(q: Array, v: Array, force: Array, coupling: Array, p: Any) -> Array:
            return self._solve(q, v, force, coupling, p)[0]

        def rule(primals: Any, tangents: Any) -> tuple[Array, Array]:
            q, v, _, _, p = primals
            dq, dv, df, dc, dp = tangents
            a, factor = self._solve(*primals)
            right = jnp.zeros_like(v) if _zero(df) else df
            if not (_zero(dq) and _zero(dv)):
                tree, gravity = self._tree_of(q.dtype), gravity_of(self.mechanism, p)
                by_q, by_v = derivatives(tree, self._configuration(q, p), v, gravity, a)
                if not _zero(dq):
                    right = right - jnp.sum(by_q * self.tangent_of(q, dq), -1)
                if not _zero(dv):
                    right = right - jnp.sum(by_v * dv, -1)
            if not _zero(dc):
                right = right - jnp.sum(dc * a, -1)
            changes = {name: change for name, change in dp.items() if not _zero(change)}
            if changes:
                values = {name: p[name] for name in changes}
                force = lambda own: self._inverse(q, v, p | own, a)  # noqa: E731
                right = right - jax.jvp(force, (values,), (changes,))[1]
            return a, solve_factored(factor, right)

        acceleration.defjvp(rule, symbolic_zeros=True)
        return acceleration

    def tangent_of(self, q: Position, change: Array) -> Array:
        """:return: the tangent vector, with rotation vectors, of a change of position numbers"""
        if not self._tree_of(q.dtype).has_balls:
            return change
        parts = []
        for link in self.mechanism.links:
            parts.append(change[link.straight])
            if link.quaternion:
                parts.append(turning(q[link.quaternion], change[link.quaternion]))
        return jnp.concatenate(parts)

    # --- terms

    def _typed(self, params: Params, like: Array) -> dict[str, Array]:
        return {name: jnp.asarray(params[name], like.dtype) for name in self._inertial}

    def _configuration(self, q: Array, p: Any) -> Configuration:
        bodies = bodies_of(self.mechanism, self.payload, self.masses, p)
        return configuration(self._tree_of(q.dtype), _unstacked(q), bodies, self._compensated)

    def _inverse(self, q: Array, v: Array, p: Any, a: Array | None = None) -> Array:
        """Inverse dynamics, with armatures."""
        at, gravity = self._configuration(q, p), gravity_of(self.mechanism, p)
        force = inverse_dynamics(self._tree_of(v.dtype), at, v, gravity, a)
        return force if a is None else force + self._by_dof(p, "armature", v) * a

    def _load_of_joints(self, q: Array, v: Array, params: Params, step: float) -> Array:
        """Damping, dry friction and springs."""
        load = self.resistance(v, params, step)[0] * v
        for link in self.mechanism.links:
            if link.stiffness:
                linear = params.get(f"{link.joint}_stiffness", link.stiffness[0])
                load = load.at[np.array(link.dofs)].add(_spring(link, q, linear))
        return load

    def _by_dof(self, p: Any, name: str, like: Array) -> Array:
        """A parameter of joints by degree of freedom; zero for joints without it."""
        values = [p.get(f"{x.joint}_{name}", 0.0) for x in self.mechanism.links for _ in x.dofs]
        return jnp.stack([jnp.asarray(value, like.dtype) for value in values])


def _spring(link: Link, q: Array, linear: Any) -> Array:
    """The load of a joint's spring, by degree of freedom."""

    def pull(deflection: Array, size: Array) -> Array:
        stiffness, power = linear, size
        for coefficient in link.stiffness[1:]:
            stiffness, power = stiffness + coefficient * power, power * size
        return stiffness * deflection

    rest, here = jnp.asarray(link.rest, q.dtype), q[link.in_q]
    if not link.quaternion:
        return pull(here - rest, here - rest)
    turn = turn_between(here[-4:], rest[-4:])
    deflections = [here[:3] - rest[:3], turn] if link.kind == FREE else [turn]
    # Only nonlinear springs need the size of a deflection, which has a kink at rest.
    nonlinear = len(link.stiffness) > 1
    size = lambda x: jnp.sqrt(jnp.sum(x**2)) if nonlinear else jnp.zeros(())  # noqa: E731
    return jnp.concatenate([pull(x, size(x)) for x in deflections])


def _tanh_per(v: Array, width: Array) -> Array:
    """``tanh(v / w) / v``, smooth at standstill, where ``w`` is at least ``_STANDSTILL``."""
    w = jnp.maximum(width, _STANDSTILL)
    x = v / w
    near = x**2 < _SMALL
    away = jnp.where(near, 1.0, x)
    return jnp.where(near, 1.0 - x**2 / 3.0, jnp.tanh(away) / away) / w


def _zero(tangent: Any) -> bool:
    return isinstance(tangent, SymbolicZero)


def _unstacked(x: Array) -> list[Array]:
    return [lax.squeeze(part, (0,)) for part in lax.split(x, (1,) * x.shape[0])]
