"""
Ask about one cause that is suspected: dry friction at both joints of DFKI's double pendulum.

    export SB3_HDS_DATA=/where/the/data/are
    python examples/suspected_friction.py

`diagnose` asks which of all causes it is; `calibrate` asks how large those are that it is given.
How far the answer depends on what else is believed is asked in turn: which parameters are free, how
long windows are, and which torque acts when.
"""

import numpy as np
from measured_rigs import dfki

from sb3_hds import Trajectories, effects
from sb3_hds.core import Twin
from sb3_hds.sysid import calibrate

DRY = ("coulomb_friction.joint1.tau_c", "coulomb_friction.joint2.tau_c")
VISCOUS = ("viscous_friction.joint1.b", "viscous_friction.joint2.b")
INERTIAS = ("inertia1", "inertia2", "rotor_inertia")


def main() -> None:
    believed, reported, _ = dfki()
    twin = believed.extend(*(effects.CoulombFriction(joint, tau_c=0.1) for joint in (0, 1)))
    damped = twin.extend(*(effects.ViscousFriction(joint, b=0.002) for joint in (0, 1)))
    half, fifth = (round(seconds / reported.dt) for seconds in (0.5, 0.2))
    ask("dry friction", twin, reported, DRY, half)
    ask("windows of 0.2 s", twin, reported, DRY, fifth)
    ask("inertias", twin, reported, DRY + INERTIAS, half)
    ask("inertias, windows of 0.2 s", twin, reported, DRY + INERTIAS, fifth)
    ask("viscous friction", damped, reported, DRY + VISCOUS, half)
    ask("torques as commanded", twin, dfki("tau_con").data, DRY, half)
    for samples in (2, 3, 4, 5):
        late = f"torques reported {1e3 * samples * reported.dt:.0f} ms late"
        ask(late, twin, earlier(reported, samples), DRY, half)


def ask(what: str, twin: Twin, data: Trajectories, free: tuple[str, ...], window: int) -> None:
    found = calibrate(twin, data, free=free, window=window)
    print(f"{what}: error {np.exp(np.log(found.error_after).mean()):.4f}")
    for name in free:
        one = found[name]
        print(f"  {name:<32} {one.estimate:.3g} +- {one.stderr:.2g} {one.unit}")


def earlier(data: Trajectories, samples: int) -> Trajectories:
    """:return: the same with torques that act so many samples before they are reported"""
    pairs = (data.episode(i) for i in range(len(data)))
    obs, actions = zip(*((o[:-samples], u[samples:]) for o, u in pairs), strict=True)
    return Trajectories.from_arrays(obs, actions, dt=data.dt)


if __name__ == "__main__":
    main()
