"""Twin of Gymnasium's ``InvertedDoublePendulum-v5``."""

from typing import Any, Self

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from sb3_hds.core import Actuator, AnalyticTwin, Channel, Flag, Joint, Parameter, State, rk4
from sb3_hds.core.types import Action, Force, MassMatrix, Obs, Params, Position, Scalar, Velocity
from sb3_hds.twins.environments import cart_and_poles

_MAX_REPORTED = 10.0  # [m/s], [rad/s]
_MIN_HEIGHT = 1.0  # [m]
_OFF_CENTRE, _TILT = 0.4, 0.5  # weights in the planning reward [1/m2], [1]


class InvertedDoublePendulum(AnalyticTwin):
    r"""
    Two poles, one on top of the other, balanced on a cart.

    With the angles :math:`\varphi_1 = \theta_1, \varphi_2 = \theta_1 + \theta_2` from the vertical
    and the moments of mass :math:`h_1 = m_1 c_1 + m_2 l_1`, :math:`h_2 = m_2 c_2`,
    :math:`J_1 = I_1 + m_1 c_1^2 + m_2 l_1^2`, :math:`J_2 = I_2 + m_2 c_2^2`,
    :math:`k = m_2 l_1 c_2`:

    .. math::
        m \ddot x + \textstyle\sum_i h_i
        (\cos\varphi_i\,\ddot\varphi_i - \sin\varphi_i\,\dot\varphi_i^2 ) - m g_x &= F \\
        h_1 \cos\varphi_1\,\ddot x + J_1 \ddot\varphi_1 + k \cos\theta_2\,\ddot\varphi_2
        - k \sin\theta_2\,\dot\varphi_2^2 - h_1 (g \sin\varphi_1 + g_x \cos\varphi_1) &= 0 \\
        h_2 \cos\varphi_2\,\ddot x + k \cos\theta_2\,\ddot\varphi_1 + J_2 \ddot\varphi_2
        + k \sin\theta_2\,\dot\varphi_1^2 - h_2 (g \sin\varphi_2 + g_x \cos\varphi_2) &= 0

    written in the joint angles :math:`\theta`, plus damping and armature of each joint.

    Reproduces MuJoCo's RK4 on ``inverted_double_pendulum.xml`` while the cart is more than 1 cm
    from the ends of the rail (at 1 m), which are not simulated. The last channel, the constraint
    force on the cart, is therefore always zero. Speeds are reported clipped to 10, so :meth:`infer`
    does not recover larger ones.

    The environment evaluates tip and constraint force at the last stage of the last Runge-Kutta
    step, where MuJoCo left them. The twin evaluates the tip at the end of the step, which is
    :math:`O(h^3)` away.

    Planning divides the healthy reward by
    :math:`1 + 0.4 (x/\mathrm{m})^2 + 0.5 (\sin^2\varphi_1 + \sin^2\varphi_2)`: the environment's
    own reward hardly depends on the position of the cart, so a plan would run off the rail. Both
    rewards are equal at their maximum, and staying upright pays off far beyond the rail, so a plan
    brings a cart back instead of dropping the poles.

    :param healthy_reward: option; reward for each step in which the tip stays above 1 m
    :param reset_noise_scale: option; half width of the uniform initial positions, and standard
        deviation of the normal initial speeds
    """

    name = "InvertedDoublePendulum"
    env_id = "InvertedDoublePendulum-v5"
    dt = 0.05
    substeps = 5
    integrator = staticmethod(rk4)
    max_episode_steps = 1000
    options = {"healthy_reward": 10.0, "reset_noise_scale": 0.1}
    healthy_reward: float
    reset_noise_scale: float
    joints = (Joint("slider", "m"), Joint("hinge", "rad"), Joint("hinge2", "rad"))
    actuators = (Actuator("motor", "1", -1.0, 1.0),)
    channels = (
        Channel("position", "m"),
        Channel("sin1", "1"),
        Channel("sin2", "1"),
        Channel("cos1", "1"),
        Channel("cos2", "1"),
        Channel("speed", "m/s"),
        Channel("rate1", "rad/s"),
        Channel("rate2", "rad/s"),
        Channel("constraint", "N"),
    )
    parameters = {
        "gravity": Parameter(null=9.81, scale=0.5, unit="m/s2", lower=0.0),
        "gravity_x": Parameter(null=1e-5, scale=0.2, unit="m/s2"),
        "cart_mass": Parameter(null=10.47197551196598, scale=1.0, unit="kg", lower=1e-3),
        "pole_mass": Parameter(null=4.1987385815227585, scale=0.5, unit="kg", lower=1e-3),
        "pole_length": Parameter(null=0.6, scale=0.05, unit="m", lower=1e-3),
        "pole_com": Parameter(null=0.3, scale=0.05, unit="m"),
        "pole_inertia": Parameter(null=0.15497066975016235, scale=0.02, unit="kg m2", lower=1e-6),
        "pole2_mass": Parameter(null=4.1987385815227585, scale=0.5, unit="kg", lower=1e-3),
        "pole2_length": Parameter(null=0.6, scale=0.05, unit="m", lower=1e-3),
        "pole2_com": Parameter(null=0.3, scale=0.05, unit="m"),
        "pole2_inertia": Parameter(null=0.15497066975016235, scale=0.02, unit="kg m2", lower=1e-6),
        "slider_damping": Parameter(null=0.05, scale=0.05, unit="N s/m", lower=0.0),
        "hinge_damping": Parameter(null=0.05, scale=0.05, unit="N m s/rad", lower=0.0),
        "hinge2_damping": Parameter(null=0.05, scale=0.05, unit="N m s/rad", lower=0.0),
        "slider_armature": Parameter(null=0.0, scale=0.5, unit="kg", lower=0.0),
        "hinge_armature": Parameter(null=0.0, scale=0.02, unit="kg m2", lower=0.0),
        "hinge2_armature": Parameter(null=0.0, scale=0.02, unit="kg m2", lower=0.0),
        "gear": Parameter(null=500.0, scale=25.0, unit="N"),
    }
    native_effects = {
        ("viscous_friction", 0): {"b": "slider_damping"},
        ("viscous_friction", 1): {"b": "hinge_damping"},
        ("viscous_friction", 2): {"b": "hinge2_damping"},
    }

    @classmethod
    def from_env(cls, env: Any) -> Self:
        """:raises EnvironmentMismatchError: for an XML of another structure"""
        found = cart_and_poles.read(env, poles=2)
        model, require = env.unwrapped.model, cart_and_poles.require
        limits, top, tip = model.actuator_ctrlrange[0], model.body_pos[3], model.site_pos[0]
        require(limits[1] == -limits[0] == 1.0, "commands within 1")
        require(not top[:2].any(), "the second hinge on the axis of the first pole")
        require(
            not tip[:2].any() and model.site_bodyid[0] == 3, "the tip on the second pole's axis"
        )
        for pole in ("pole", "pole2"):
            offset = found.pop(f"{pole}_com_offset")
            require(offset == 0.0, "centres of mass on the axes of the poles")
        found |= {"pole_length": float(top[2]), "pole2_length": float(tip[2])}
        return cls(**found, healthy_reward=float(env.unwrapped._healthy_reward))

    def initial(self, key: PRNGKeyArray, params: Params) -> State:
        """Positions uniform, speeds normal, both scaled by ``reset_noise_scale``."""
        noise, (key_q, key_v) = self.reset_noise_scale, jax.random.split(key)
        q = jax.random.uniform(key_q, (3,), minval=-noise, maxval=noise)
        return State(q, noise * jax.random.normal(key_v, (3,)), {})

    def infer(self, obs: Obs, params: Params) -> State:
        """Speeds beyond the clip of 10 are taken to be 10."""
        angles = jnp.arctan2(obs[1:3], obs[3:5])
        return State(jnp.concatenate([obs[:1], angles]), obs[5:8], {})

    def observe(self, state: State, params: Params) -> Obs:
        speeds = jnp.clip(state.v, -_MAX_REPORTED, _MAX_REPORTED)
        angles = state.q[1:]
        constraint = jnp.zeros_like(speeds[:1])
        return jnp.concatenate([state.q[:1], jnp.sin(angles), jnp.cos(angles), speeds, constraint])

    def actuate(self, state: State, action: Action, params: Params) -> Force:
        force = params["gear"] * jnp.clip(action[0], -1.0, 1.0)
        return jnp.stack([force, jnp.zeros_like(force), jnp.zeros_like(force)])

    def mass_matrix(self, q: Position, params: Params) -> MassMatrix:
        h_1, h_2, k = _moments(params)
        m_1, m_2, l_1 = params["pole_mass"], params["pole2_mass"], params["pole_length"]
        j_1 = params["pole_inertia"] + m_1 * params["pole_com"] ** 2 + m_2 * l_1**2
        j_2 = params["pole2_inertia"] + m_2 * params["pole2_com"] ** 2
        x_2 = h_2 * jnp.cos(q[1] + q[2])
        x_1 = h_1 * jnp.cos(q[1]) + x_2
        coupling = k * jnp.cos(q[2])
        x_x = params["cart_mass"] + m_1 + m_2 + params["slider_armature"] + 0.0 * x_1
        hinge = j_1 + j_2 + 2.0 * coupling + params["hinge_armature"]
        hinge2 = j_2 + params["hinge2_armature"] + 0.0 * x_1
        both = j_2 + coupling
        return jnp.stack([x_x, x_1, x_2, x_1, hinge, both, x_2, both, hinge2]).reshape(3, 3)

    def bias(self, q: Position, v: Velocity, params: Params) -> Force:
        h_1, h_2, k = _moments(params)
        g, g_x = params["gravity"], params["gravity_x"]
        angle_1, angle_2 = q[1], q[1] + q[2]
        rate_1, rate_2 = v[1], v[1] + v[2]
        mass = params["cart_mass"] + params["pole_mass"] + params["pole2_mass"]
        pull_1 = h_1 * (g * jnp.sin(angle_1) + g_x * jnp.cos(angle_1))
        pull_2 = h_2 * (g * jnp.sin(angle_2) + g_x * jnp.cos(angle_2))
        spin = k * jnp.sin(q[2])
        flight = h_1 * jnp.sin(angle_1) * rate_1**2 + h_2 * jnp.sin(angle_2) * rate_2**2
        pole_2 = spin * rate_1**2 - pull_2
        pole_1 = pole_2 - spin * rate_2**2 - pull_1
        cart = params["slider_damping"] * v[0] - flight - mass * g_x
        hinge = params["hinge_damping"] * v[1] + pole_1
        return jnp.stack([cart, hinge, params["hinge2_damping"] * v[2] + pole_2])

    def reward(self, state: State, action: Action, next_state: State, params: Params) -> Scalar:
        x, z = _tip(next_state, params)
        alive = self.healthy_reward * ~self.terminated(next_state, params)
        distance = 0.01 * x**2 + (z - 2.0) ** 2
        return alive - distance - 1e-3 * next_state.v[1] ** 2 - 5e-3 * next_state.v[2] ** 2

    def planning_reward(
        self, state: State, action: Action, next_state: State, params: Params
    ) -> Scalar:
        tilt = jnp.stack([next_state.q[1], next_state.q[1] + next_state.q[2]])
        deviation = _OFF_CENTRE * next_state.q[0] ** 2 + _TILT * jnp.sum(jnp.sin(tilt) ** 2)
        withheld = self.healthy_reward * deviation / (1.0 + deviation)
        return self.reward(state, action, next_state, params) - withheld

    def terminated(self, state: State, params: Params) -> Flag:
        return _tip(state, params)[1] <= _MIN_HEIGHT

    def sketch(self, state: State, params: Params) -> Float[Array, "points 2"]:
        """The cart and the two poles."""
        x, zero = state.q[0], jnp.zeros_like(state.q[0])
        elbow = params["pole_length"] * jnp.stack([jnp.sin(state.q[1]), jnp.cos(state.q[1])])
        cart = jnp.array([[-0.1, 0.0], [0.1, 0.0], [0.0, 0.0]])
        chain = jnp.concatenate([cart, elbow[None]]) + jnp.stack([x, zero])
        return jnp.concatenate([chain, jnp.stack(_tip(state, params))[None]])


def _moments(params: Params) -> tuple[Any, Any, Any]:
    """First moments of mass about the two hinges, and the coupling of the poles."""
    m_1, m_2, l_1 = params["pole_mass"], params["pole2_mass"], params["pole_length"]
    h_2 = m_2 * params["pole2_com"]
    return m_1 * params["pole_com"] + m_2 * l_1, h_2, h_2 * l_1


def _tip(state: State, params: Params) -> tuple[Scalar, Scalar]:
    """The tip of the second pole [m], in x and z."""
    x, angle, angle_2 = state.q[0], state.q[1], state.q[1] + state.q[2]
    l_1, l_2 = params["pole_length"], params["pole2_length"]
    height = l_1 * jnp.cos(angle) + l_2 * jnp.cos(angle_2)
    return x + l_1 * jnp.sin(angle) + l_2 * jnp.sin(angle_2), height
