"""What went wrong at first users' comes out right, or is refused."""

import first_users
import pytest
from cases import each

from sb3_hds import diagnose

pytestmark = pytest.mark.expensive  # a whole diagnosis each
FRICTION = {"viscous_friction.axis": {"b": 22.0}, "coulomb_friction.axis": {"tau_c": 13.0}}
SCALE = pytest.approx(1.04, abs=0.005)


@each(
    # Beside an inertia that nobody believed.
    (lambda: first_users.joint_with_friction(believed=8.0), ["mass"], FRICTION),
    (first_users.free_pendulum, [], {"coulomb_friction.hinge": {"tau_c": 0.012}}),
    # The sensor's, and no spring.
    (first_users.scaled_angle, ["inertia", "damping"], {"sensor_scale.hinge": {"scale": SCALE}}),
    ids=["friction", "let go", "scaled"],
)
def test_cases_of_first_users_are_found(given, calibrate, expected):
    twin, data = given()

    found = diagnose(twin, data, calibrate=calibrate, progress=False)

    assert {finding.key for finding in found.findings} == set(expected), found
    for finding in found.findings:
        for name, size in expected[finding.key].items():
            near = pytest.approx(size, rel=0.05) if isinstance(size, float) else size
            assert finding.parameters[name].estimate == near
    assert "mass" not in calibrate or found.twin.values["mass"] == pytest.approx(5.0, rel=0.05)


def test_a_flipped_command_is_a_wrong_sign_and_never_a_mass_of_a_billion():
    twin, data = first_users.flipped_command()
    found = diagnose(twin, data, calibrate=["mass"], progress=False)
    assert found.verdict == "unknown" or [f.effect for f in found.findings] == ["sign_flip"]
    assert 0.1 <= found.twin.values["mass"] <= 40.0
