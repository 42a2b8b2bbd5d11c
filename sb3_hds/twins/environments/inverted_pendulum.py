"""Twin of Gymnasium's ``InvertedPendulum-v5``."""

from typing import Any, Self

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from sb3_hds.core import Actuator, AnalyticTwin, Channel, Flag, Joint, Parameter, State, rk4
from sb3_hds.core.types import Action, Force, MassMatrix, Obs, Params, Position, Scalar, Velocity
from sb3_hds.twins.environments import cart_and_poles

_MAX_COMMAND = 3.0
_MAX_ANGLE = 0.2  # [rad]

# Deviations that halve the planning reward.
_RAIL = 1.0  # [m]
_SPEED = 5.0  # [m/s]
_RATE = 5.0  # [rad/s]


class InvertedPendulum(AnalyticTwin):
    r"""
    A pole balanced on a cart.

    With the pole's centre of mass at :math:`r_x, r_z` from the hinge (rotated by :math:`\theta`,
    which is zero upright), and gravity :math:`(g_x, -g)` in the plane of motion:

    .. math::
        (m_c + m_p + a_s)\,\ddot x + m_p r_z \dot\omega - m_p r_x \omega^2
        - (m_c + m_p) g_x + b_s \dot x &= k u \\
        m_p r_z \ddot x + (I + m_p r^2 + a_h)\,\dot\omega - m_p (g_x r_z + g r_x) + b_h \omega &= 0

    Reproduces MuJoCo's RK4 on ``inverted_pendulum.xml`` while no joint is at its limit. The ends of
    the rail (at 1 m) are not simulated.

    The reward is one until the pole leaves :math:`\pm 0.2` rad, so it has no gradient. Planning
    maximises a positive reward that is one only at rest in the middle:

    .. math::
        r_\text{plan} = \Big(1 + \tfrac{1}{2}\Big[(\theta / 0.2\,\mathrm{rad})^2
            + (x / 1\,\mathrm{m})^2
            + (\dot x / 5\,\mathrm{m/s})^2 + (\omega / 5\,\mathrm{rad/s})^2\Big]\Big)^{-1}

    :param reset_noise_scale: option; half width of the uniform initial positions and speeds
    """

    name = "InvertedPendulum"
    env_id = "InvertedPendulum-v5"
    dt = 0.04
    substeps = 2
    integrator = staticmethod(rk4)
    max_episode_steps = 1000
    reward_has_gradient = False
    options = {"reset_noise_scale": 0.01}
    reset_noise_scale: float
    joints = (Joint("slider", "m"), Joint("hinge", "rad"))
    actuators = (Actuator("motor", "1", -_MAX_COMMAND, _MAX_COMMAND),)
    channels = (
        Channel("position", "m"),
        Channel("angle", "rad"),
        Channel("speed", "m/s"),
        Channel("rate", "rad/s"),
    )
    parameters = {
        "gravity": Parameter(null=9.81, scale=0.5, unit="m/s2", lower=0.0),
        "gravity_x": Parameter(null=0.0, scale=0.2, unit="m/s2"),
        "cart_mass": Parameter(null=10.47197551196598, scale=1.0, unit="kg", lower=1e-3),
        "pole_mass": Parameter(null=5.018591641363306, scale=0.5, unit="kg", lower=1e-3),
        "pole_com": Parameter(null=0.3, scale=0.05, unit="m"),
        "pole_com_offset": Parameter(null=0.0005, scale=0.01, unit="m"),
        "pole_inertia": Parameter(null=0.1887497668730885, scale=0.02, unit="kg m2", lower=1e-6),
        "slider_damping": Parameter(null=1.0, scale=0.2, unit="N s/m", lower=0.0),
        "hinge_damping": Parameter(null=1.0, scale=0.2, unit="N m s/rad", lower=0.0),
        "slider_armature": Parameter(null=0.0, scale=0.5, unit="kg", lower=0.0),
        "hinge_armature": Parameter(null=0.0, scale=0.02, unit="kg m2", lower=0.0),
        "gear": Parameter(null=100.0, scale=5.0, unit="N"),
    }
    native_effects = {
        ("viscous_friction", 0): {"b": "slider_damping"},
        ("viscous_friction", 1): {"b": "hinge_damping"},
    }

    @classmethod
    def from_env(cls, env: Any) -> Self:
        """:raises EnvironmentMismatchError: for an XML of another structure"""
        return cls(**cls.described_by(env))

    @staticmethod
    def described_by(env: Any) -> dict[str, Any]:
        """
        :return: parameters and options from the XML of ``env``
        :raises EnvironmentMismatchError: for an XML of another structure
        """
        found = cart_and_poles.read(env, poles=1)
        limits = env.unwrapped.model.actuator_ctrlrange[0]
        cart_and_poles.require(limits[1] == -limits[0] == _MAX_COMMAND, "commands within 3")
        return found

    def initial(self, key: PRNGKeyArray, params: Params) -> State:
        """Positions and speeds uniform in plus and minus ``reset_noise_scale``."""
        noise = self.reset_noise_scale
        start = jax.random.uniform(key, (2, 2), minval=-noise, maxval=noise)
        return State(start[0], start[1], {})

    def infer(self, obs: Obs, params: Params) -> State:
        return State(obs[:2], obs[2:], {})

    def observe(self, state: State, params: Params) -> Obs:
        return jnp.concatenate([state.q, state.v])

    def actuate(self, state: State, action: Action, params: Params) -> Force:
        force = params["gear"] * jnp.clip(action[0], -_MAX_COMMAND, _MAX_COMMAND)
        return jnp.stack([force, jnp.zeros_like(force)])

    def mass_matrix(self, q: Position, params: Params) -> MassMatrix:
        com, offset = params["pole_com"], params["pole_com_offset"]
        _, lever = _centre(q[1], params)
        cart = params["cart_mass"] + params["pole_mass"] + params["slider_armature"]
        pole = params["pole_inertia"] + params["pole_mass"] * (com**2 + offset**2)
        both = params["pole_mass"] * lever
        hinge = pole + params["hinge_armature"]
        return jnp.stack([cart + 0.0 * both, both, both, hinge + 0.0 * both]).reshape(2, 2)

    def bias(self, q: Position, v: Velocity, params: Params) -> Force:
        r_x, r_z = _centre(q[1], params)
        mass, g_x = params["pole_mass"], params["gravity_x"]
        cart = -mass * r_x * v[1] ** 2 - (params["cart_mass"] + mass) * g_x
        pole = -mass * (g_x * r_z + params["gravity"] * r_x)
        return jnp.stack(
            [cart + params["slider_damping"] * v[0], pole + params["hinge_damping"] * v[1]]
        )

    def reward(self, state: State, action: Action, next_state: State, params: Params) -> Scalar:
        return 1.0 - self.terminated(next_state, params)

    def planning_reward(
        self, state: State, action: Action, next_state: State, params: Params
    ) -> Scalar:
        deviation = next_state.q / jnp.array([_RAIL, _MAX_ANGLE])
        motion = next_state.v / jnp.array([_SPEED, _RATE])
        return 1.0 / (1.0 + 0.5 * jnp.sum(deviation**2 + motion**2))

    def terminated(self, state: State, params: Params) -> Flag:
        finite = jnp.isfinite(state.q).all() & jnp.isfinite(state.v).all()
        return ~finite | (jnp.abs(state.q[1]) > _MAX_ANGLE)

    def sketch(self, state: State, params: Params) -> Float[Array, "points 2"]:
        """The cart, and the pole up to twice the distance of its centre of mass."""
        r_x, r_z = _centre(state.q[1], params)
        cart = jnp.array([[-0.1, 0.0], [0.1, 0.0], [0.0, 0.0]])
        tip = 2.0 * jnp.stack([r_x, r_z])
        return jnp.concatenate([cart, tip[None]]) + jnp.stack([state.q[0], 0.0 * r_x])


def _centre(angle: Scalar, params: Params) -> tuple[Scalar, Scalar]:
    """The pole's centre of mass relative to the hinge [m], in x and z."""
    sin, cos = jnp.sin(angle), jnp.cos(angle)
    com, offset = params["pole_com"], params["pole_com_offset"]
    return offset * cos + com * sin, com * cos - offset * sin
