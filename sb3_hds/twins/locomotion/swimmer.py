"""Twin of Gymnasium's ``Swimmer-v5``."""

from sb3_hds.core import Actuator, Channel, Joint
from sb3_hds.twins.locomotion.task import ForwardTask
from sb3_hds.twins.mujoco.engine.values import declared, natives

_MOTORS = ("motor1_rot", "motor2_rot")


class Swimmer(ForwardTask):
    r"""
    A chain of three links in a viscous medium, seen from above.

    .. math:: r = w\,(x' - x) / \Delta t - c\,|u|^2

    with :math:`w` = 1 and :math:`c` = 1e-4. There is no termination.
    """

    name = "Swimmer"
    env_id = "Swimmer-v5"
    dt = 0.04
    substeps = 4
    max_episode_steps = 1000
    n_excluded = 2
    options = {
        "xml_file": "swimmer.xml",
        "forward_reward_weight": 1.0,
        "ctrl_cost_weight": 1e-4,
        "reset_noise_scale": 0.1,
        "exclude_current_positions_from_observation": True,
    }
    joints = (
        Joint("slider1", "m"),
        Joint("slider2", "m"),
        Joint("free_body_rot"),
        *map(Joint, _MOTORS),
    )
    positions = tuple(Channel(f"{joint.name}_position", joint.unit) for joint in joints)
    actuators = tuple(Actuator(motor, "1", -1.0, 1.0) for motor in _MOTORS)
    parameters = declared(
        masses=dict.fromkeys(("torso", "mid", "back"), 35.604716740684324),
        damping=dict.fromkeys(_MOTORS, 0.0),
        motors=_MOTORS,
        gravity=None,
        friction=False,
    )
    native_effects = natives(joints, actuators, parameters)
