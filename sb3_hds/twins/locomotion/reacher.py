"""Twin of Gymnasium's ``Reacher-v5``."""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from sb3_hds.core import Actuator, Channel, Joint, State
from sb3_hds.core.types import Action, Obs, Params, Position, Scalar
from sb3_hds.twins.locomotion.task import MujocoTask, distance, seen
from sb3_hds.twins.mujoco.engine.simulator import Reading
from sb3_hds.twins.mujoco.engine.values import declared, natives

_ARM = ("joint0", "joint1")
_UPPER, _FORE = 0.1, 0.11  # [m]
_NEAR, _SLOW, _REACH = 0.1, 0.005, 0.2  # of start states [rad], [rad/s], [m]
_TIP, _TARGET = 3, 4  # bodies


def _to_target(data: Any) -> np.ndarray:
    return data.xpos[_TIP, :2] - data.xpos[_TARGET, :2]


class Reacher(MujocoTask):
    r"""
    A planar arm of two links whose fingertip has to reach a target.

    .. math:: r = -w_d\,|p_\text{tip} - p_\text{target}| - w_c\,|u|^2

    with both weights 1 (``reward_dist_weight``, ``reward_control_weight``). There is no
    termination.

    Observation and reward of the environment have the fingertip where the last Runge-Kutta stage
    put it, and so does the twin; derivatives are those of the forward kinematics.
    :math:`|p|` has its gradient as :math:`\sqrt{|p|^2 + \epsilon^2}` in planning.
    """

    name = "Reacher"
    env_id = "Reacher-v5"
    dt = 0.02
    substeps = 2
    max_episode_steps = 50
    options = {
        "xml_file": "reacher.xml",
        "reward_dist_weight": 1.0,
        "reward_control_weight": 1.0,
    }
    exclude_current_positions_from_observation = False
    reward_dist_weight: float
    reward_control_weight: float
    joints = (*map(Joint, _ARM), Joint("target_x", "m"), Joint("target_y", "m"))
    positions = tuple(Channel(f"{joint.name}_position", joint.unit) for joint in joints)
    actuators = tuple(Actuator(joint, "1", -1.0, 1.0) for joint in _ARM)
    parameters = declared(
        masses=dict.fromkeys(("body0", "body1"), 0.03560471674068432),
        damping=dict.fromkeys(_ARM, 1.0),
        motors=_ARM,
        gravity=None,
        friction=False,
    )
    native_effects = natives(joints, actuators, parameters)

    def _channels(self) -> tuple[Channel, ...]:
        return (
            *(Channel(f"{joint}_cos", "1") for joint in _ARM),
            *(Channel(f"{joint}_sin", "1") for joint in _ARM),
            *self.positions[2:],
            *(Channel(f"{joint}_velocity", "rad/s") for joint in _ARM),
            Channel("to_target_x", "m"),
            Channel("to_target_y", "m"),
        )

    def readings(self) -> Mapping[str, tuple[Reading, int]]:
        return {"to_target": (_to_target, 2)}

    def at(self, q: Position, v: Array) -> State:
        return self.with_readings(State(q, v, {}), to_target=_kinematics(q))

    def initial(self, key: PRNGKeyArray, params: Params) -> State:
        """The arm nearly straight and at rest; the target uniform in a disk of radius 0.2 m."""
        k_q, k_v, k_radius, k_angle = jax.random.split(key, 4)
        arm = jax.random.uniform(k_q, (2,), minval=-_NEAR, maxval=_NEAR)
        slow = jax.random.uniform(k_v, (2,), minval=-_SLOW, maxval=_SLOW)
        radius = _REACH * jnp.sqrt(jax.random.uniform(k_radius))
        angle = jax.random.uniform(k_angle, maxval=2.0 * jnp.pi)
        target = radius * jnp.stack([jnp.cos(angle), jnp.sin(angle)])
        return self.at(jnp.concatenate([arm, target]), jnp.concatenate([slow, jnp.zeros(2)]))

    def infer(self, obs: Obs, params: Params) -> State:
        """Angles are within pi of zero; the target is at rest."""
        arm = jnp.arctan2(obs[2:4], obs[:2])
        q = jnp.concatenate([arm, obs[4:6]])
        v = jnp.concatenate([obs[6:8], jnp.zeros(2, obs.dtype)])
        return self.with_readings(State(q, v, {}), to_target=obs[8:])

    def observe(self, state: State, params: Params) -> Obs:
        arm = state.q[:2]
        to_target = self._to_target(state)
        return jnp.concatenate([jnp.cos(arm), jnp.sin(arm), state.q[2:], state.v[:2], to_target])

    def reward(self, state: State, action: Action, next_state: State, params: Params) -> Scalar:
        effort = self.reward_control_weight * jnp.sum(action**2)
        return -self.reward_dist_weight * distance(self._to_target(next_state)) - effort

    def _to_target(self, state: State) -> Float[Array, "2"]:
        return seen(self.reading(state, "to_target"), _kinematics(state.q))


def _kinematics(q: Position) -> Float[Array, "2"]:
    """From the target to the fingertip [m]."""
    elbow, wrist = q[0], q[0] + q[1]
    x = _UPPER * jnp.cos(elbow) + _FORE * jnp.cos(wrist)
    y = _UPPER * jnp.sin(elbow) + _FORE * jnp.sin(wrist)
    return jnp.stack([x, y]) - q[2:]
