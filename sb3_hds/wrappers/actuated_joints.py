"""The joint that each actuator of a MuJoCo model drives, and where its state is."""

from typing import Any, NamedTuple

import gymnasium
import numpy as np
from jaxtyping import Float, Int

from sb3_hds.errors import EnvironmentMismatchError

# mjTRN_JOINT, mjJNT_SLIDE, mjJNT_HINGE and mjBIAS_AFFINE of MuJoCo's enumerations.
_JOINT_TRANSMISSION = 0
_ONE_AXIS = (2, 3)
_AFFINE = 1
#: attribute of an environment that says that its commands are joint positions
COMMANDS_POSITIONS = "commands_positions"

Angles = Float[np.ndarray, "*batch act"]


class ActuatedJoints(NamedTuple):
    """
    The actuated joints, in the order of the actuators, which need not be that of the state: Ant's
    first actuator drives its last leg.

    :param names: of the joints
    :param position: index of each in ``qpos``
    :param velocity: index of each in ``qvel``
    :param n_positions: length of ``qpos``
    :param lower: lower end of each range [rad] or [m]; -inf if it has none
    :param upper: upper end; inf if it has none
    :param rest: initial position in the model [rad] or [m]
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
        :param state: ``qpos`` followed by ``qvel``, as from ``MujocoEnv.state_vector``
        :return: positions and velocities of the joints
        """
        return state[..., self.position], state[..., self.n_positions + self.velocity]


def actuated_joints(model: Any) -> ActuatedJoints:
    """
    :param model: an ``MjModel``
    :raises EnvironmentMismatchError: if an actuator drives anything but a hinge or a slide (a
        tendon, a ball joint, a site)
    """
    joints = np.asarray(model.actuator_trnid)[:, 0]
    by_joint = np.asarray(model.actuator_trntype) == _JOINT_TRANSMISSION
    fine = by_joint & np.isin(np.asarray(model.jnt_type)[np.where(by_joint, joints, 0)], _ONE_AXIS)
    if not fine.all():
        names = ", ".join(model.actuator(int(i)).name or str(i) for i in np.flatnonzero(~fine))
        raise EnvironmentMismatchError(
            "Positions can be tracked only if each actuator drives one hinge or slide; these do "
            f"not: {names}. Let the oscillators command the actuators directly: control='direct'."
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
    """:return: whether any actuator is a position servo"""
    affine = np.asarray(model.actuator_biastype) == _AFFINE
    return bool(np.any(affine & (np.asarray(model.actuator_biasprm)[:, 1] != 0.0)))


def refuse_servos(model: Any, declared: Any) -> None:
    """
    :param model: an ``MjModel``
    :param declared: the attribute ``commands_positions`` of the environment
    :raises EnvironmentMismatchError: if commands are positions, which servos track already
    """
    if declared or commands_positions(model):
        raise EnvironmentMismatchError(
            "The commands of this environment are positions: its own servos track them, and a "
            "second loop around those would not converge. Let the oscillators be the commands: "
            "control='direct'."
        )


def joints_of(env: gymnasium.Env) -> ActuatedJoints | None:
    """:return: the joints of the MuJoCo environment inside; None if it is not of MuJoCo"""
    model = getattr(env.unwrapped, "model", None)
    return actuated_joints(model) if hasattr(model, "actuator_trnid") else None


def track(
    target: Angles, position: Angles, velocity: Angles, kp: Angles | float, kd: Angles | float
) -> Angles:
    r"""
    :math:`k_p (q^* - q) - k_d\,\dot q`, in the unit of the commands, not clipped.

    :param kp: command per rad or m
    :param kd: command per rad/s or m/s
    """
    return kp * (target - position) - kd * velocity
