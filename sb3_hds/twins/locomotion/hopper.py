"""Twin of Gymnasium's ``Hopper-v5``."""

import jax.numpy as jnp

from sb3_hds.core import Actuator, Channel, Joint, State
from sb3_hds.core.types import Flag
from sb3_hds.twins.locomotion.task import PlanarWalker, inside
from sb3_hds.twins.mujoco.engine.values import declared, natives

_LEG = ("thigh_joint", "leg_joint", "foot_joint")


class Hopper(PlanarWalker):
    r"""
    A leg of three links under a torso, in the plane. It ends when the torso is too low or tilts.

    .. math:: r = w\,(x' - x) / \Delta t + h\,[\text{healthy}] - c\,|u|^2

    with :math:`w = h = 1` and :math:`c` = 1e-3. Healthy: the torso is above 0.7 m
    (``healthy_z_range``), tilts by less than 0.2 rad (``healthy_angle_range``), and all other
    numbers of the state are below 100 in size (``healthy_state_range``).

    Velocities are clipped to 10 in the observation, and planning softens the limits.
    """

    name = "Hopper"
    env_id = "Hopper-v5"
    angle_width = 0.04
    options = {
        "xml_file": "hopper.xml",
        "forward_reward_weight": 1.0,
        "ctrl_cost_weight": 1e-3,
        "healthy_reward": 1.0,
        "terminate_when_unhealthy": True,
        "healthy_state_range": (-100.0, 100.0),
        "healthy_z_range": (0.7, float("inf")),
        "healthy_angle_range": (-0.2, 0.2),
        "reset_noise_scale": 5e-3,
        "exclude_current_positions_from_observation": True,
    }
    healthy_state_range: tuple[float, float]
    joints = (Joint("rootx", "m"), Joint("rootz", "m"), Joint("rooty"), *map(Joint, _LEG))
    positions = tuple(Channel(f"{joint.name}_position", joint.unit) for joint in joints)
    actuators = tuple(Actuator(joint, "1", -1.0, 1.0) for joint in _LEG)
    parameters = declared(
        masses={
            "torso": 3.6651914291880923,
            "thigh": 4.057890510886818,
            "leg": 2.7813566959781637,
            "foot": 5.315574769873931,
        },
        damping=dict.fromkeys(_LEG, 1.0),
        motors=_LEG,
    )
    native_effects = natives(joints, actuators, parameters)

    def healthy(self, state: State) -> Flag:
        rest = jnp.concatenate([state.q[2:], state.v])
        fine = jnp.all(inside(rest, *self.healthy_state_range))
        return fine & super().healthy(state)
