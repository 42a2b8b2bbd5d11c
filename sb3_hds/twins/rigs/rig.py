"""Machines on a test bench: joints are measured directly, and there is no task."""

import math
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray

from sb3_hds.core import AnalyticTwin, Channel, Obs, Parameter, Params, State, rk4
from sb3_hds.errors import ParameterError

#: rotation of gravity in the plane of a pendulum, in the direction of its angle
TILT = Parameter(null=0.0, scale=0.02, unit="rad", lower=-0.5 * math.pi, upper=0.5 * math.pi)


class Rig(AnalyticTwin):
    """
    Abstract: a machine whose joints are measured directly, without a reward.

    Runge-Kutta steps approximate continuous time. Recordings begin anywhere, so :meth:`initial` is
    only for trials: at rest, within 0.1 rad or m of zero. If velocities are not observed,
    :meth:`infer` sets them to zero.

    :param observe: ``"q"`` for positions only, as of encoders, ``"qv"`` for velocities too
    :param settings: as for every twin
    :raises ParameterError: for another ``observe``, or a ``tip`` that is not a length
    """

    dt = 0.01
    substeps = 2
    integrator = staticmethod(rk4)
    #: valid values of ``observe``
    observable: tuple[str, ...] = ("q", "qv")
    observed: str
    #: option of pendulums: distance of a payload from the last joint [m]
    tip: float

    def __init__(self, *, observe: str = "qv", **settings: Any) -> None:
        super().__init__(**settings)
        if observe not in self.observable:
            allowed = " or ".join(map(repr, self.observable))
            raise ParameterError(f"{self.name} can observe {allowed}, got {observe!r}.")
        tip = getattr(self, "tip", 1.0)
        if not (isinstance(tip, int | float) and 0.0 < tip < math.inf):
            raise ParameterError(f"tip of {self.name} must be a length above 0 m, got {tip!r}.")
        self.observed = observe
        self.channels = self.channels_of(observe)

    def channels_of(self, observe: str) -> tuple[Channel, ...]:
        """:return: named after the joints, positions first"""
        positions = tuple(Channel(f"{joint.name}_position", joint.unit) for joint in self.joints)
        if observe == "q":
            return positions
        speeds = (Channel(f"{joint.name}_velocity", f"{joint.unit}/s") for joint in self.joints)
        return (*positions, *speeds)

    def initial(self, key: PRNGKeyArray, params: Params) -> State:
        q = jax.random.uniform(key, (len(self.joints),), minval=-0.1, maxval=0.1)
        return State(q, jnp.zeros_like(q), {})

    def infer(self, obs: Obs, params: Params) -> State:
        dof = len(self.joints)
        q = obs[:dof]
        return State(q, obs[dof:] if self.observed == "qv" else jnp.zeros_like(q), {})

    def observe(self, state: State, params: Params) -> Obs:
        return jnp.concatenate([state.q, state.v]) if self.observed == "qv" else state.q

    def to_spec(self) -> dict[str, Any]:
        spec = super().to_spec()
        return spec | {"options": spec["options"] | {"observe": self.observed}}

    def structure(self) -> tuple[Any, ...]:
        return (*super().structure(), self.observed)
