"""Joints that stand still are welded: MuJoCo moves the rest as the twin does."""

import json
import re

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import small_robots as robots
from cases import each

from sb3_hds import twins
from sb3_hds.core import rollout
from sb3_hds.errors import ModelFileError, ParameterError
from sb3_hds.twins.mujoco.files.locking import Coupling, Locks, locked_positions
from sb3_hds.twins.mujoco.files.refusals import refuse

pytestmark = pytest.mark.usefixtures("x64")

#: two hinges and two fingers, of which the right one follows the left one
GRIPPER = robots.GRIPPER_URDF


def test_what_a_locked_joint_carries_is_rigid():
    """The same arm without that joint, in MuJoCo."""
    xml = robots.chain(3, option='integrator="implicitfast"')
    twin = twins.from_mujoco(xml, lock={"j1": 0.4})
    turned = re.sub(r'<joint name="j1"[^>]*>', "", xml).replace(
        'name="link1"', 'name="link1" euler="0 0.4 0"'
    )
    turned = re.sub(r'<motor name="m1"[^>]*>', "", turned)
    model = mujoco.MjModel.from_xml_string(turned)
    data = mujoco.MjData(model)
    start, action = np.array([0.3, -0.5]), np.array([0.4, -0.2])
    state = twin.infer(jnp.asarray([*start, 0.0, 0.0]), twin.params)

    seen = rollout(twin, twin.params, state, jnp.asarray([action] * 50)).obs[-1]

    data.qpos[:], data.ctrl[:] = start, action
    mujoco.mj_step(model, data, 50)
    assert [joint.name for joint in twin.joints] == ["j0", "j2"]
    assert [actuator.name for actuator in twin.actuators] == ["m0", "m2"]
    np.testing.assert_allclose(seen, [*data.qpos, *data.qvel], rtol=1e-9, atol=1e-9)


def test_a_joint_that_follows_a_locked_one_is_where_that_holds_it():
    """At 0.01 - 2 * 0.03."""
    twin = twins.from_mujoco(GRIPPER, lock={"left_finger": 0.03})

    assert [joint.name for joint in twin.joints] == ["shoulder", "elbow"]
    held = {name: position for name, (position,) in twin.mechanism.locked}
    assert held == pytest.approx({"left_finger": 0.03, "right_finger": -0.05})
    assert [actuator.name for actuator in twin.actuators] == ["shoulder", "elbow"]
    fingers = twins.from_mujoco(GRIPPER, lock={"*_finger": None}).mechanism.locked
    assert dict(fingers) == {"left_finger": (0.0,), "right_finger": (0.01,)}
    body = twin.mechanism.links[1].body
    assert body.mass == pytest.approx(0.7)
    # The lower link at 0.1 m; fingers at 0.27 m along it, and 0.01 + 0.03 and 0.01 - 0.05 m across.
    assert sorted(np.abs(body.centre)) == pytest.approx([0.0, 0.0, 0.104 / 0.7], abs=1e-12)


def test_a_mimic_that_an_older_mujoco_leaves_free_is_followed_too():
    free = mujoco.MjSpec.from_string(re.sub("<mimic[^>]*>", "", GRIPPER)).compile()
    mimics = [Coupling("right_finger", "left_finger", (0.01, -2.0))]
    found = locked_positions(free, {"left_finger": 0.03}, mimics)
    assert found == {2: (0.03,), 3: pytest.approx((-0.05,))} and not locked_positions(free, ())
    with pytest.raises(ModelFileError, match="right_finger follows left_finger"):
        refuse(free, "euler", (), Locks.of(free, {}), mimics)


def test_a_tendon_between_locked_joints_is_gone_with_its_actuator_and_contacts():
    hand = """<body name="hand"><joint name="wrist" axis="0 1 0"/>
      <geom type="box" size="0.02 0.02 0.02" mass="0.5"/>
      <body name="a" pos="0.1 0 0.1"><joint name="a" type="slide" axis="1 0 0"/>
        <geom type="box" size="0.01 0.01 0.03" mass="0.1" contype="1" conaffinity="1"/></body>
      <body name="b" pos="-0.1 0 0.1"><joint name="b" type="slide" axis="-1 0 0"/>
        <geom type="box" size="0.01 0.01 0.03" mass="0.1" contype="1" conaffinity="1"/></body>
    </body>"""
    more = """<tendon><fixed name="split"><joint joint="a" coef="0.5"/><joint joint="b" coef="0.5"/>
      </fixed></tendon><equality><joint joint1="a" joint2="b"/></equality>"""
    drives = '<motor name="turn" joint="wrist"/><general name="grip" tendon="split" gainprm="9"/>'
    xml = robots.robot("hand", hand, drives, more=more)

    with pytest.raises(ModelFileError) as refused:
        twins.from_mujoco(xml)
    twin = twins.from_mujoco(xml, lock=["a", "b"])

    told = str(refused.value)
    assert "a follows b" in told and "pass lock=['b', 'a']" in told
    assert "Tendons pull (split)" in told and "Contacts can happen (a and b)" in told
    assert [actuator.name for actuator in twin.actuators] == ["turn"]
    assert twin.mechanism.links[0].body.mass == pytest.approx(0.7)


def test_a_locked_joint_survives_the_spec_and_stays_in_the_file(tmp_path):
    twin = twins.from_mujoco(GRIPPER, lock={"left_finger": 0.03}, masses=True)
    changes = {"shoulder_damping": 1.5, "lower_mass": 0.9}
    twin = twin.with_parameters(**changes)

    back = twins.from_spec(json.loads(json.dumps(twin.to_spec())), ())
    written = twins.write_model(back, tmp_path / "arm.xml", GRIPPER)

    assert back == twin and back.mechanism.locked == twin.mechanism.locked
    assert "left_finger, which the twin has locked" in written.left_out
    assert mujoco.MjModel.from_xml_path(str(tmp_path / "arm.xml")).njnt == 4
    again = twins.from_mujoco(tmp_path / "arm.xml", lock={"left_finger": 0.03}, masses=True)
    for name, value in twin.values.items():
        # MuJoCo writes seven digits.
        assert again.values[name] == pytest.approx(value, rel=1e-5, abs=1e-6), name
    with pytest.raises(ModelFileError, match="no joint left_finger, right_finger, which the twin"):
        twins.write_model(twin, tmp_path / "b.xml", robots.URDF)
    in_urdf = twins.write_model(twin, tmp_path / "arm.urdf", GRIPPER)
    assert "shoulder_damping: 1.5 N m s/rad (was 0.3)" in in_urdf.changed


@each(
    (GRIPPER, {}, "(right_finger follows left_finger), which the twin does not simulate"),
    (GRIPPER, {"lock": "right_finger"}, "pass lock=['left_finger', 'right_finger']"),
    (
        GRIPPER,
        {"lock": "finger"},
        "no joint of the model has the name 'finger'. Did you mean '*finger*'?",
    ),
    (GRIPPER, {"lock": "left_fingr"}, "Did you mean 'left_finger'?"),
    (GRIPPER, {"lock": {"*_finger": 0.03}}, "left_finger, which holds it at -0.05, not at 0.03"),
    (GRIPPER, {"lock": {"left_finger": "open"}}, "left_finger must be a finite number, got 'open'"),
    (GRIPPER, {"lock": "*"}, "all joints are locked, so nothing moves"),
    (
        robots.chain(2, range="0.5 1"),
        {"lock": "j1"},
        "position of j1, 0, is outside its range of 0.5 to 1",
    ),
    (robots.BALL, {"lock": {"shoulder": 0.1}}, "shoulder is a ball or free joint"),
    (robots.chain(2), {"lock": "j1", "engine": "mujoco"}, "and lock are for engine='smooth'"),
    ids=lambda value: "" if isinstance(value, str) else None,
)
def test_what_cannot_be_locked_is_refused(source, options, message):
    with pytest.raises((ModelFileError, ParameterError), match=re.escape(message)):
        twins.from_mujoco(source, **options)


def test_a_base_is_locked_where_it_is():
    legs = robots.quadruped(robots.FREE_BASE)
    held, fixed = twins.from_mujoco(legs, lock="base"), twins.from_mujoco(robots.quadruped())
    assert [joint.name for joint in held.joints] == [joint.name for joint in fixed.joints]
    assert held.mechanism.links == fixed.mechanism.links
