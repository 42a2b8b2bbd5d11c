"""Twin of Gymnasium's ``Ant-v5``."""

import functools
from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from sb3_hds.core import Actuator, Channel, Joint, State
from sb3_hds.core.types import Action, Flag, Obs, Params, Position, Scalar
from sb3_hds.twins.locomotion.task import HealthyTask, margin, seen
from sb3_hds.twins.mujoco.engine.simulator import Reading
from sb3_hds.twins.mujoco.engine.values import declared, natives

_LEGS = tuple(f"{part}_{i}" for i in range(1, 5) for part in ("hip", "ankle"))
_MOTORS = (*_LEGS[6:], *_LEGS[:6])
_TORSO = (1, "torso")
_N_BODIES = 14  # the world first
_WRENCH = ("torque_x", "torque_y", "torque_z", "force_x", "force_y", "force_z")
_HEIGHT = 0.03  # width of the soft limits of the planning reward [m]


@functools.cache
def _place(body: int | str) -> Reading:
    def read(data: Any) -> np.ndarray:
        return data.body(body).xpos[:2]

    return read


def _contact(data: Any) -> np.ndarray:
    return data.cfrc_ext


class Ant(HealthyTask):
    r"""
    A torso on four legs of two joints. It ends when the torso is too low or too high.

    .. math:: r = w\,(x' - x) / \Delta t + h\,[\text{healthy}] - c\,|u|^2 - k\,|f|^2

    with :math:`w = h = 1`, :math:`c` = 0.5 and :math:`k` = 5e-4, and the wrenches :math:`f` of
    contacts on all bodies, each number clipped to 1 in size (``contact_force_range``). Healthy: the
    torso is between 0.2 and 1 m high (``healthy_z_range``).

    Contact wrenches, and the place of the torso in the reward, are those of the last Runge-Kutta
    stage of the engine, as in the environment. They are kept in the state's memory. Contact
    wrenches have no derivative here. :meth:`infer` takes the wrenches from the observation, but
    that on the world, which is not observed, and the torso at zero, where the observation excludes
    it. Planning replaces the indicator by a product of logistic functions of the height, 1/2 at
    its limits.
    """

    name = "Ant"
    env_id = "Ant-v5"
    dt = 0.05
    substeps = 5
    max_episode_steps = 1000
    n_excluded = 2
    normal_speeds = True
    options = {
        "xml_file": "ant.xml",
        "forward_reward_weight": 1.0,
        "ctrl_cost_weight": 0.5,
        "contact_cost_weight": 5e-4,
        "healthy_reward": 1.0,
        "main_body": 1,
        "terminate_when_unhealthy": True,
        "healthy_z_range": (0.2, 1.0),
        "contact_force_range": (-1.0, 1.0),
        "reset_noise_scale": 0.1,
        "exclude_current_positions_from_observation": True,
        "include_cfrc_ext_in_observation": True,
    }
    contact_cost_weight: float
    main_body: int | str
    healthy_z_range: tuple[float, float]
    contact_force_range: tuple[float, float]
    include_cfrc_ext_in_observation: bool
    joints = (
        *(Joint(f"root_{axis}", "m") for axis in "xyz"),
        *(Joint(f"root_r{axis}") for axis in "xyz"),
        *map(Joint, _LEGS),
    )
    positions = (
        *(Channel(f"root_{axis}", "m") for axis in "xyz"),
        *(Channel(f"root_q{part}", "1") for part in "wxyz"),
        *(Channel(f"{joint}_position", "rad") for joint in _LEGS),
    )
    actuators = tuple(Actuator(joint, "1", -1.0, 1.0) for joint in _MOTORS)
    parameters = declared(
        masses={"torso": 0.32724923474893675},
        damping=dict.fromkeys(_LEGS, 1.0),
        motors=_MOTORS,
    )
    native_effects = natives(joints, actuators, parameters)

    def _channels(self) -> tuple[Channel, ...]:
        if not self.include_cfrc_ext_in_observation:
            return super()._channels()
        wrenches = (
            Channel(f"contact_{body}_{part}", "N m" if "torque" in part else "N")
            for body in range(1, _N_BODIES)
            for part in _WRENCH
        )
        return (*super()._channels(), *wrenches)

    def readings(self) -> Mapping[str, tuple[Reading, int]]:
        return {"place": (_place(self.main_body), 2), "contact": (_contact, 6 * _N_BODIES)}

    def at(self, q: Position, v: Array) -> State:
        if self.main_body not in _TORSO:
            return self.look(State(q, v, {}))
        nothing = jnp.zeros(6 * _N_BODIES, q.dtype)
        return self.with_readings(State(q, v, {}), place=q[:2], contact=nothing)

    def infer(self, obs: Obs, params: Params) -> State:
        """See the class for what is not observed."""
        state = super().infer(obs, params)
        if not self.include_cfrc_ext_in_observation:
            return state
        observed = obs[-6 * (_N_BODIES - 1) :]
        contact = jnp.concatenate([jnp.zeros(6, obs.dtype), observed])
        return self.with_readings(state, place=self.reading(state, "place"), contact=contact)

    def observe(self, state: State, params: Params) -> Obs:
        obs = super().observe(state, params)
        if not self.include_cfrc_ext_in_observation:
            return obs
        return jnp.concatenate([obs, self._contact(state)[6:]])

    def healthy(self, state: State) -> Flag:
        low, high = self.healthy_z_range
        finite = jnp.isfinite(state.q).all() & jnp.isfinite(state.v).all()
        return finite & (low <= state.q[2]) & (state.q[2] <= high)

    def health(self, state: State) -> Scalar:
        return margin(state.q[2], *self.healthy_z_range, _HEIGHT)

    def moving(self, state: State, action: Action, next_state: State, params: Params) -> Scalar:
        places = (seen(self.reading(s, "place")[0], s.q[0]) for s in (state, next_state))
        before, after = places
        speed = (after - before) / self.dt
        contact = self.contact_cost_weight * jnp.sum(self._contact(next_state) ** 2)
        effort = self.ctrl_cost_weight * jnp.sum(action**2)
        return self.forward_reward_weight * speed - effort - contact

    def _contact(self, state: State) -> Array:
        return jnp.clip(self.reading(state, "contact"), *self.contact_force_range)
