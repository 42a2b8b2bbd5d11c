"""The joint that each actuator of a MuJoCo model drives, and the place of its state."""

from typing import Any, NamedTuple

import gymnasium
import numpy as np
from jaxtyping import Float, Int

from sb3_hds.errors import EnvironmentMismatchError

# mjTRN_JOINT, mjJNT_SLIDE, mjJNT_HINGE and mjBIAS_AFFINE of MuJoCo's enumerations.
_JOINT_TRANSMISSION = 0
_ONE_AXIS = (2, 3)
_AFFINE = 1
#: attribute of an environment whose commands are positions of its joints already
COMMANDS_POSITIONS = "commands_positions"

Angles = Float[np.ndarray, "*batch act"]


class ActuatedJoints(NamedTuple):
    """
    The joints that are driven, in the order of the actuators, which need not be that of the state:
    Ant's first actuator drives its last leg.

    :param names: of the joints
    :param position: of each in ``qpos``
    :param velocity: of each in ``qvel``
    :param n_positions: length of ``qpos``
    :param lower: end of its range [rad] or [m]; -inf where it has none
    :param upper: likewise
    :param rest: where the model puts it at first
    """

    names: tuple[str, ...]
    position: Int[np.ndarray, " act"]
    velocity: Int[np.ndarray, " act"]
    n_positions: int
    lower: Float[np.ndarray, " act"]
    upper: Float[np.ndarray, " act"]
    rest: Float[np.ndarray, " act"]

    def of_state(self, state: Float[np.ndarray, "*batch state"]) -> tuple[Angles, Angles]:
        """
        :param state: ``qpos`` and ``qvel`` in a row, as ``MujocoEnv.state_vector`` returns them
        :return: positions and velocities of the joints
        """
        return state[..., self.position], state[..., self.n_positions + self.velocity]


def actuated_joints(model: Any) -> ActuatedJoints:
    """
    :param model: an ``MjModel``
    :raises EnvironmentMismatchError: if an actuator drives something else than one joint with one
        axis (a tendon, a ball, a site)
    """
    joints = np.asarray(model.actuator_trnid)[:, 0]
    by_joint = np.asarray(model.actuator_trntype) == _JOINT_TRANSMISSION
    fine = by_joint & np.isin(np.asarray(model.jnt_type)[np.where(by_joint, joints, 0)], _ONE_AXIS)
    if not fine.all():
        names = ", ".join(model.actuator(int(i)).name or str(i) for i in np.flatnonzero(~fine))
        raise EnvironmentMismatchError(
            f"A position can be tracked where an actuator drives one hinge or slide; these do not: "
            f"{names}. Let the oscillators command the actuators directly: control='direct'."
        )
    limited = np.asarray(model.jnt_limited)[joints].astype(bool)
    ranges = np.asarray(model.jnt_range)[joints]
    position = np.asarray(model.jnt_qposadr)[joints].astype(int)
    return ActuatedJoints(
        names=tuple(model.joint(int(joint)).name for joint in joints),
        position=position,
        velocity=np.asarray(model.jnt_dofadr)[joints].astype(int),
        n_positions=int(model.nq),
        lower=np.where(limited, ranges[:, 0], -np.inf),
        upper=np.where(limited, ranges[:, 1], np.inf),
        rest=np.asarray(model.qpos0, float)[position],
    )


def commands_positions(model: Any) -> bool:
    """:return: whether an actuator is a servo, whose commands are positions"""
    affine = np.asarray(model.actuator_biastype) == _AFFINE
    return bool(np.any(affine & (np.asarray(model.actuator_biasprm)[:, 1] != 0.0)))


def refuse_servos(model: Any, declared: Any) -> None:
    """
    :param model: an ``MjModel``
    :param declared: the attribute ``commands_positions`` of the environment
    :raises EnvironmentMismatchError: if commands are positions, which are tracked already
    """
    if declared or commands_positions(model):
        raise EnvironmentMismatchError(
            "The commands of this environment are positions: its own servos track them, and a "
            "second loop around those would not arrive. Let the oscillators be the commands: "
            "control='direct'."
        )


def joints_of(env: gymnasium.Env) -> ActuatedJoints | None:
    """:return: of the MuJoCo environment inside; None if there is none"""
    model = getattr(env.unwrapped, "model", None)
    return actuated_joints(model) if hasattr(model, "actuator_trnid") else None


def track(
    target: Angles, position: Angles, velocity: Angles, kp: Angles | float, kd: Angles | float
) -> Angles:
    r"""
    :math:`k_p (q^* - q) - k_d\,\dot q`, in the unit of the actuators' commands, not clipped.

    :param kp: command per rad or m
    :param kd: command per rad/s or m/s
    """
    return kp * (target - position) - kd * velocity
