"""
The time and memory of a diagnosis against the number of joints.

    python benchmarks/joints_cost.py
    python benchmarks/joints_cost.py --joints 1 6 --budgets quick
    python benchmarks/joints_cost.py --joints 6 --budgets quick --seconds 3600 --rate 1000
    python benchmarks/joints_cost.py --report-only

The data are of arms of 1 to 12 hinges on MuJoCo's engine: smooth random torques for 30 s at 125 Hz,
or as given, with noise on positions and velocities. Every joint has viscous and dry friction that
the model file lacks. Each row is a fresh process with an empty compilation cache; starting Python
and making the data do not count. Processor seconds are the sum over all cores and hardly depend on
other load. Proposals are complete when the set of causes is known from the equation of motion; the
verdict, when simulation has confirmed or rejected it.
"""

import argparse
import os
import resource
import time
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
from model_files import arm
from runs import RESULTS, arguments_of, fresh_process, resume, seconds_since_start

JOINTS = (1, 2, 3, 6, 12)
BUDGETS = ("quick", "full")
_RATE, _SECONDS = 125, 30
_ENGINE_RATE = 1000  # [Hz]
# Standard deviation of noise in units of what each channel does, of commands [N m] at the first
# joint, and the share of these that is left from joint to joint.
_NOISE, _COMMAND, _LESS = 2e-3, 6.0, 0.8
_VISCOUS, _DRY = 0.15, 0.1  # in units of a joint's command [s/rad], [1]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument("--joints", nargs="*", type=int, default=list(JOINTS))
    parser.add_argument("--budgets", nargs="*", default=list(BUDGETS), choices=BUDGETS)
    parser.add_argument("--seconds", type=int, default=_SECONDS)
    parser.add_argument("--rate", type=int, default=_RATE, choices=(125, 250, 500, 1000))
    parser.add_argument("--report-only", action="store_true")
    arguments = arguments_of(parser, worker)
    if not arguments.report_only:
        given = arguments.seconds, arguments.rate
        wanted = [(n, *given, budget) for n in arguments.joints for budget in arguments.budgets]
        keys = ("joints", "seconds", "rate [Hz]", "budget")
        resume("joints_cost", keys, wanted, partial(fresh_process, __file__), jobs=1)
    print(pd.read_csv(RESULTS / "joints_cost.csv").to_string(index=False, float_format="%.3g"))


def recorded(joints: int, seconds: int, rate: int) -> Any:
    """:return: one recording of an arm with friction that its file lacks"""
    import mujoco

    from sb3_hds import Trajectories

    rng = np.random.default_rng(joints)
    torque = _COMMAND * _LESS ** np.arange(joints)
    model = mujoco.MjModel.from_xml_string(arm(joints))
    model.opt.timestep = 1.0 / _ENGINE_RATE
    model.dof_damping[:] += _VISCOUS * torque
    model.dof_frictionloss[:] = _DRY * torque
    data = mujoco.MjData(model)
    n = rate * seconds
    time_ = np.arange(n) / rate
    waves = 2.0 * np.pi * rng.uniform(0.2, 2.0, (8, joints))
    phases = rng.uniform(0.0, 2.0 * np.pi, (8, joints))
    waving = (np.sin(time_[:, None] * w + p) for w, p in zip(waves, phases, strict=True))
    commands = sum(waving) / 2.0 * torque
    seen = [np.concatenate([data.qpos, data.qvel])]
    for command in commands:
        data.ctrl[:] = command
        for _ in range(_ENGINE_RATE // rate):
            mujoco.mj_step(model, data)
        seen.append(np.concatenate([data.qpos, data.qvel]))
    obs = np.array(seen)
    obs += _NOISE * obs.std(0) * rng.normal(size=obs.shape)
    return Trajectories.from_arrays([obs], [commands], dt=1.0 / rate)


def worker(joints: int, seconds: int, rate: int, budget: str) -> dict:
    from sb3_hds import diagnose, twins
    from sb3_hds.sysid.diagnosis import preparation

    data = recorded(joints, seconds, rate)
    twin = twins.from_mujoco(arm(joints), dt=data.dt)
    proposed: dict[str, float] = {}
    screen = preparation.screen

    def timed(*given: Any) -> Any:
        found = screen(*given)
        proposed["at"] = seconds_since_start()
        return found

    preparation.screen = timed
    begun, busy = seconds_since_start(), time.process_time()
    found = diagnose(twin, data, budget=budget, progress=False)
    friction = ("viscous_friction", "coulomb_friction")
    planted = {(effect, joint.name) for effect in friction for joint in twin.joints}
    named = {(f.effect, f.where["name"]) for f in found.findings}
    return {
        "proposals [s]": proposed["at"] - begun,
        "verdict [s]": seconds_since_start() - begun,
        "processor [s]": time.process_time() - busy,
        "peak memory [MiB]": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "load": os.getloadavg()[0],
        "frictions found": f"{len(planted & named)} of {len(planted)}",
        "other names": len(named - planted),
    }


if __name__ == "__main__":
    main()
