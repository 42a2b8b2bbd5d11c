"""Twin of Gymnasium's ``Pusher-v5``."""

import functools
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
from sb3_hds.twins.mujoco.engine.twin import Source
from sb3_hds.twins.mujoco.engine.values import declared, natives
from sb3_hds.twins.mujoco.files.reading import read
from sb3_hds.twins.mujoco.mechanism import Mechanism
from sb3_hds.twins.mujoco.rigid_body import algebra as alg
from sb3_hds.twins.mujoco.rigid_body.dynamics import frames_of

_ARM = (
    "r_shoulder_pan_joint",
    "r_shoulder_lift_joint",
    "r_upper_arm_roll_joint",
    "r_elbow_flex_joint",
    "r_forearm_roll_joint",
    "r_wrist_flex_joint",
    "r_wrist_roll_joint",
)
_SLIDES = ("obj_slidey", "obj_slidex", "goal_slidey", "goal_slidex")
_PLACES = ("tips_arm", "object", "goal")
_SLOW = 0.005  # of start states [rad/s]
_CLEAR = 0.17  # least distance between object and goal at the start [m]
_N_DRAWS = 32  # of which 38 % are too near


def _places(data: Any) -> np.ndarray:
    return np.concatenate([data.body(name).xpos for name in _PLACES])


@functools.lru_cache(maxsize=4)
def _mechanism(source: Source) -> Mechanism:
    return read(source.load())


class Pusher(MujocoTask):
    r"""
    An arm of seven joints that has to push an object to a goal on a table.

    .. math::
        r = -w_n\,|p_\text{object} - p_\text{tip}| - w_d\,|p_\text{object} - p_\text{goal}|
            - w_c\,|u|^2

    with :math:`w_n` = 0.5 (``reward_near_weight``), :math:`w_d` = 1 (``reward_dist_weight``) and
    :math:`w_c` = 0.1 (``reward_control_weight``). There is no termination.

    Observation and reward of the environment have tip, object and goal where they were a step of
    the engine earlier, and so does the twin; derivatives are those of the forward kinematics. While
    the arm does not touch the object, the reward tells planning only to come near it.
    """

    name = "Pusher"
    env_id = "Pusher-v5"
    dt = 0.05
    substeps = 5
    max_episode_steps = 100
    options = {
        "xml_file": "pusher_v5.xml",
        "reward_near_weight": 0.5,
        "reward_dist_weight": 1.0,
        "reward_control_weight": 0.1,
    }
    exclude_current_positions_from_observation = False
    reward_near_weight: float
    reward_dist_weight: float
    reward_control_weight: float
    joints = (*map(Joint, _ARM), *(Joint(slide, "m") for slide in _SLIDES))
    positions = tuple(Channel(f"{joint.name}_position", joint.unit) for joint in joints)
    actuators = tuple(Actuator(joint, "N m", -2.0, 2.0) for joint in _ARM)
    parameters = declared(
        masses={"r_upper_arm_link": 1.6286016316209488},
        damping=dict(zip(_ARM, (1.0, 1.0, 0.1, 0.1, 0.1, 0.1, 0.1), strict=True)),
        motors=_ARM,
        gravity=None,
        friction=False,
    )
    native_effects = natives(joints, actuators, parameters)

    def _channels(self) -> tuple[Channel, ...]:
        return (
            *self.positions[: len(_ARM)],
            *(Channel(f"{joint}_velocity", "rad/s") for joint in _ARM),
            *(Channel(f"{place}_{axis}", "m") for place in _PLACES for axis in "xyz"),
        )

    def readings(self) -> Mapping[str, tuple[Reading, int]]:
        return {"places": (_places, 9)}

    def at(self, q: Position, v: Array) -> State:
        return self.with_readings(State(q, v, {}), places=self._kinematics(q))

    def initial(self, key: PRNGKeyArray, params: Params) -> State:
        """The arm stretched and nearly at rest; the object on one side, away from the goal."""
        k_v, k_y, k_x = jax.random.split(key, 3)
        y = jax.random.uniform(k_y, (_N_DRAWS,), minval=-0.3, maxval=0.0)
        x = jax.random.uniform(k_x, (_N_DRAWS,), minval=-0.2, maxval=0.2)
        first = jnp.argmax(x**2 + y**2 > _CLEAR**2)
        rest = jnp.zeros(len(_ARM), y.dtype)
        q = jnp.concatenate([rest, y[first, None], x[first, None], rest[:2]])
        slow = jax.random.uniform(k_v, (len(_ARM),), minval=-_SLOW, maxval=_SLOW)
        return self.at(q, jnp.concatenate([slow, jnp.zeros(4, slow.dtype)]))

    def infer(self, obs: Obs, params: Params) -> State:
        """Object and goal are at rest."""
        n = len(_ARM)
        q = jnp.concatenate([obs[:n], jnp.zeros(4, obs.dtype)])
        shift = (obs[2 * n :] - self._kinematics(q)).reshape(3, 3)[1:, :2]
        q = q.at[n:].set(shift[:, ::-1].reshape(-1))
        v = jnp.concatenate([obs[n : 2 * n], jnp.zeros(4, obs.dtype)])
        return self.with_readings(State(q, v, {}), places=obs[2 * n :])

    def observe(self, state: State, params: Params) -> Obs:
        n = len(_ARM)
        return jnp.concatenate([state.q[:n], state.v[:n], self._places(state)])

    def reward(self, state: State, action: Action, next_state: State, params: Params) -> Scalar:
        tip, thing, goal = self._places(next_state).reshape(3, 3)
        near, far = distance(thing - tip), distance(thing - goal)
        effort = self.reward_control_weight * jnp.sum(action**2)
        return -self.reward_near_weight * near - self.reward_dist_weight * far - effort

    def _places(self, state: State) -> Float[Array, "9"]:
        return seen(self.reading(state, "places"), self._kinematics(state.q))

    def _kinematics(self, q: Position) -> Float[Array, "9"]:
        """Tip, object and goal [m]."""
        mechanism, zero = _mechanism(self.source()), jnp.zeros_like(q[0])
        frames = frames_of(mechanism.links, list(q))
        found = []
        for name in _PLACES:
            place = next(p for p in mechanism.places if p.name == name)
            rotation, origin = frames[place.link]
            found += [zero + x for x in alg.vadd(origin, alg.apply(rotation, place.position))]
        return jnp.stack(found)
