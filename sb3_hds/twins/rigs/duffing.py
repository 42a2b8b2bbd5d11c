"""Duffing's oscillator."""

import math

import jax.numpy as jnp

from sb3_hds.core import Actuator, Joint, Parameter, State
from sb3_hds.core.types import Action, Force, MassMatrix, Params, Position, Velocity
from sb3_hds.twins.rigs.rig import Rig


class Duffing(Rig):
    r"""
    A mass on a hardening spring, pushed by a force.

    .. math:: m\,\dot v + b\,v + k\,q + k_3\,q^3 = u

    A negative :math:`k` with a positive :math:`k_3` gives two stable equilibria.

    Source: Kovacic and Brennan, *The Duffing Equation*, Wiley 2011, section 1.1.
    """

    name = "Duffing"
    dt = 0.02
    joints = (Joint("mass", "m"),)
    actuators = (Actuator("force", "N", -math.inf, math.inf),)
    parameters = {
        "mass": Parameter(null=1.0, scale=0.1, unit="kg", lower=1e-6),
        "damping": Parameter(null=0.1, scale=0.05, unit="N s/m", lower=0.0),
        "stiffness": Parameter(null=1.0, scale=0.2, unit="N/m"),
        "cubic_stiffness": Parameter(null=1.0, scale=0.2, unit="N/m3"),
    }
    native_effects = {
        ("viscous_friction", 0): {"b": "damping"},
        ("cubic_stiffness", 0): {"k3": "cubic_stiffness"},
    }

    def actuate(self, state: State, action: Action, params: Params) -> Force:
        return action

    def mass_matrix(self, q: Position, params: Params) -> MassMatrix:
        return (params["mass"] + 0.0 * q).reshape(1, 1)

    def bias(self, q: Position, v: Velocity, params: Params) -> Force:
        spring = params["stiffness"] * q + params["cubic_stiffness"] * q**3
        return jnp.asarray(params["damping"], v.dtype) * v + spring
