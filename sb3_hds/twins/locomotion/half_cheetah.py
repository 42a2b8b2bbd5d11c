"""Twin of Gymnasium's ``HalfCheetah-v5``."""

from sb3_hds.core import Actuator, Channel, Joint
from sb3_hds.twins.locomotion.task import ForwardTask
from sb3_hds.twins.mujoco.engine.values import declared, natives

_LEGS = ("bthigh", "bshin", "bfoot", "fthigh", "fshin", "ffoot")


class HalfCheetah(ForwardTask):
    r"""
    A cheetah in the plane: a torso with two legs of three links, on the ground.

    .. math:: r = w\,(x' - x) / \Delta t - c\,|u|^2

    with the weights :math:`w` = 1 (``forward_reward_weight``) and :math:`c` = 0.1
    (``ctrl_cost_weight``). There is no termination.
    """

    name = "HalfCheetah"
    env_id = "HalfCheetah-v5"
    dt = 0.05
    substeps = 5
    max_episode_steps = 1000
    normal_speeds = True
    options = {
        "xml_file": "half_cheetah.xml",
        "forward_reward_weight": 1.0,
        "ctrl_cost_weight": 0.1,
        "reset_noise_scale": 0.1,
        "exclude_current_positions_from_observation": True,
    }
    joints = (Joint("rootx", "m"), Joint("rootz", "m"), Joint("rooty"), *map(Joint, _LEGS))
    positions = tuple(Channel(f"{joint.name}_position", joint.unit) for joint in joints)
    actuators = tuple(Actuator(leg, "1", -1.0, 1.0) for leg in _LEGS)
    parameters = declared(
        masses={
            "torso": 6.25020920502092,
            "bthigh": 1.5435146443514645,
            "bshin": 1.5874476987447697,
            "bfoot": 1.0953974895397491,
            "fthigh": 1.4380753138075317,
            "fshin": 1.200836820083682,
            "ffoot": 0.8845188284518829,
        },
        damping=dict(zip(_LEGS, (6.0, 4.5, 3.0, 4.5, 3.0, 1.5), strict=True)),
        motors=_LEGS,
    )
    native_effects = natives(joints, actuators, parameters)
