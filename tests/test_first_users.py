"""What went wrong at first users' comes out right, or is refused."""

import first_users
import pytest

from sb3_hds import diagnose

pytestmark = pytest.mark.expensive  # a whole diagnosis each


def asked(given, **arguments):
    twin, data = given
    return diagnose(twin, data, progress=False, **arguments)


def sizes(found):
    return {f.key: {name: e.estimate for name, e in f.parameters.items()} for f in found.findings}


def test_a_joint_has_viscous_and_dry_friction_beside_an_inertia_that_nobody_believed():
    diagnosis = asked(first_users.joint_with_friction(believed=8.0), calibrate=["mass"])
    found = sizes(diagnosis)

    assert found.keys() == {"viscous_friction.axis", "coulomb_friction.axis"}
    assert found["viscous_friction.axis"]["b"] == pytest.approx(22.0, rel=0.05)
    assert found["coulomb_friction.axis"]["tau_c"] == pytest.approx(13.0, rel=0.05)
    assert diagnosis.twin.values["mass"] == pytest.approx(5.0, rel=0.05)


def test_a_flipped_command_is_a_wrong_sign_and_never_a_mass_of_a_billion():
    found = asked(first_users.flipped_command(), calibrate=["mass"])

    assert found.verdict == "unknown" or [f.effect for f in found.findings] == ["sign_flip"]
    assert 0.1 <= found.twin.values["mass"] <= 40.0


def test_a_pendulum_that_is_let_go_has_dry_friction():
    found = sizes(asked(first_users.free_pendulum()))

    assert found.keys() == {"coulomb_friction.hinge"}
    assert found["coulomb_friction.hinge"]["tau_c"] == pytest.approx(0.012, rel=0.05)


def test_a_twin_that_is_upside_down_is_told_so():
    found = asked(first_users.free_pendulum(zero="up"))

    assert found.verdict == "unknown" and not found.findings
    assert "half a turn" in found.unexplained


def test_an_angle_that_is_read_too_large_is_the_sensors_and_no_spring():
    found = sizes(asked(first_users.scaled_angle(), calibrate=["inertia", "damping"]))

    assert found == {"sensor_scale.hinge": {"scale": pytest.approx(1.04, abs=0.005)}}


def test_a_fast_oscillator_hardens():
    found = sizes(asked(first_users.fast_oscillator(), calibrate=["stiffness", "damping"]))

    assert found.keys() == {"cubic_stiffness.mass"}
    assert found["cubic_stiffness.mass"]["k3"] == pytest.approx(6e5, rel=0.05)
