"""Meshes of a model file: what is drawn where they are there, and nothing where they are not."""

import json

import mujoco
import numpy as np
import pytest
from scipy.spatial import ConvexHull

from sb3_hds import twins
from sb3_hds.core import State
from sb3_hds.sysid.reporting.animation import animate
from sb3_hds.sysid.reporting.page import template
from sb3_hds.sysid.reporting.pictures import replay_of

BOX = np.array([[x, y, z] for x in (-0.1, 0.2) for y in (-0.05, 0.05) for z in (0.0, 0.5)])
ARM = """<robot name="arm"><link name="world"/><link name="base"/>
  <joint name="foot" type="fixed"><parent link="world"/><child link="base"/></joint>
  <link name="upper"><inertial><mass value="1"/><origin xyz="0 0 0.2"/>
    <inertia ixx=".01" iyy=".01" izz=".01" ixy="0" ixz="0" iyz="0"/></inertial>
    <visual><origin xyz="0 0 0.1" rpy="0.4 0 0"/>
      <geometry><mesh filename="package://arm/box.obj"/></geometry></visual></link>
  <joint name="hinge" type="revolute"><parent link="base"/><child link="upper"/>
    <origin xyz="0 0 1"/><axis xyz="0 1 0"/><limit lower="-2" upper="2" effort="9" velocity="9"/>
  </joint></robot>"""


@pytest.fixture(scope="module")
def twin(tmp_path_factory):
    folder = tmp_path_factory.mktemp("arm")
    faces = ConvexHull(BOX).simplices + 1
    rows = [f"v {x} {y} {z}" for x, y, z in BOX] + [f"f {a} {b} {c}" for a, b, c in faces]
    (folder / "box.obj").write_text("\n".join(rows))
    (folder / "arm.urdf").write_text(ARM)
    return twins.from_mujoco(folder / "arm.urdf", dt=0.01)


def test_meshes_are_where_mujoco_has_them_and_weigh_nothing(twin):
    bare = twins.from_mujoco(ARM, dt=0.01)
    turn, tilt = np.zeros(9), np.zeros(9)
    for rows, axis, angle in ((turn, [0, 1, 0], 0.7), (tilt, [1, 0, 0], 0.4)):
        quaternion = np.zeros(4)
        mujoco.mju_axisAngle2Quat(quaternion, np.array(axis, float), angle)
        mujoco.mju_quat2Mat(rows, quaternion)
    in_link = BOX @ tilt.reshape(3, 3).T + [0.0, 0.0, 0.1]

    [corners] = np.asarray(twin.meshes(State(np.float32([0.7]), np.zeros(1, np.float32), {})))

    expected = in_link @ turn.reshape(3, 3).T + [0.0, 0.0, 1.0]
    gaps = np.linalg.norm(corners[:, None] - expected, axis=-1)
    assert gaps.min(0).max() < 1e-3 and gaps.min(1).max() < 1e-3
    assert (
        bare.mechanism.shapes == ()
        and bare.meshes(State(np.zeros(1, np.float32), np.zeros(1, np.float32), {})).size == 0
    )
    assert bare.mechanism.links == twin.mechanism.links


def test_visuals_that_make_no_sense_are_not_drawn(tmp_path):
    (tmp_path / "box.obj").write_text("no mesh")
    for text in (ARM, ARM.replace('rpy="0.4 0 0"', 'rpy="all round"')):
        (tmp_path / "arm.urdf").write_text(text)
        assert twins.from_mujoco(tmp_path / "arm.urdf", dt=0.01).mechanism.shapes == ()


def test_a_page_draws_them_and_a_saved_twin_keeps_them(twin):
    again = twins.from_spec(json.loads(json.dumps(twin.to_spec())), ())
    measured = 0.5 * np.sin(0.05 * np.arange(60)).reshape(2, 30, 1) * np.ones(2)
    replay = replay_of(measured, 0.3 * measured, 0.1 * measured, np.ones((30, 2)), 0.02)

    moving = animate(again, again, replay)

    assert again == twin and moving.outlines.shape == (3, 60, 1, 20, 2)
    assert moving.outlines[0].min() >= 0.0 and moving.outlines[0].max() <= 100.0
    assert template("animation.html").render(moving=moving.section()).count("<polygon") == 3
