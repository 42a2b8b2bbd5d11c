"""
Diagnose rigs that others have measured and published.

    export SB3_HDS_DATA=/where/the/data/are
    python examples/measured_rigs.py emps --report emps.html

The data are not part of this project: each folder says where its files are from, and under which
licence. Each rig here is the model that its authors published, and what the data say of it.
"""

import argparse
import os
import warnings
from pathlib import Path
from typing import NamedTuple

import yaml

from sb3_hds import Trajectories, audit, diagnose, effects, twins
from sb3_hds.core import Twin
from sb3_hds.data import SamplingWarning


class Question(NamedTuple):
    """A published model, what was measured, and which of its parameters nobody vouches for."""

    twin: Twin
    data: Trajectories
    calibrate: tuple[str, ...]


def load(files: str, columns: dict, folder: Path | None = None) -> Trajectories:
    """:param files: pattern below ``SB3_HDS_DATA``"""
    folder = folder or Path(os.environ["SB3_HDS_DATA"])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SamplingWarning)
        return Trajectories.load(str(folder / files), columns=columns)


SERVO = {
    "time": "timestamp",
    "obs": ["position", "speed"],
    "actions": ["goal_position", "torque_enable", "kp"],
    "condition": {"column": "kp"},
}


def bam(files: str, voltage: float, duty_per_error: float, **values: float) -> Question:
    data = load(files, SERVO)
    data = audit(data).corrected(data)
    twin = twins.make(
        "ServoPendulum",
        dt=data.dt,
        commands="goal, enable, gain",
        voltage=voltage,
        duty_per_error=duty_per_error,
        **values,
    ).extend(effects.CoulombFriction(0, tau_c=0.03))
    motor = ("torque_constant", "resistance", "armature", "damping")
    return Question(twin, data, (*motor, "coulomb_friction.servo.tau_c"))


def bam_xl330() -> Question:
    """A hobby servo that swings 0.49 kg at 0.1 m: sixteen logs, four gains of its firmware."""
    steps_per_rad, scale = 4096 / 6.283185307179586, 256 * 885
    return bam(
        "bam_xl330/*.json",
        7.4,
        steps_per_rad / scale,
        mass=0.49,
        length=0.1,
        torque_constant=0.4,
        resistance=3.0,
        armature=0.002,
        damping=0.005,
    )


def bam_sts3250() -> Question:
    """A larger servo, logged at 47 Hz with one load: too little to say much."""
    return bam(
        "bam_sts3250/*.json",
        12.0,
        0.166,
        mass=1.13,
        length=0.12,
        torque_constant=1.5,
        resistance=2.0,
        armature=0.02,
        damping=0.05,
    )


def emps(files: str = "emps/DATA_EMPS.mat") -> Question:
    """A motor-driven carriage, with the friction model of its authors."""
    data = load(
        files,
        {"time": "t", "obs": ["qm"], "actions": [{"column": "vir", "scale": 35.150652}]},
    )
    twin = twins.make(
        "LinearAxis", dt=data.dt, substeps=1, observe="q", mass=95.1089, damping=203.5034
    ).extend(effects.CoulombFriction(0, tau_c=20.3935), effects.ConstantForce(0, tau_0=3.1648))
    names = ("mass", "damping", "coulomb_friction.axis.tau_c", "constant_force.axis.tau_0")
    return Question(twin, data, names)


def multiarm() -> Question:
    """One arm that swings freely: what its authors published seems to be all."""
    data = load(
        "multiarm_pendulum/SinglePendulumDataForParameterEstimation.mat",
        {"time": "Time_id", "obs": ["Y_id[0]", "Y_id[1]"], "actions": []},
    )
    twin = twins.make(
        "FreePendulum",
        dt=data.dt,
        substeps=1,
        zero="up",
        gravity=9.81,
        mass=0.147585,
        com=0.147755,
        inertia=1.091e-4,
        damping=2.239e-4,
    )
    return Question(twin, data, ("inertia", "damping"))


def dfki(torques: str = "tau_meas") -> Question:
    """
    A double pendulum whose friction somebody set to zero.

    :param torques: ``"tau_meas"``, which the drives report, or ``"tau_con"``, as commanded
    """
    folder = Path(os.environ["SB3_HDS_DATA"]) / "dfki_double_pendulum"
    data = load(
        "dfki_double_pendulum/*sys_id*.csv",
        {
            "time": "time",
            "obs": ["pos_meas1", "pos_meas2", "vel_meas1", "vel_meas2"],
            "actions": [f"{torques}1", f"{torques}2"],
        },
    )
    published = yaml.safe_load((folder / "params_design_A.0_model_2.0.yml").read_text())
    theirs = {
        "gravity": "g",
        "mass1": "m1",
        "mass2": "m2",
        "length1": "l1",
        "com1": "r1",
        "com2": "r2",
        "inertia1": "I1",
        "inertia2": "I2",
        "rotor_inertia": "Ir",
        "gear_ratio": "gr",
    }
    values = {ours: published[name] for ours, name in theirs.items()}
    twin = twins.make("DoublePendulum", dt=data.dt, substeps=1, **values)
    return Question(twin, data, ())


RIGS = {
    "bam_xl330": bam_xl330,
    "bam_sts3250": bam_sts3250,
    "emps": emps,
    "multiarm": multiarm,
    "dfki": dfki,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("rig", choices=RIGS)
    parser.add_argument("--report", help="HTML page to write")
    parser.add_argument("--pictures", help="folder for the pictures of that page")
    parser.add_argument("--budget", default="full", choices=("full", "quick"))
    arguments = parser.parse_args()
    question = RIGS[arguments.rig]()
    found = diagnose(
        question.twin, question.data, calibrate=question.calibrate, budget=arguments.budget
    )
    print(found)
    if arguments.report:
        print(found.to_html(arguments.report))
    if arguments.pictures:
        print(*found.save_pictures(arguments.pictures), sep="\n")


if __name__ == "__main__":
    main()
