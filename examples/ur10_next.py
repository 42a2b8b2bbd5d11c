"""
What to record next on joint 5 of a UR10, within the arm's limits, after 27.5 s of its motion.

    export SB3_HDS_DATA=/where/the/data/are
    python examples/ur10_next.py --folder ur10_next

The bag and the URDF are those of the page on model files. Joint 5 is asked alone, as if the others
stood where they were on average: its twin is the URDF without the other joints, and its efforts are
those measured, less what the motion of the other joints takes by rigid-body dynamics. Writes the
commands into ``ur10_next/next.csv`` and draws them.
"""

import argparse
import os
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from scipy.signal import savgol_filter

from sb3_hds import Trajectories, diagnose, twins
from sb3_hds.sysid import NextExperiment

# Its functions are not in its type stubs.
_engine: Any = mujoco

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
FIFTH, DT = 4, 0.008
# Of the data sheet: 54 N m and, with all joints, 2 rad/s; half of that beside people [rad, rad/s].
LIMITS = {"position": [-1.5, 1.5], "velocity": 1.0, "torque": 12.0, "command": [-12.0, 12.0]}
LIMITS |= {"bandwidth": 2.0}
SECONDS = 4.0
# Window and degree of the polynomial by which accelerations are formed.
_ROWS, _DEGREE = 25, 3


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").strip().splitlines()[0])
    parser.add_argument("--folder", type=Path, default=Path("ur10_next"), help="where results go")
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    found, asked = asked_of_joint_5(Path(os.environ["SB3_HDS_DATA"], "ur10"))
    print(found, found.answers, asked, sep="\n\n")
    asked.save(options.folder / "next.csv")
    asked.plot(options.folder / "next.png")


def asked_of_joint_5(folder: Path) -> tuple[Any, NextExperiment]:
    """:return: the diagnosis of joint 5, and what it asks for"""
    arm = columns_of(folder / "ur10_exciting_trajectory.db3")
    urdf = str(folder / "ur10.urdf")
    alone = alone_at(urdf, arm.obs[0, :, : len(JOINTS)].mean(0))
    twin = twins.from_mujoco(alone, dt=DT, actuators="torque")
    data = of_joint_5(arm, _engine.MjModel.from_xml_path(urdf), alone.compile())
    found = diagnose(twin, data, budget="quick", progress=False)
    return found, found.next_experiment(LIMITS, seconds=SECONDS, progress=False)


def columns_of(bag: Path) -> Trajectories:
    """:return: positions and velocities of all joints, and their efforts"""
    signal = lambda kind, joint: {"column": f"/joint_states:{kind}[{joint}_joint]"}  # noqa: E731
    columns = {
        "obs": [signal(kind, joint) for kind in ("position", "velocity") for joint in JOINTS],
        "actions": [signal("effort", joint) for joint in JOINTS],
    }
    return Trajectories.load(bag, columns=columns).resample(dt=DT)


def alone_at(urdf: str, pose: np.ndarray) -> Any:
    """:return: the model in which all joints but the fifth are fixed in a pose"""
    spec = _engine.MjSpec.from_file(urdf)
    for joint, angle in zip(JOINTS, pose, strict=True):
        if joint == JOINTS[FIFTH]:
            continue
        hinge = spec.joint(f"{joint}_joint")
        turn, quat = np.zeros(4), np.zeros(4)
        _engine.mju_axisAngle2Quat(turn, hinge.axis, angle)
        _engine.mju_mulQuat(quat, hinge.parent.quat, turn)
        hinge.parent.quat = quat
        spec.delete(hinge)
    return spec


def of_joint_5(arm: Trajectories, whole: Any, alone: Any) -> Trajectories:
    """:return: its motion, and the torque that would have made it so without the other joints"""
    obs, actions = arm.episode(0)
    n = len(actions)
    q, v = obs[:n, : len(JOINTS)], obs[:n, len(JOINTS) :]
    a: Any = savgol_filter(v, _ROWS, _DEGREE, deriv=1, delta=DT, axis=0)
    fifth = [FIFTH]
    torque = actions[:, fifth] - inverse_dynamics(whole, q, v, a)[:, fifth]
    torque += inverse_dynamics(alone, q[:, fifth], v[:, fifth], a[:, fifth])
    seen = np.concatenate([obs[: n + 1, fifth], obs[: n + 1, [len(JOINTS) + FIFTH]]], 1)
    return Trajectories.from_arrays([seen], [torque], dt=DT)


def inverse_dynamics(model: Any, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
    data, torques = _engine.MjData(model), []
    for data.qpos[:], data.qvel[:], data.qacc[:] in zip(q, v, a, strict=True):
        _engine.mj_inverse(model, data)
        torques.append(data.qfrc_inverse.copy())
    return np.array(torques)


if __name__ == "__main__":
    main()
