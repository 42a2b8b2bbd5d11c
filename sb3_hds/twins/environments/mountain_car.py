"""Twin of Gymnasium's ``MountainCarContinuous-v0``."""

from typing import Any, Self

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from sb3_hds.core import Actuator, AnalyticTwin, Channel, Flag, Joint, Parameter, State
from sb3_hds.core.types import Action, Force, MassMatrix, Obs, Params, Position, Scalar, Velocity

_MIN_POSITION = -1.2  # [m]
_MAX_POSITION = 0.6  # [m]
_MAX_SPEED = 0.07  # [m/s]
_GOAL = 0.45  # [m]

# Constants of the planning reward; see the class.
_SCALE = 10.0
_CLIMB = 8.0
_BONUS = 2.0
_ROUNDING = 0.1
_APPROACH = 0.05  # [m]


class MountainCar(AnalyticTwin):
    r"""
    A car that is too weak to climb its hill without a run-up.

    .. math:: \dot v = p\,u - g \cos 3x, \qquad u \in [-1, 1]

    Reproduces ``gymnasium/envs/classic_control/continuous_mountain_car.py``: semi-implicit Euler
    with a step of one second, speed clipped to 0.07 m/s, position clipped to [-1.2, 0.6] m, and an
    inelastic wall on the left. Where a clip is active, the derivative is zero. As in the
    environment, the reward charges for the command before clipping.

    The reward has no gradient towards the goal, so planning maximises the gain of a potential. With
    the energy :math:`E = v^2/2 + g \sin(3x)/3`, its fraction :math:`e` of that of a climb from the
    bottom of the valley to the goal at :math:`x_g`, and the softplus :math:`\operatorname{sp}`,

    .. math::
        \Phi = -8 \cdot 0.1 \operatorname{sp}\!\Big(\frac{1 - e}{0.1}\Big)
               + 2\,\sigma\!\Big(\frac{x - x_g}{0.05\,\mathrm{m}}\Big), \qquad
        r_\text{plan} = 10\,\big(\Phi(s') - \Phi(s) - 0.1\,u^2\big)

    Energy beyond that of the climb earns nothing. The gains add up to the same number on every path
    to the goal, so plans differ in the cost of their commands, which the environment charges too. A
    larger factor than 8 makes plans faster, a smaller one cheaper.

    :param goal_velocity: option; minimal speed at the goal [m/s]
    """

    name = "MountainCar"
    env_id = "MountainCarContinuous-v0"
    dt = 1.0
    max_episode_steps = 999
    reward_has_gradient = False
    options = {"goal_velocity": 0.0}
    goal_velocity: float
    joints = (Joint("track", "m"),)
    actuators = (Actuator("throttle", "1", -1.0, 1.0),)
    channels = (
        Channel("position", "m", _MIN_POSITION, _MAX_POSITION),
        Channel("speed", "m/s", -_MAX_SPEED, _MAX_SPEED),
    )
    parameters = {
        "power": Parameter(null=0.0015, scale=2e-4, unit="m/s2", lower=0.0),
        "gravity": Parameter(null=0.0025, scale=2e-4, unit="m/s2", lower=1e-6),
    }

    @classmethod
    def from_env(cls, env: Any) -> Self:
        env = env.unwrapped
        return cls(power=env.power, goal_velocity=float(env.goal_velocity))

    def initial(self, key: PRNGKeyArray, params: Params) -> State:
        """Position uniform in [-0.6, -0.4] m, at rest."""
        start = jax.random.uniform(key, (1,), minval=-0.6, maxval=-0.4)
        return State(start, jnp.zeros_like(start), {})

    def infer(self, obs: Obs, params: Params) -> State:
        return State(obs[:1], obs[1:], {})

    def observe(self, state: State, params: Params) -> Obs:
        return jnp.concatenate([state.q, state.v])

    def actuate(self, state: State, action: Action, params: Params) -> Force:
        return params["power"] * jnp.clip(action, -1.0, 1.0)

    def mass_matrix(self, q: Position, params: Params) -> MassMatrix:
        return jnp.ones((1, 1), q.dtype)

    def bias(self, q: Position, v: Velocity, params: Params) -> Force:
        return params["gravity"] * jnp.cos(3.0 * q)

    def limit_velocity(self, v: Velocity) -> Velocity:
        return jnp.clip(v, -_MAX_SPEED, _MAX_SPEED)

    def limit(self, q: Position, v: Velocity) -> tuple[Position, Velocity]:
        v = jnp.where((q <= _MIN_POSITION) & (v < 0.0), 0.0, v)
        return jnp.clip(q, _MIN_POSITION, _MAX_POSITION), v

    def reward(self, state: State, action: Action, next_state: State, params: Params) -> Scalar:
        return 100.0 * self.terminated(next_state, params) - 0.1 * jnp.sum(action**2)

    def planning_reward(
        self, state: State, action: Action, next_state: State, params: Params
    ) -> Scalar:
        gain = _potential(next_state, params) - _potential(state, params)
        return _SCALE * (gain - 0.1 * jnp.sum(action**2))

    def terminated(self, state: State, params: Params) -> Flag:
        return (state.q[0] >= _GOAL) & (state.v[0] >= self.goal_velocity)

    def sketch(self, state: State, params: Params) -> Float[Array, "points 2"]:
        """The hill from the left wall to the right one, with a pole where the car is."""
        track = jnp.linspace(_MIN_POSITION, _MAX_POSITION, 60)
        x = jnp.sort(jnp.concatenate([track, state.q, state.q, state.q]))
        car = jnp.searchsorted(x, state.q[0]) + 1
        height = 0.45 * jnp.sin(3.0 * x) + 0.15 * (jnp.arange(x.size) == car)
        return jnp.stack([x, height], -1)


def _potential(state: State, params: Params) -> Scalar:
    """The potential of the planning reward, before scaling."""
    x, v = state.q[0], state.v[0]
    hill = params["gravity"] / 3.0
    climb = hill * (1.0 + jnp.sin(3.0 * _GOAL))
    energy = (0.5 * v**2 + hill * (1.0 + jnp.sin(3.0 * x))) / climb
    missing = _ROUNDING * jax.nn.softplus((1.0 - energy) / _ROUNDING)
    return _BONUS * jax.nn.sigmoid((x - _GOAL) / _APPROACH) - _CLIMB * missing
