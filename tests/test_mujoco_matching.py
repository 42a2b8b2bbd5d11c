"""Which column of a log belongs to which joint: told by names, never by their order."""

import dataclasses
import types

import numpy as np
import pytest
import small_robots as robots
from cases import each

from sb3_hds import Trajectories, twins
from sb3_hds.errors import TrajectoryError
from sb3_hds.twins.mujoco import arranged, match

NAMES = ("shoulder_pan_joint", "wrist_1_joint", "wrist_2_joint")


def arm(**options):
    xml = robots.chain(3)
    for i, name in enumerate(NAMES):
        xml = xml.replace(f'"j{i}"', f'"{name}"')
    return twins.from_mujoco(xml, **options)


def shuffled(columns):
    return np.random.default_rng(0).permutation(columns).tolist()


SHORT = [name.removesuffix("_joint") for name in NAMES]
CAMEL = ["ShoulderPan", "Wrist1", "Wrist2"]


# How a log may call position, velocity and command of a joint.
@each(
    (NAMES, [f"/joint_states:{kind}[{{}}]" for kind in ("position", "velocity", "effort")]),
    (SHORT, ["observation.{}.pos", "observation.{}.vel", "action.{}"]),
    (SHORT, ["q_{}", "dq_{}", "tau_des_{}"]),
    (CAMEL, ["{}Position", "{}Speed", "{}Command"]),
)
def test_columns_are_found_by_the_names_of_joints(spelt, forms):
    columns = [form.format(name) for form in forms for name in spelt]

    found = match(arm(), shuffled(["time", *columns, "temperature"]))

    assert (*found.obs, *found.actions) == tuple(columns)
    assert set(found.unused) == {"time", "temperature"} and not found.missing
    assert found.columns()["actions"][1] == {"column": columns[7]}


def test_what_does_not_match_is_named_with_the_nearest():
    doubled = match(arm(observe="q"), ["left/wrist_1_joint", "right/wrist_1_joint"])
    assert doubled.obs[1] is None and len(doubled.unused) == 2
    found = match(arm(observe="q"), ["shoulder_pan_joint", "wrist_1_joint", "wrist2joint", "u_1"])

    assert found.obs == ("shoulder_pan_joint", "wrist_1_joint", "wrist2joint")
    with pytest.raises(TrajectoryError, match=r"has the name of:\n  m0 \(command\)"):
        found.check()


def test_a_name_within_a_longer_one_is_another_joint():
    xml = robots.chain(2).replace('"j0"', '"elbow"').replace('"j1"', '"left_elbow"')
    twin = twins.from_mujoco(xml, observe="q")

    assert match(twin, ["left_elbow_pos", "right_elbow_pos"]).obs == (None, "left_elbow_pos")
    assert match(twin, ["left_elbow_pos", "elbow_pos"]).obs == ("elbow_pos", "left_elbow_pos")
    prefixed = ["/robot1/left_elbow_pos", "/robot1/elbow_pos"]
    assert match(twin, prefixed).obs == tuple(reversed(prefixed))


def numbered(form, n=3, **options):
    """A robot whose joints have these names and numbers."""
    xml = robots.chain(n)
    for i in range(n):
        xml = xml.replace(f'"j{i}"', f'"{form.format(i + 1)}"')
    return twins.from_mujoco(xml, **options)


def columns_of(form, numbers=(1, 2, 3), kinds=("position", "velocity", "effort")):
    names = [form.format(i) for i in numbers]
    return [f"/joint_states:{kind}[{name}]" for kind in kinds for name in names]


# What a model and a log call their joints, and what is taken away.
@each(
    ("panda_joint{}", "fer_joint{}", "'fer_' and 'panda_'"),
    ("panda_joint{}", "joint{}", "without 'panda_':"),
    ("arm_a{}_link", "robot1/fr3_joint{}", "'robot_1_fr_3_' and 'arm_a_..._link'"),
)
def test_joints_are_found_without_what_their_names_have_in_common(model, log, taken):
    columns = columns_of(log)
    others = ["time", "temperature_1", *columns_of(log.replace("joint", "finger_joint"), (1, 2))]

    found = match(numbered(model), shuffled([*columns, *others]))

    assert (*found.obs, *found.actions) == tuple(columns)
    assert taken in found.renamed and f"'{columns[0]}' is" in found.renamed
    assert set(found.unused) == set(others) and not found.without
    same = match(numbered(model), columns_of(model))
    assert same.obs[0] == columns_of(model)[0] and not same.renamed


# Logs of which nothing may be taken.
@each(
    ("panda_joint{}", columns_of("fer_joint{}", (2, 3, 4))),
    ("panda_joint{}", columns_of("fer_joint{}", (0, 1, 2))),
    ("panda_joint{}", columns_of("fer_joint{}", (1, 2, 3, 4))),
    ("arm1_joint{}", columns_of("arm2_joint{}")),
    ("left_joint{}", columns_of("right_joint{}")),
    ("iiwa14_joint{}", columns_of("iiwa7_joint{}")),
    ("panda_joint{}", [*columns_of("left_joint{}"), *columns_of("right_joint{}")]),
    (
        "panda_joint{}",
        [*columns_of("a_{}", kinds=["position"]), *columns_of("b_{}", kinds=["effort"])],
    ),
)
def test_joints_of_other_numbers_or_of_another_arm_are_not_taken(model, columns):
    found = match(numbered(model), columns)
    assert not any([*found.obs, *found.actions]) and len(found.missing) == 9
    with pytest.raises(TrajectoryError, match="No column of the log has the name of"):
        found.check()


def test_the_nearest_columns_are_those_of_the_same_number():
    near = dict(match(numbered("panda_joint{}"), columns_of("fer_joint{}", (2, 3, 4))).missing)
    assert near["panda_joint1_position"] == ()
    assert near["panda_joint2_position"] == ("/joint_states:position[fer_joint2]",)
    assert near["m1 (command)"] == ("/joint_states:effort[fer_joint2]",)
    near = dict(match(arm(), ["shouldr_pan_pos", "wrist_3_pos", "shoulder_lift_vel"]).missing)
    assert near["shoulder_pan_joint_position"] == ("shouldr_pan_pos",)
    assert near["wrist_1_joint_position"] == near["shoulder_pan_joint_velocity"] == ()


def test_joints_without_any_column_may_stand_still():
    """If all others have theirs, under their own names or others."""
    for form in ("panda_joint{}", "fer_joint{}"):
        found = match(numbered("panda_joint{}"), columns_of(form, (1, 2)))
        assert found.without == ("panda_joint3",)
        with pytest.raises(
            TrajectoryError, match=r"no columns of panda_joint3\. .*lock=\['panda_joint3'\]"
        ):
            found.check()
    # If all that is left is not another joint of the same kind.
    for shifted in ("panda_joint{}", "robot/panda_joint{}"):
        found = match(numbered("panda_joint{}"), columns_of(shifted, (2, 3, 4)))
        assert found.obs[0] is None and not found.without
    half = columns_of("panda_joint{}")[1:]
    assert not match(numbered("panda_joint{}"), half).without


def test_columns_of_a_locked_joint_belong_to_no_other():
    """Not to a joint whose name is within its own; and its position is known."""
    xml = robots.chain(2).replace('"j0"', '"elbow"').replace('"j1"', '"left_elbow"')
    twin = twins.from_mujoco(xml, lock="left_elbow")

    found = match(twin, ["left_elbow_pos", "left_elbow_vel", "left_elbow_torque"])
    assert not any([*found.obs, *found.actions]) and found.locked == ("left_elbow_pos",)
    gripper = [f"/robot/{name}" for name in ("elbow_pos", "elbow_vel", "elbow_torque")]
    found = match(twin, [*gripper, "/gripper/left_elbow_pos"])
    assert (*found.obs, *found.actions) == tuple(gripper) and not found.missing

    held = numbered("panda_joint{}", 4, lock="panda_joint4")
    found = match(held, columns_of("fer_joint{}", (1, 2, 3, 4)))
    assert not found.missing and found.locked == ("/joint_states:position[fer_joint4]",)


def test_data_are_put_into_the_order_of_the_twin():
    obs = np.arange(12.0).reshape(2, 6)
    columns = [f"{name}_{kind}" for kind in ("vel", "pos") for name in reversed(NAMES)]
    actions = np.array([[3.0, 1.0, 2.0]])
    data = Trajectories.from_arrays([obs], [actions], dt=0.01)
    told = types.SimpleNamespace(obs=columns, actions=[NAMES[2], NAMES[0], NAMES[1]])

    ordered = arranged(arm(), dataclasses.replace(data, report=told))

    np.testing.assert_array_equal(ordered.obs[0, 0], [5.0, 4.0, 3.0, 2.0, 1.0, 0.0])
    np.testing.assert_array_equal(ordered.actions[0, 0], [1.0, 2.0, 3.0])
    with pytest.raises(TrajectoryError, match="do not carry the names of their columns"):
        arranged(arm(), data)


def test_currents_in_the_place_of_torques_are_remarked():
    forms = ["{}_position", "{}_velocity", "{}_current"]
    found = match(arm(), [form.format(name) for form in forms for name in NAMES])

    (sentence,) = found.remarks
    assert "shoulder_pan_joint_current, " in sentence and "[N m/A] as 'scale'" in sentence
    assert not match(
        arm(), [f"{name}_{x}" for x in ("pos", "vel", "tau") for name in NAMES]
    ).remarks


@each("{}", "fer_{}", "{}_of_mine")
def test_beside_a_position_a_column_without_a_quantity_is_a_command_at_most(form):
    joints = [form.format(name) for name in NAMES]
    named = [f"{name}_{kind}" for kind in ("position", "velocity") for name in joints]
    found = match(arm(), [*named, *joints])

    assert [*found.obs] == named and found.actions == (None,) * 3
    wanted = [(f"m{i} (command)", (joint,)) for i, joint in enumerate(joints)]
    assert [*found.missing] == wanted
