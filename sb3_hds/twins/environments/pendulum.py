"""Twin of Gymnasium's ``Pendulum-v1``."""

from typing import Any, Self

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from sb3_hds.core import Actuator, AnalyticTwin, Channel, Joint, Parameter, State
from sb3_hds.core.types import Action, Force, MassMatrix, Obs, Params, Position, Scalar, Velocity

_MAX_SPEED = 8.0  # [rad/s]
_MAX_TORQUE = 2.0  # [N m]


class Pendulum(AnalyticTwin):
    r"""
    A rod swung up by a torque at its pivot.

    .. math:: \tfrac{1}{3} m l^2 \dot\omega = \tfrac{1}{2} m g l \sin\theta + u

    Reproduces ``gymnasium/envs/classic_control/pendulum.py`` step for step: semi-implicit Euler,
    torque clipped to 2 N m, speed clipped to 8 rad/s; :math:`\theta = 0` is upright. Where a clip
    is active, the derivative is zero. The reward wraps the angle, so its gradient jumps at the
    bottom.
    """

    name = "Pendulum"
    env_id = "Pendulum-v1"
    dt = 0.05
    max_episode_steps = 200
    joints = (Joint("hinge", "rad"),)
    actuators = (Actuator("torque", "N m", -_MAX_TORQUE, _MAX_TORQUE),)
    channels = (
        Channel("cos", "1", -1.0, 1.0),
        Channel("sin", "1", -1.0, 1.0),
        Channel("speed", "rad/s", -_MAX_SPEED, _MAX_SPEED),
    )
    parameters = {
        "gravity": Parameter(null=10.0, scale=0.5, unit="m/s2", lower=0.0),
        "mass": Parameter(null=1.0, scale=0.2, unit="kg", lower=1e-3),
        "length": Parameter(null=1.0, scale=0.2, unit="m", lower=1e-3),
    }

    @classmethod
    def from_env(cls, env: Any) -> Self:
        env = env.unwrapped
        return cls(gravity=env.g, mass=env.m, length=env.l, dt=env.dt)

    def initial(self, key: PRNGKeyArray, params: Params) -> State:
        """Angle uniform in [-pi, pi], speed uniform in [-1, 1] rad/s."""
        high = jnp.array([jnp.pi, 1.0])
        start = jax.random.uniform(key, (2,), minval=-high, maxval=high)
        return State(start[:1], start[1:], {})

    def infer(self, obs: Obs, params: Params) -> State:
        return State(jnp.arctan2(obs[1:2], obs[0:1]), obs[2:3], {})

    def observe(self, state: State, params: Params) -> Obs:
        return jnp.concatenate([jnp.cos(state.q), jnp.sin(state.q), state.v])

    def actuate(self, state: State, action: Action, params: Params) -> Force:
        return jnp.clip(action, -_MAX_TORQUE, _MAX_TORQUE)

    def mass_matrix(self, q: Position, params: Params) -> MassMatrix:
        return (params["mass"] * params["length"] ** 2 / 3.0) * jnp.ones((1, 1), q.dtype)

    def bias(self, q: Position, v: Velocity, params: Params) -> Force:
        return -0.5 * params["mass"] * params["gravity"] * params["length"] * jnp.sin(q)

    def limit_velocity(self, v: Velocity) -> Velocity:
        return jnp.clip(v, -_MAX_SPEED, _MAX_SPEED)

    def reward(self, state: State, action: Action, next_state: State, params: Params) -> Scalar:
        angle = (state.q + jnp.pi) % (2.0 * jnp.pi) - jnp.pi
        torque = jnp.clip(action, -_MAX_TORQUE, _MAX_TORQUE)
        return -jnp.sum(angle**2 + 0.1 * state.v**2 + 0.001 * torque**2)

    def sketch(self, state: State, params: Params) -> Float[Array, "points 2"]:
        tip = params["length"] * jnp.concatenate([jnp.sin(state.q), jnp.cos(state.q)])
        return jnp.stack([jnp.zeros_like(tip), tip])
