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
