"""A corrected twin becomes a model file again, which MuJoCo steps as the twin does."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import small_robots as robots
from cases import each

from sb3_hds import effects, twins
from sb3_hds.core import rollout
from sb3_hds.core.belief import BeliefTwin
from sb3_hds.errors import ModelFileError

pytestmark = pytest.mark.usefixtures("x64")


def written_and_moved_as_the_twin(twin, path, source):
    """:return: what was written"""
    t, n = np.arange(60) * twin.dt, len(twin.joints)
    sizes = [0.8 * min(a.high, 1.0) for a in twin.actuators]
    actions = np.stack([m * np.sin((3.0 + i) * t + i) for i, m in enumerate(sizes)], 1)
    start = np.array(twin.initial(jax.random.key(0), twin.params).q, float)
    state = twin.infer(jnp.asarray(np.r_[start, np.zeros(n)]), twin.params)
    ours = rollout(twin, twin.params, state, jnp.asarray(actions)).obs

    written = twins.write_model(twin, path, source)

    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    data.qpos[:] = start
    for action, seen in zip(actions, ours[1:], strict=True):
        data.ctrl[:] = action
        mujoco.mj_step(model, data, twin.substeps)
        # MuJoCo writes seven digits.
        np.testing.assert_allclose(seen, np.r_[data.qpos, data.qvel], rtol=2e-5, atol=2e-5)
    return written


ARM = robots.chain(3)
CHANGED = {"j0_damping": 0.7, "j1_armature": 0.05, "j2_stiffness": 0.4, "m0_gain": 1.2}


def test_joints_gains_gravity_and_payload_of_a_twin_are_those_of_the_file(tmp_path):
    xml = robots.chain(3, stiffness=0.1, option='integrator="implicitfast"')
    twin = twins.from_mujoco(xml, dt=0.01, payload="tip")
    load = {"tip_payload": 0.5, "tip_payload_x": 0.03}
    twin = twin.with_parameters(**CHANGED, **load, tilt_x=0.1, tilt_y=-0.05)

    found = written_and_moved_as_the_twin(twin, tmp_path / "arm.xml", xml)

    assert twin.substeps == 5 and not found.left_out
    assert [path.name for path in tmp_path.iterdir()] == ["arm.xml"]
    back = twins.from_mujoco(tmp_path / "arm.xml")
    assert {name: back.values[name] for name in CHANGED} == pytest.approx(CHANGED)
    assert "j0_damping: 0.7 N m s/rad (was 0.1)" in found.changed


def test_masses_centres_and_inertias_are_those_of_the_file(tmp_path):
    with pytest.warns(UserWarning, match="no data can identify"):
        twin = twins.from_mujoco(robots.GRIPPER, masses=True)
    left = {"left_mass": 0.2, "left_com_x": 0.004, "left_stretch_y": 0.3, "left_shear_xz": 0.2}

    # The left finger carries a pad rigidly, whose own mass stays what it is.
    found = written_and_moved_as_the_twin(
        twin.with_parameters(**left, wrist_mass=0.9), tmp_path / "g.xml", robots.GRIPPER
    )

    assert any(line.startswith("inertial of left: 0.18 kg") for line in found.changed)


def test_what_happens_to_commands_is_in_the_file_where_it_can_be(tmp_path):
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
    written_and_moved_as_the_twin(without, tmp_path / "without.xml", xml)


def test_actuators_that_a_urdf_does_not_have_are_in_the_file(tmp_path):
    given = {"kind": "position", "kp": 40.0, "kv": 3.0}
    twin = twins.from_mujoco(robots.URDF, actuators=given, dt=0.008)
    twin = twin.with_parameters(shoulder_damping=0.5, shoulder_frictionloss=0.0)

    found = written_and_moved_as_the_twin(twin, tmp_path / "r.xml", robots.URDF)

    assert "actuator elbow" in found.changed


def test_a_urdf_is_corrected_where_it_can_say_it(tmp_path):
    with pytest.warns(UserWarning, match="no data can identify"):
        twin = twins.from_mujoco(robots.URDF, masses=True)
    values = {"shoulder_damping": 0.5, "elbow_frictionloss": 0.25, "elbow_armature": 0.01}
    path = tmp_path / "robot.urdf"

    changed = twin.with_parameters(**values, lower_mass=1.3, lower_com_z=-0.2)
    found = twins.write_model(changed, path, robots.URDF)

    assert "Measured on Tuesday" in path.read_text()
    assert found.left_out == ("elbow_armature: 0.01 kg m2",)
    back = twins.from_mujoco(path)
    assert back.values["shoulder_damping"] == 0.5 and back.values["elbow_frictionloss"] == 0.25
    assert back.values["elbow_damping"] == 0.1
    model = mujoco.MjModel.from_xml_path(str(path))
    assert model.body("lower").mass == 1.3
    assert model.body("lower").ipos == pytest.approx([0.0, 0.0, -0.2])


def test_meshes_stay_where_they_are(tmp_path):
    (tmp_path / "robot").mkdir()
    (tmp_path / "out").mkdir()
    square = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    (tmp_path / "robot" / "part.obj").write_text(square)
    mesh = '<asset><mesh name="part" file="part.obj"/></asset>'
    source = tmp_path / "robot" / "arm.xml"
    source.write_text(ARM.replace("<worldbody>", f"{mesh}<worldbody>"))

    twins.write_model(twins.from_mujoco(source), tmp_path / "out" / "arm.xml", source)

    assert mujoco.MjModel.from_xml_path(str(tmp_path / "out" / "arm.xml")).nmesh == 1


@each(
    ("a.txt", ARM, "not in '.txt'"),
    ("a.urdf", ARM, "only where the twin comes from one"),
    ("a.xml", robots.CART_POLE, "another robot: its joints are rail, hinge"),
    ("a.xml", "missing.xml", "There is no file 'missing.xml'"),
    ("of no file.xml", ARM, "was not made from a model file"),
)
def test_what_cannot_be_written_is_refused_and_leaves_no_file(name, source, message, tmp_path):
    twin = twins.make("Pendulum") if name.startswith("of no file") else twins.from_mujoco(ARM)
    with pytest.raises(ModelFileError, match=message):
        twins.write_model(twin, tmp_path / name, source)
    assert not list(tmp_path.iterdir())


def test_draws_of_a_belief_are_files_of_which_the_first_is_the_likeliest(tmp_path):
    twin = twins.from_mujoco(ARM, dt=0.01)
    names = list(twin.parameters)
    draws = np.tile(list(twin.values.values()), (5, 1))
    draws[:, names.index("j0_damping")] = [0.3, 0.4, 0.5, 0.6, 0.7]

    written = twins.write_models(BeliefTwin(twin, draws), tmp_path / "models", ARM, n=3)

    paths = sorted((tmp_path / "models").iterdir())
    found = [twins.from_mujoco(path).values["j0_damping"] for path in paths]
    assert found == pytest.approx([0.3, 0.5, 0.7]) and len(written) == 3
