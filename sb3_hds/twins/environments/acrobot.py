"""Twin of ``sb3_hds/AcrobotContinuous-v0``: Gymnasium's ``Acrobot-v1`` with a continuous torque."""

import math
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from sb3_hds.core import Actuator, AnalyticTwin, Channel, Flag, Joint, Parameter, State, rk4
from sb3_hds.core.types import Action, Force, MassMatrix, Obs, Params, Position, Scalar, Velocity

_MAX_SPEED_1 = 4.0 * math.pi  # [rad/s]
_MAX_SPEED_2 = 9.0 * math.pi  # [rad/s]
_GOAL = 1.0  # height of the tip in link lengths, above the pivot


class Acrobot(AnalyticTwin):
    r"""
    Two links that hang from a pivot and are swung up by a torque at the joint between them.

    .. math::
        d_1 \ddot\theta_1 + d_2 \ddot\theta_2 + \phi_1 &= 0 \\
        d_2 \ddot\theta_1 + (m_2 c_2^2 + I_2)\,\ddot\theta_2
        + m_2 l_1 c_2 \dot\theta_1^2 \sin\theta_2 + \phi_2 &= u

    with :math:`d_1, d_2, \phi_1, \phi_2` of Sutton and Barto; :math:`\theta = 0` hangs down.
    Reproduces the dynamics of ``gymnasium/envs/classic_control/acrobot.py``
    (``book_or_nips = "book"``) for any torque in [-1, 1] N m: one RK4 step, speeds clipped
    afterwards. Where a clip is active, the derivative is zero. Angles are not wrapped, so that
    trajectories stay smooth; observations are the same.

    As in Gymnasium, the goal is :math:`y = -\cos\theta_1 - \cos(\theta_1 + \theta_2) > 1`, for any
    lengths of the links, and each step before it costs one. This reward has no gradient, so
    planning adds the gain of a potential. With the mechanical energy :math:`e` as a fraction of
    that of the lowest goal configuration at rest, relative to hanging, and the softplus
    :math:`\operatorname{sp}`,

    .. math::
        \Phi = -30 \cdot 0.1 \operatorname{sp}\!\Big(\frac{1.2 - e}{0.1}\Big)
               + 5\,\sigma\!\Big(\frac{y - 1}{0.25}\Big), \qquad
        r_\text{plan} = r + \Phi(s') - \Phi(s)

    The gains add up to nearly the same number on every path to the goal, so plans differ in time.
    """

    name = "Acrobot"
    env_id = "sb3_hds/AcrobotContinuous-v0"
    dt = 0.2
    integrator = staticmethod(rk4)
    max_episode_steps = 500
    reward_has_gradient = False
    joints = (Joint("shoulder", "rad"), Joint("elbow", "rad"))
    actuators = (Actuator("torque", "N m", -1.0, 1.0),)
    channels = (
        Channel("cos1", "1", -1.0, 1.0),
        Channel("sin1", "1", -1.0, 1.0),
        Channel("cos2", "1", -1.0, 1.0),
        Channel("sin2", "1", -1.0, 1.0),
        Channel("rate1", "rad/s", -_MAX_SPEED_1, _MAX_SPEED_1),
        Channel("rate2", "rad/s", -_MAX_SPEED_2, _MAX_SPEED_2),
    )
    parameters = {
        "gravity": Parameter(null=9.8, scale=0.5, unit="m/s2", lower=1e-3),
        "link1_mass": Parameter(null=1.0, scale=0.2, unit="kg", lower=1e-3),
        "link1_length": Parameter(null=1.0, scale=0.2, unit="m", lower=1e-3),
        "link1_com": Parameter(null=0.5, scale=0.1, unit="m", lower=1e-3),
        "link1_inertia": Parameter(null=1.0, scale=0.2, unit="kg m2", lower=1e-6),
        "link2_mass": Parameter(null=1.0, scale=0.2, unit="kg", lower=1e-3),
        "link2_com": Parameter(null=0.5, scale=0.1, unit="m", lower=1e-3),
        "link2_inertia": Parameter(null=1.0, scale=0.2, unit="kg m2", lower=1e-6),
    }

    def initial(self, key: PRNGKeyArray, params: Params) -> State:
        """Angles and speeds uniform in [-0.1, 0.1]."""
        start = jax.random.uniform(key, (2, 2), minval=-0.1, maxval=0.1)
        return State(start[0], start[1], {})

    def infer(self, obs: Obs, params: Params) -> State:
        return State(jnp.arctan2(obs[1:4:2], obs[0:3:2]), obs[4:], {})

    def observe(self, state: State, params: Params) -> Obs:
        cos, sin = jnp.cos(state.q), jnp.sin(state.q)
        return jnp.concatenate([jnp.stack([cos, sin], -1).ravel(), state.v])

    def actuate(self, state: State, action: Action, params: Params) -> Force:
        torque = jnp.clip(action[0], -1.0, 1.0)
        return jnp.stack([jnp.zeros_like(torque), torque])

    def mass_matrix(self, q: Position, params: Params) -> MassMatrix:
        m_1, c_1, i_1 = params["link1_mass"], params["link1_com"], params["link1_inertia"]
        m_2, c_2, i_2 = params["link2_mass"], params["link2_com"], params["link2_inertia"]
        elbow = m_2 * c_2**2 + i_2
        coupling = m_2 * params["link1_length"] * c_2 * jnp.cos(q[1])
        shoulder = m_1 * c_1**2 + i_1 + m_2 * params["link1_length"] ** 2 + elbow
        both = elbow + coupling
        return jnp.stack([shoulder + 2.0 * coupling, both, both, elbow + 0.0 * both]).reshape(2, 2)

    def bias(self, q: Position, v: Velocity, params: Params) -> Force:
        weight_1, weight_2 = _weights(params)
        spin = params["link2_mass"] * params["link1_length"] * params["link2_com"] * jnp.sin(q[1])
        elbow = weight_2 * jnp.sin(q[0] + q[1])
        shoulder = weight_1 * jnp.sin(q[0]) + elbow - spin * v[1] * (v[1] + 2.0 * v[0])
        return jnp.stack([shoulder, spin * v[0] ** 2 + elbow])

    def limit_velocity(self, v: Velocity) -> Velocity:
        highest = jnp.array([_MAX_SPEED_1, _MAX_SPEED_2], v.dtype)
        return jnp.clip(v, -highest, highest)

    def reward(self, state: State, action: Action, next_state: State, params: Params) -> Scalar:
        return -1.0 + self.terminated(next_state, params)

    def planning_reward(
        self, state: State, action: Action, next_state: State, params: Params
    ) -> Scalar:
        gain = self._potential(next_state, params) - self._potential(state, params)
        return self.reward(state, action, next_state, params) + gain

    def terminated(self, state: State, params: Params) -> Flag:
        return _height(state) > _GOAL

    def sketch(self, state: State, params: Params) -> Float[Array, "points 2"]:
        """Pivot, elbow and tip; the second link's centre of mass is drawn in its middle."""
        lengths = jnp.stack([params["link1_length"] + 0.0, 2.0 * params["link2_com"]])
        angles = jnp.stack([state.q[0], state.q[0] + state.q[1]])
        links = lengths[:, None] * jnp.stack([jnp.sin(angles), -jnp.cos(angles)], -1)
        return jnp.concatenate([jnp.zeros((1, 2)), jnp.cumsum(links, axis=0)])

    def _potential(self, state: State, params: Params) -> Scalar:
        """The potential of the planning reward."""
        weight_1, weight_2 = _weights(params)
        inertia, v = self.mass_matrix(state.q, params), state.v
        kinetic = 0.5 * jnp.sum(inertia * v[:, None] * v)
        height = weight_1 * (1.0 - jnp.cos(state.q[0]))
        height += weight_2 * (1.0 - jnp.cos(state.q[0] + state.q[1]))
        lowest_goal = weight_1 + 2.0 * weight_2
        missing = 1.2 - (kinetic + height) / lowest_goal
        approach = 5.0 * jax.nn.sigmoid((_height(state) - _GOAL) / 0.25)
        return approach - 30.0 * 0.1 * jax.nn.softplus(missing / 0.1)


def _weights(params: Params) -> tuple[Any, Any]:
    """Torque of gravity at the two joints with both links horizontal [N m]."""
    m_2 = params["link2_mass"]
    first = params["link1_mass"] * params["link1_com"] + m_2 * params["link1_length"]
    return first * params["gravity"], m_2 * params["link2_com"] * params["gravity"]


def _height(state: State) -> Scalar:
    """Height of the tip above the pivot, with links of length one."""
    return -jnp.cos(state.q[0]) - jnp.cos(state.q[0] + state.q[1])
