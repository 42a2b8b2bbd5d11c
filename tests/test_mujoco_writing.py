"""A corrected twin becomes a model file again, which MuJoCo steps as the twin does."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import small_robots as robots

from sb3_hds import effects, twins
from sb3_hds.core import rollout
from sb3_hds.errors import ModelFileError

pytestmark = pytest.mark.usefixtures("quick_compilation")

URDF = """<?xml version="1.0"?>
<robot name="two_links">
  <!-- Measured on Tuesday. -->
  <link name="world"/>
  <link name="upper"><inertial><origin xyz="0 0.1 -0.2"/><mass value="2"/>
    <inertia ixx="0.03" ixy="0" ixz="0" iyy="0.03" iyz="0.001" izz="0.004"/></inertial></link>
  <link name="lower"><inertial><origin xyz="0 0 -0.15"/><mass value="1"/>
    <inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.001"/></inertial></link>
  <joint name="shoulder" type="revolute"><parent link="world"/><child link="upper"/>
    <axis xyz="0 1 0"/><limit lower="-9" upper="9" effort="50" velocity="9"/></joint>
  <joint name="elbow" type="revolute"><parent link="upper"/><child link="lower"/>
    <origin xyz="0 0 -0.4"/><axis xyz="0 1 0"/>
    <limit lower="-9" upper="9" effort="20" velocity="9"/>
    <dynamics damping="0.1" friction="0"/></joint>
</robot>
"""


def commands(twin, n=60):
    """Smooth, and different for each actuator."""
    t = np.arange(n) * twin.dt
    limit = [min(a.high, 1.0) for a in twin.actuators]
    return np.stack([0.8 * m * np.sin((3.0 + i) * t + i) for i, m in enumerate(limit)], 1)


def moved(twin, actions, x64):
    params = {name: jnp.asarray(value, jnp.float64) for name, value in twin.values.items()}
    start = np.array(twin.initial(jax.random.key(0), twin.params).q, float)
    n_v = len(twin.joints)
    state = twin.infer(jnp.asarray(np.concatenate([start, np.zeros(n_v)])), params)
    return start, np.asarray(rollout(twin, params, state, jnp.asarray(actions)).obs)


def stepped(path, start, actions, substeps):
    """What the C engine makes of the file."""
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    data.qpos[:] = start
    seen = [np.concatenate([data.qpos, data.qvel])]
    for action in actions:
        data.ctrl[:] = action
        for _ in range(substeps):
            mujoco.mj_step(model, data)
        seen.append(np.concatenate([data.qpos, data.qvel]))
    return np.array(seen)


def check_parity(twin, path, source, x64, rtol=2e-5):
    actions = commands(twin)
    written = twins.write_model(twin, path, source)
    start, ours = moved(twin, actions, x64)
    theirs = stepped(path, start, actions, twin.substeps)
    # MuJoCo writes seven digits.
    np.testing.assert_allclose(ours, theirs, rtol=rtol, atol=rtol)
    return written


ARM = robots.chain(3)
CHANGED = {"j0_damping": 0.7, "j1_armature": 0.05, "j2_stiffness": 0.4, "m0_gain": 1.2}


def test_joints_gains_gravity_and_payload_of_a_twin_are_those_of_the_file(tmp_path, x64):
    xml = robots.chain(3, stiffness=0.1, option='integrator="implicitfast"')
    twin = twins.from_mujoco(xml, dt=0.01, payload="tip")
    load = {"tip_payload": 0.5, "tip_payload_x": 0.03}
    twin = twin.with_parameters(**CHANGED, **load, tilt_x=0.1, tilt_y=-0.05)

    found = check_parity(twin, tmp_path / "arm.xml", xml, x64)

    assert twin.substeps == 5 and not found.left_out
    assert [path.name for path in tmp_path.iterdir()] == ["arm.xml"]
    back = twins.from_mujoco(tmp_path / "arm.xml")
    assert {name: back.values[name] for name in CHANGED} == pytest.approx(CHANGED)
    assert "j0_damping: 0.7 N m s/rad (was 0.1)" in found.changed


def test_gains_of_servos_are_those_of_the_file(tmp_path, x64):
    xml = robots.chain(2, actuator="position", option='integrator="implicitfast"')
    twin = twins.from_mujoco(xml).with_parameters(m0_kv=3.0, m1_kv=2.0, m1_kp=31.0)

    check_parity(twin, tmp_path / "a.xml", xml, x64)


def test_masses_centres_and_inertias_are_those_of_the_file(tmp_path, x64):
    with pytest.warns(UserWarning, match="no data tell"):
        twin = twins.from_mujoco(robots.GRIPPER, masses=True)
    left = {"left_mass": 0.2, "left_com_x": 0.004, "left_stretch_y": 0.3, "left_shear_xz": 0.2}

    # The left finger carries a pad rigidly, whose own mass stays what it is.
    found = check_parity(
        twin.with_parameters(**left, wrist_mass=0.9), tmp_path / "g.xml", robots.GRIPPER, x64
    )

    assert any(line.startswith("inertial of left: 0.18 kg") for line in found.changed)


def test_what_happens_to_commands_is_in_the_file_where_it_can_be(tmp_path, x64):
    xml = robots.chain(2, actuator="position", option='integrator="implicitfast"')
    twin = twins.from_mujoco(xml, dt=0.01).extend(
        effects.TorqueGain(0, gain=0.8),
        effects.Saturation(1, limit=0.3),
        effects.ActionDelay(1, delay=0.02),
        effects.ConstantForce(0, tau_0=0.4),
        effects.ViscousFriction(1, b=0.3),
    )

    found = twins.write_model(twin, tmp_path / "arm.xml", xml)

    assert found.left_out == ("constant_force.j0.tau_0: 0.4",)
    assert "MJCF does not say:\n  constant_force.j0.tau_0: 0.4" in str(found)
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "arm.xml"))
    assert model.dof_damping[1] == pytest.approx(0.2 + 0.3)
    without = twins.from_mujoco(xml, dt=0.01).extend(
        *(a.effect for a in twin.attached if a.effect.name != "constant_force")
    )
    check_parity(without, tmp_path / "without.xml", xml, x64)


def test_actuators_that_a_urdf_does_not_have_are_in_the_file(tmp_path, x64):
    given = {"kind": "position", "kp": 40.0, "kv": 3.0}
    twin = twins.from_mujoco(URDF, actuators=given, dt=0.008)

    found = check_parity(twin.with_parameters(shoulder_damping=0.5), tmp_path / "r.xml", URDF, x64)

    assert "actuator elbow" in found.changed


def test_a_urdf_is_corrected_where_it_can_say_it(tmp_path):
    with pytest.warns(UserWarning, match="no data tell"):
        twin = twins.from_mujoco(URDF, masses=True)
    values = {"shoulder_damping": 0.5, "elbow_frictionloss": 0.25, "elbow_armature": 0.01}
    path = tmp_path / "robot.urdf"

    found = twins.write_model(
        twin.with_parameters(**values, lower_mass=1.3, lower_com_z=-0.2), path, URDF
    )

    assert "Measured on Tuesday" in path.read_text()
    assert found.left_out == ("elbow_armature: 0.01 kg m2",)
    back = twins.from_mujoco(path)
    assert back.values["shoulder_damping"] == 0.5 and back.values["elbow_frictionloss"] == 0.25
    assert back.values["elbow_damping"] == 0.1
    model = mujoco.MjModel.from_xml_path(str(path))
    assert model.body("lower").mass == 1.3
    assert model.body("lower").ipos == pytest.approx([0.0, 0.0, -0.2])


def test_dry_friction_of_the_file_predicts_what_the_twin_predicts(tmp_path, x64):
    """MuJoCo's joint sticks where the twin's creeps: while it moves, both do the same."""
    twin = twins.from_mujoco(URDF, dt=0.004).with_parameters(
        shoulder_frictionloss=0.6, elbow_frictionloss=0.2
    )
    actions = commands(twin, n=100) * [3.0, 0.6]
    twins.write_model(twin, tmp_path / "r.xml", URDF)

    start, ours = moved(twin, actions, x64)
    theirs = stepped(tmp_path / "r.xml", start, actions, twin.substeps)
    plain = moved(twins.from_mujoco(URDF, dt=0.004), actions, x64)[1]

    far = np.sqrt(np.mean((plain - theirs) ** 2, 0))
    assert np.all(np.sqrt(np.mean((ours - theirs) ** 2, 0)) < 0.1 * far)


def test_meshes_stay_where_they_are(tmp_path):
    (tmp_path / "robot").mkdir()
    (tmp_path / "out").mkdir()
    square = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    (tmp_path / "robot" / "part.obj").write_text(square)
    xml = ARM.replace(
        "<worldbody>", '<asset><mesh name="part" file="part.obj"/></asset><worldbody>'
    )
    source = tmp_path / "robot" / "arm.xml"
    source.write_text(xml)

    twins.write_model(twins.from_mujoco(source), tmp_path / "out" / "arm.xml", source)

    assert mujoco.MjModel.from_xml_path(str(tmp_path / "out" / "arm.xml")).nmesh == 1


@pytest.mark.parametrize(
    ("name", "source", "message"),
    [
        ("a.txt", ARM, "not in '.txt'"),
        ("a.urdf", ARM, "only where the twin comes from one"),
        ("a.xml", robots.CART_POLE, "another robot: its joints are rail, hinge"),
        ("a.xml", 7, "got int"),
        ("a.xml", "missing.xml", "There is no file 'missing.xml'"),
        ("of no file.xml", ARM, "was not made from a model file"),
    ],
)
def test_what_cannot_be_written_is_refused_and_leaves_no_file(name, source, message, tmp_path):
    twin = twins.make("Pendulum") if name.startswith("of no file") else twins.from_mujoco(ARM)
    with pytest.raises(ModelFileError, match=message):
        twins.write_model(twin, tmp_path / name, source)
    assert not list(tmp_path.iterdir())
