"""Twin of Gymnasium's ``Walker2d-v5``."""

from sb3_hds.core import Actuator, Channel, Joint
from sb3_hds.twins.locomotion.task import PlanarWalker
from sb3_hds.twins.mujoco.engine.values import declared, natives

_RIGHT = ("thigh_joint", "leg_joint", "foot_joint")
_LEGS = (*_RIGHT, "thigh_left_joint", "leg_left_joint", "foot_left_joint")


class Walker2d(PlanarWalker):
    r"""
    Two legs of three links under a torso, in the plane. It ends when the torso is too low, too high
    or tilts.

    .. math:: r = w\,(x' - x) / \Delta t + h\,[\text{healthy}] - c\,|u|^2

    with :math:`w = h = 1` and :math:`c` = 1e-3. Healthy: the torso is between 0.8 and 2 m high
    (``healthy_z_range``) and tilts by less than 1 rad (``healthy_angle_range``).

    Velocities are clipped to 10 in the observation, and planning softens the limits.
    """

    name = "Walker2d"
    env_id = "Walker2d-v5"
    angle_width = 0.1
    options = {
        "xml_file": "walker2d_v5.xml",
        "forward_reward_weight": 1.0,
        "ctrl_cost_weight": 1e-3,
        "healthy_reward": 1.0,
        "terminate_when_unhealthy": True,
        "healthy_z_range": (0.8, 2.0),
        "healthy_angle_range": (-1.0, 1.0),
        "reset_noise_scale": 5e-3,
        "exclude_current_positions_from_observation": True,
    }
    joints = (Joint("rootx", "m"), Joint("rootz", "m"), Joint("rooty"), *map(Joint, _LEGS))
    positions = tuple(Channel(f"{joint.name}_position", joint.unit) for joint in joints)
    actuators = tuple(Actuator(joint, "1", -1.0, 1.0) for joint in _LEGS)
    parameters = declared(
        masses={
            "torso": 3.6651914291880923,
            "thigh": 4.057890510886818,
            "leg": 2.7813566959781637,
            "foot": 3.1667253948185117,
            "thigh_left": 4.057890510886818,
            "leg_left": 2.7813566959781637,
            "foot_left": 3.1667253948185117,
        },
        damping=dict.fromkeys(_LEGS, 0.1),
        motors=_LEGS,
    )
    native_effects = natives(joints, actuators, parameters)
