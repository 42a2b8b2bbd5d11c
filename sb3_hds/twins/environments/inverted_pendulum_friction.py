"""Twin of ``sb3_hds/InvertedPendulumFriction-v5``."""

from typing import Any, Self

import jax.numpy as jnp
from jaxtyping import PRNGKeyArray

from sb3_hds.core import Channel, State
from sb3_hds.core.types import Action, Flag, Force, Obs, Params, Position, Scalar, Velocity
from sb3_hds.twins.environments.inverted_pendulum import InvertedPendulum

_MAX_COMMAND = 3.0
_RAIL_END = 1.0  # [m]
# MuJoCo's soft joint limit for a cart and pole of 15.5 kg, as a spring and a damper.
_END_STIFFNESS = 9.5e3  # [N/m]
_END_DAMPING = 760.0  # [N s/m]
# Depth over which the damper sets in [m].
_SOFT = 0.005

_SWING_UP_CHANNELS = (
    Channel("position", "m"),
    Channel("cos", "1"),
    Channel("sin", "1"),
    Channel("speed", "m/s"),
    Channel("rate", "rad/s"),
)


class InvertedPendulumFriction(InvertedPendulum):
    r"""
    :class:`InvertedPendulum` with the ends of its rail, and a swing-up task as an option.

    The model is that of ``InvertedPendulum-v5``: the friction that the environment adds is hidden
    from :meth:`from_env`, and known to ``sb3_hds.envs.true_twin``. At the ends of the rail a spring
    and a damper push back; MuJoCo's soft limit is similar, but not equal.

    With ``swing_up=True`` the pole starts hanging, episodes do not terminate, cosine and sine of
    the angle are observed, and the reward has a gradient:

    .. math::
        r = \tfrac{1}{2}(1 + \cos\theta) - 0.1\,x^2 - 0.005\,\dot x^2 - 0.0005\,\omega^2
            - 0.001\,u^2

    :param reset_noise_scale: option; half width of the uniform initial positions and speeds
    :param swing_up: option; whether the task is to swing up
    :param rail_ends: option; whether the rail has ends
    """

    name = "InvertedPendulumFriction"
    env_id = "sb3_hds/InvertedPendulumFriction-v5"
    options = {"reset_noise_scale": 0.01, "swing_up": False, "rail_ends": True}
    swing_up: bool
    rail_ends: bool

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        if self.swing_up:
            self.channels = _SWING_UP_CHANNELS
            self.reward_has_gradient = True

    @classmethod
    def from_env(cls, env: Any) -> Self:
        env = env.unwrapped
        found = cls.described_by(env.nominal)
        return cls(**found, swing_up=env.swing_up, rail_ends=env.rail_ends)

    def initial(self, key: PRNGKeyArray, params: Params) -> State:
        """Uniform in plus and minus ``reset_noise_scale``, around hanging or upright."""
        start = super().initial(key, params)
        return start._replace(q=start.q.at[1].add(jnp.pi)) if self.swing_up else start

    def infer(self, obs: Obs, params: Params) -> State:
        if not self.swing_up:
            return super().infer(obs, params)
        return State(jnp.stack([obs[0], jnp.arctan2(obs[2], obs[1])]), obs[3:], {})

    def observe(self, state: State, params: Params) -> Obs:
        if not self.swing_up:
            return super().observe(state, params)
        x, angle = state.q
        return jnp.concatenate([jnp.stack([x, jnp.cos(angle), jnp.sin(angle)]), state.v])

    def bias(self, q: Position, v: Velocity, params: Params) -> Force:
        force = super().bias(q, v, params)
        return force.at[0].add(_end_of_rail(q[0], v[0])) if self.rail_ends else force

    def reward(self, state: State, action: Action, next_state: State, params: Params) -> Scalar:
        if not self.swing_up:
            return super().reward(state, action, next_state, params)
        (x, angle), (speed, rate) = next_state.q, next_state.v
        command = jnp.clip(action[0], -_MAX_COMMAND, _MAX_COMMAND)
        costs = 0.1 * x**2 + 0.005 * speed**2 + 0.0005 * rate**2 + 0.001 * command**2
        return 0.5 * (1.0 + jnp.cos(angle)) - costs

    def planning_reward(
        self, state: State, action: Action, next_state: State, params: Params
    ) -> Scalar:
        if not self.swing_up:
            return super().planning_reward(state, action, next_state, params)
        return self.reward(state, action, next_state, params)

    def terminated(self, state: State, params: Params) -> Flag:
        if not self.swing_up:
            return super().terminated(state, params)
        return ~(jnp.isfinite(state.q).all() & jnp.isfinite(state.v).all())


def _end_of_rail(x: Scalar, speed: Scalar) -> Scalar:
    """The force of an end on the cart [N], as a load; it never pulls."""
    depth = jnp.maximum(jnp.abs(x) - _RAIL_END, 0.0)
    outwards = jnp.sign(x) * speed
    push = _END_STIFFNESS * depth + _END_DAMPING * outwards * jnp.minimum(depth / _SOFT, 1.0)
    return jnp.sign(x) * jnp.maximum(push, 0.0)
