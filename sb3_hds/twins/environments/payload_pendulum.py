"""Twin of ``sb3_hds/PayloadPendulum-v0``: a payload that hangs from a driven handle."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from sb3_hds.core import Actuator, AnalyticTwin, Channel, Joint, Parameter, State, rk4
from sb3_hds.core.types import Action, Force, MassMatrix, Obs, Params, Position, Scalar, Velocity

_MAX_SPEED = 2.0  # [m/s]
_SERVO_TIME = 0.05  # [s] time constant of the handle's speed
_HANDLE_MASS = 10.0  # [kg] matters only for effects: the drive compensates the model's load

# Weights of the cost on payload position, handle position, payload velocity and command.
_WEIGHTS = {"stop": (0.0, 0.0, 1.0, 0.1), "stop_at_origin": (1.0, 1.0, 1.0, 0.1)}
_FLOOR = 0.1  # of the reward's denominator


class PayloadPendulum(AnalyticTwin):
    r"""
    A point mass on a rigid rod that swings below a handle; the command is the handle's velocity.

    With the handle at :math:`(x, z)` and :math:`\theta = 0` hanging down:

    .. math::
        m l^2 \dot\omega + m l\,(\ddot x \cos\theta + (\ddot z + g) \sin\theta) + d\,\omega = 0,
        \qquad (\ddot x, \ddot z) = (u - (\dot x, \dot z)) / 0.05\,\mathrm{s}

    The servo of the handle compensates its load, damping included, so the payload does not push it
    back. It reaches a new velocity with a time constant of 0.05 s; in the paper, immediately.
    Effects are not compensated: they move the handle as a body of 10 kg. Integrated by RK4 in two
    sub-steps of 25 ms.

    The reward of the paper, with the payload's position :math:`p` relative to hanging below the
    origin, its velocity :math:`v`, and the command :math:`a`:

    .. math:: r = \frac{1}{0.1 + c}, \qquad
              c = \tfrac{1}{2}\big(w_p |p|^2 + w_x |x|^2 + w_v |v|^2 + w_a |a|^2\big)

    The 0.1, which keeps the reward finite at the goal, and the weights are ours: :math:`w_v = 1`,
    :math:`w_a = 0.1`, and :math:`w_p = w_x` is 0 for ``"stop"`` and 1 for ``"stop_at_origin"``. Far
    from the goal the reward is flat, so planning maximises :math:`-c`, which increases with it and
    is concave in position, velocity and command.

    Source: Mora et al., *PODS: Policy Optimization via Differentiable Simulation*, ICML 2021,
    section 5.

    :param goal: option; ``"stop"`` (anywhere) or ``"stop_at_origin"``
    :raises ParameterError: for another goal
    """

    name = "PayloadPendulum"
    env_id = "sb3_hds/PayloadPendulum-v0"
    dt = 0.05
    substeps = 2
    integrator = staticmethod(rk4)
    max_episode_steps = 100
    options = {"goal": "stop"}
    choices = {"goal": _WEIGHTS}
    goal: str
    joints = (Joint("handle_x", "m"), Joint("handle_z", "m"), Joint("swing", "rad"))
    actuators = (
        Actuator("velocity_x", "m/s", -_MAX_SPEED, _MAX_SPEED),
        Actuator("velocity_z", "m/s", -_MAX_SPEED, _MAX_SPEED),
    )
    channels = (
        Channel("x", "m"),
        Channel("z", "m"),
        Channel("cos", "1", -1.0, 1.0),
        Channel("sin", "1", -1.0, 1.0),
        Channel("speed_x", "m/s"),
        Channel("speed_z", "m/s"),
        Channel("rate", "rad/s"),
    )
    parameters = {
        "gravity": Parameter(null=9.81, scale=0.5, unit="m/s2", lower=0.0),
        "mass": Parameter(null=1.0, scale=0.2, unit="kg", lower=1e-3),
        "length": Parameter(null=1.0, scale=0.2, unit="m", lower=1e-3),
        "damping": Parameter(null=0.05, scale=0.05, unit="N m s/rad", lower=0.0),
    }
    native_effects = {("viscous_friction", 2): {"b": "damping"}}

    def initial(self, key: PRNGKeyArray, params: Params) -> State:
        """Uniform: handle at rest within 1 m in x and z, swing within 1 rad and 2 rad/s."""
        high = jnp.array([[1.0, 1.0, 1.0], [0.0, 0.0, 2.0]])
        start = jax.random.uniform(key, (2, 3), minval=-high, maxval=high)
        return State(start[0], start[1], {})

    def infer(self, obs: Obs, params: Params) -> State:
        angle = jnp.arctan2(obs[3:4], obs[2:3])
        return State(jnp.concatenate([obs[:2], angle]), obs[4:], {})

    def observe(self, state: State, params: Params) -> Obs:
        swing = state.q[2:]
        return jnp.concatenate([state.q[:2], jnp.cos(swing), jnp.sin(swing), state.v])

    def actuate(self, state: State, action: Action, params: Params) -> Force:
        """Computed torque: the handle gets the servo's acceleration, whatever the payload does."""
        command = jnp.clip(action, -_MAX_SPEED, _MAX_SPEED)
        servo = (command - state.v[:2]) / _SERVO_TIME
        inertia = self.mass_matrix(state.q, params)
        load = self.bias(state.q, state.v, params)
        swing = -(load[2] + jnp.sum(inertia[2, :2] * servo)) / inertia[2, 2]
        drive = load[:2] + inertia[0, 0] * servo + inertia[:2, 2] * swing
        return jnp.concatenate([drive, jnp.zeros_like(drive[:1])])

    def mass_matrix(self, q: Position, params: Params) -> MassMatrix:
        sin, cos = jnp.sin(q[2]), jnp.cos(q[2])
        lever, zero = params["mass"] * params["length"], 0.0 * sin
        handle = _HANDLE_MASS + params["mass"] + zero
        swing = lever * params["length"] + zero
        x, z = lever * cos, lever * sin
        return jnp.stack([handle, zero, x, zero, handle, z, x, z, swing]).reshape(3, 3)

    def bias(self, q: Position, v: Velocity, params: Params) -> Force:
        sin, cos, g = jnp.sin(q[2]), jnp.cos(q[2]), params["gravity"]
        lever = params["mass"] * params["length"]
        pull = lever * v[2] ** 2
        weight = (_HANDLE_MASS + params["mass"]) * g
        swing = lever * g * sin + params["damping"] * v[2]
        return jnp.stack([-pull * sin, pull * cos + weight, swing])

    def reward(self, state: State, action: Action, next_state: State, params: Params) -> Scalar:
        return 1.0 / (_FLOOR + self._cost(state, action, params))

    def planning_reward(
        self, state: State, action: Action, next_state: State, params: Params
    ) -> Scalar:
        return -self._cost(state, action, params)

    def sketch(self, state: State, params: Params) -> Float[Array, "points 2"]:
        """The handle, the rod and the payload."""
        handle = state.q[:2]
        grip = jnp.array([[-0.1, 0.0], [0.1, 0.0], [0.0, 0.0]])
        rod = params["length"] * jnp.stack([jnp.sin(state.q[2]), -jnp.cos(state.q[2])])
        return jnp.concatenate([grip, rod[None]]) + handle

    def _cost(self, state: State, action: Action, params: Params) -> Scalar:
        """The cost :math:`c` of the reward."""
        w_p, w_x, w_v, w_a = _WEIGHTS[self.goal]
        handle, length = state.q[:2], params["length"]
        sin, cos = jnp.sin(state.q[2]), jnp.cos(state.q[2])
        position = handle + length * jnp.stack([sin, 1.0 - cos])
        velocity = state.v[:2] + length * state.v[2] * jnp.stack([cos, sin])
        command = jnp.clip(action, -_MAX_SPEED, _MAX_SPEED)
        still = w_p * jnp.sum(position**2) + w_x * jnp.sum(handle**2)
        return 0.5 * (still + w_v * jnp.sum(velocity**2) + w_a * jnp.sum(command**2))
