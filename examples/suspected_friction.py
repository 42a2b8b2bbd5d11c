"""
Ask about one cause that is suspected: dry friction at both joints of DFKI's double pendulum.

    export SB3_HDS_DATA=/where/the/data/are
    python examples/suspected_friction.py

`diagnose` asks which of all causes it is; `calibrate` asks how large those are that it is given.
"""

from measured_rigs import dfki

from sb3_hds import effects
from sb3_hds.sysid import calibrate

FRICTION = ("coulomb_friction.joint1.tau_c", "coulomb_friction.joint2.tau_c")
INERTIAS = ("inertia1", "inertia2", "rotor_inertia")


def main() -> None:
    believed, data, _ = dfki()
    twin = believed.extend(
        effects.CoulombFriction(0, tau_c=0.1), effects.CoulombFriction(1, tau_c=0.1)
    )
    for free in (FRICTION, FRICTION + INERTIAS):
        for seconds in (0.5, 0.2):
            found = calibrate(twin, data, free=free, window=round(seconds / data.dt))
            print(f"windows of {seconds} s:")
            for name in free:
                one = found[name]
                print(f"  {name:<32} {one.estimate:.3g} +- {one.stderr:.2g} {one.unit}")


if __name__ == "__main__":
    main()
