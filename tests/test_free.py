"""Parameters that are estimated: by name, and several that take one value."""

import numpy as np
import pytest
import small_robots as robots
from cases import each
from measuring import measured

from sb3_hds import effects, twins
from sb3_hds.errors import CalibrationError
from sb3_hds.sysid import calibrate
from sb3_hds.sysid.estimation.parameters import tie

DAMPING = ("j0_damping", "j1_damping")
LATE = ("action_delay.m0.delay", "action_delay.m1.delay")


@pytest.fixture(scope="module")
def leg():
    """Two joints alike, whose commands come late on one bus."""
    bare = robots.chain(2, damping=0.1, actuator="position", option='integrator="implicitfast"')
    twin = twins.from_mujoco(bare, dt=0.01)
    return twin.extend(*(effects.ActionDelay(i, longest=0.1) for i in range(2)))


def test_what_is_tied_takes_one_value_and_counts_once(leg):
    truth = dict.fromkeys(DAMPING, 0.4) | dict.fromkeys(LATE, 0.025)
    time = 0.01 * np.arange(100)[:, None]
    swing = [0.5 * np.sin((4.0 + k) * time + np.array([0.0, 1.0])) for k in range(3)]
    real = leg.with_parameters(**truth)
    data = measured(real, n=3, n_steps=100, noise=1e-4, commands=np.stack(swing))

    fit = calibrate(leg, data, free=[*DAMPING], tied={"damping": DAMPING, "delay": LATE})

    assert [estimate.name for estimate in fit.estimates] == ["damping", "delay"]
    assert fit["damping"].estimate == pytest.approx(0.4, rel=0.02)
    assert fit["delay"].estimate == pytest.approx(0.025, abs=1e-3)
    assert fit.covariance.shape == (2, 2)
    for label, members in {"damping": DAMPING, "delay": LATE}.items():
        assert {fit.twin.values[name] for name in members} == {fit[label].estimate}


@each(
    ({"damping": ("j0_damping", "j9_damping")}, "j9_damping"),
    ({"a": DAMPING, "b": DAMPING}, "j0_damping"),
    ({"j0_damping": DAMPING}, "name of its own"),
    ({"both": ()}, "both"),
    ({"both": ("j0_damping", "j0_armature")}, "unit, bounds or value differ"),
)
def test_what_cannot_take_one_value_is_refused(tied, told, leg):
    with pytest.raises(CalibrationError, match=told):
        tie(leg, DAMPING, tied)
