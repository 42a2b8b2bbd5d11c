"""Twin of ``sb3_hds/CartPoleSwingUp-v0``: ``CartPole-v1`` as a swing-up task."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from sb3_hds.core import Actuator, Channel, Joint, Parameter, State, rk4, semi_implicit_euler
from sb3_hds.core.types import Action, Force, MassMatrix, Obs, Params, Position, Scalar, Velocity
from sb3_hds.twins.rigs.rig import Rig

_MAX_FORCE = 10.0  # [N]


class CartPole(Rig):
    r"""
    A pole on a cart, swung up by pushing the cart.

    .. math::
        (m_c + m_p)\,\ddot x + m_p l\,(\dot\omega \cos\theta - \omega^2 \sin\theta) &= u \\
        m_p l\,\ddot x \cos\theta + \tfrac{4}{3} m_p l^2\,\dot\omega - m_p g l \sin\theta &= 0

    with :math:`l` half the length of the pole; :math:`\theta = 0` is upright. Reproduces
    ``gymnasium/envs/classic_control/cartpole.py`` with ``kinematics_integrator = "semi-implicit"``
    and any force in [-10, 10] N, without ends of the track and without termination. The reward is
    smooth:

    .. math::
        r = -2\,(1 - \cos\theta) - 0.2\,x^2
            - 0.01\,\big(\dot x^2 + \omega^2 + (u / 10\,\mathrm{N})^2\big)

    :param observe: ``"task"`` for the environment's observations and integrator; ``"q"`` or
        ``"qv"`` for a rig in continuous time without limits of the force
    """

    name = "CartPole"
    env_id = "sb3_hds/CartPoleSwingUp-v0"
    dt = 0.02
    substeps = 1
    integrator = staticmethod(semi_implicit_euler)
    observable = ("task", "q", "qv")
    max_episode_steps = 250
    joints = (Joint("track", "m"), Joint("hinge", "rad"))
    actuators = (Actuator("force", "N", -_MAX_FORCE, _MAX_FORCE),)
    channels = (
        Channel("position", "m"),
        Channel("cos", "1", -1.0, 1.0),
        Channel("sin", "1", -1.0, 1.0),
        Channel("speed", "m/s"),
        Channel("rate", "rad/s"),
    )
    parameters = {
        "gravity": Parameter(null=9.8, scale=0.5, unit="m/s2", lower=0.0),
        "cart_mass": Parameter(null=1.0, scale=0.2, unit="kg", lower=1e-3),
        "pole_mass": Parameter(null=0.1, scale=0.02, unit="kg", lower=1e-4),
        "half_length": Parameter(null=0.5, scale=0.1, unit="m", lower=1e-3),
    }

    def __init__(self, *, observe: str = "task", **settings: Any) -> None:
        rig = observe != "task"
        super().__init__(observe=observe, **({"substeps": 4} if rig else {}) | settings)
        if rig:
            self.integrator = rk4

    def channels_of(self, observe: str) -> tuple[Channel, ...]:
        return type(self).channels if observe == "task" else super().channels_of(observe)

    def initial(self, key: PRNGKeyArray, params: Params) -> State:
        """Uniform: position within 0.5 m, any angle, speed within 0.5 m/s, rate within 1 rad/s."""
        high = jnp.array([[0.5, jnp.pi], [0.5, 1.0]])
        start = jax.random.uniform(key, (2, 2), minval=-high, maxval=high)
        return State(start[0], start[1], {})

    def infer(self, obs: Obs, params: Params) -> State:
        if self.observed != "task":
            return super().infer(obs, params)
        angle = jnp.arctan2(obs[2:3], obs[1:2])
        return State(jnp.concatenate([obs[:1], angle]), obs[3:], {})

    def observe(self, state: State, params: Params) -> Obs:
        if self.observed != "task":
            return super().observe(state, params)
        angle = state.q[1:]
        return jnp.concatenate([state.q[:1], jnp.cos(angle), jnp.sin(angle), state.v])

    def actuate(self, state: State, action: Action, params: Params) -> Force:
        force = action[0]
        if self.observed == "task":
            force = jnp.clip(force, -_MAX_FORCE, _MAX_FORCE)
        return jnp.stack([force, jnp.zeros_like(force)])

    def mass_matrix(self, q: Position, params: Params) -> MassMatrix:
        mass, length = params["pole_mass"], params["half_length"]
        both = mass * length * jnp.cos(q[1])
        cart = params["cart_mass"] + mass + 0.0 * both
        pole = 4.0 / 3.0 * mass * length**2 + 0.0 * both
        return jnp.stack([cart, both, both, pole]).reshape(2, 2)

    def bias(self, q: Position, v: Velocity, params: Params) -> Force:
        lever = params["pole_mass"] * params["half_length"] * jnp.sin(q[1])
        return jnp.stack([-lever * v[1] ** 2, -lever * params["gravity"]])

    def reward(self, state: State, action: Action, next_state: State, params: Params) -> Scalar:
        (x, angle), force = state.q, jnp.clip(action[0] / _MAX_FORCE, -1.0, 1.0)
        effort = jnp.sum(state.v**2) + force**2
        return -2.0 * (1.0 - jnp.cos(angle)) - 0.2 * x**2 - 0.01 * effort

    def sketch(self, state: State, params: Params) -> Float[Array, "points 2"]:
        """The cart and the pole."""
        x, angle = state.q
        tip = 2.0 * params["half_length"] * jnp.stack([jnp.sin(angle), jnp.cos(angle)])
        cart = jnp.array([[-0.2, 0.0], [0.2, 0.0], [0.0, 0.0]])
        return jnp.concatenate([cart, tip[None]]) + jnp.stack([x, jnp.zeros_like(x)])
