"""A robot's model file on the command line: joints matched by name, a corrected file written."""

import json
import re

import mujoco
import numpy as np
import pytest
import small_robots as robots
import yaml
from cases import each

from sb3_hds import cli
from sb3_hds.cli import diagnose

SERVOS = ["--actuators", "position", "kp:30", "kv:1.5"]


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    """MJCFs of one and two joints without actuators, and logs of what servos do to them."""
    folder = tmp_path_factory.mktemp("arm")
    heads = {1: "t,j0_pos,j0_vel,j0_target"}
    heads[2] = "t,j1_pos,j0_pos,j0_vel,j1_vel,j0_target,j1_target"
    for n, head in heads.items():
        bare = robots.chain(n, actuator="none", option='integrator="implicitfast"')
        (folder / f"arm{n}.xml").write_text(bare)
        servos = "".join(f'<position name="j{i}" joint="j{i}" kp="30" kv="1.5"/>' for i in range(n))
        real = bare.replace("<actuator>", f"<actuator>{servos}").replace('="0.1"', '="2"')
        rows = motion(mujoco.MjModel.from_xml_string(real))
        write(folder / f"log{n}.csv", head, rows)
    write(folder / "q.csv", "t,a,b,c,d", rows[:, [0, 1, 2, 5, 6]])
    return folder


def write(path, head, rows):
    np.savetxt(path, rows, "%.9f", ",", header=head, comments="")


def motion(model, n=200):
    data, rows = mujoco.MjData(model), []
    rate = np.array([2.0, 3.1])[: model.nu]
    for k in range(n):
        target = 0.6 * np.sin(rate * k * 0.008) + 0.3 * np.sign(np.sin(2.0 * rate * k * 0.008))
        rows.append([k * 0.008, *data.qpos[::-1], *data.qvel, *target])
        data.ctrl[:] = target
        mujoco.mj_step(model, data, 4)
    return np.array(rows)


def ask(arm, command, *words, log="log2.csv", model="arm2.xml"):
    about = ["--model", arm / model, "--data", arm / log, *SERVOS]
    return cli.main([command, *map(str, [*about, *words])])


@pytest.fixture
def asked(monkeypatch):
    """What a diagnosis would be asked."""
    seen = []

    def diagnose(twin, data, **_):
        seen.append((twin, data))
        raise KeyboardInterrupt

    monkeypatch.setattr("sb3_hds.sysid.diagnose", diagnose)
    return seen


def test_a_calibration_writes_the_corrected_file(arm, tmp_path, capsys):
    told, file = tmp_path / "fit.json", tmp_path / "corrected.xml"
    words = ["--free", "*_damping", "--window", 10, "--json", told, "--write", file]

    code = ask(arm, "calibrate", *words, log="log1.csv", model="arm1.xml")

    shown = capsys.readouterr().out
    assert code == 0 and "Time is taken from 't'." in shown
    assert "corrected.xml holds the corrected model" in shown
    (estimate,) = json.loads(told.read_text())["estimates"]
    assert estimate["name"] == "j0_damping" and estimate["estimate"] == pytest.approx(2.0, rel=0.02)
    model = mujoco.MjModel.from_xml_path(str(file))
    assert model.dof_damping == pytest.approx([2.0], rel=0.02)
    assert model.nu == 1 and model.opt.timestep == 0.002


def test_a_check_takes_the_file_of_a_model(arm, monkeypatch, capsys):
    monkeypatch.setattr("sb3_hds.twins.check", lambda twin: pytest.exit(twin.name))
    with pytest.raises(pytest.exit.Exception, match="arm1"):
        cli.main(["twins", "check", str(arm / "arm1.xml"), "--set", "observe:q"])


def test_a_diagnosis_takes_joints_by_name_at_the_interval_of_the_log(arm, asked, capsys):
    assert ask(arm, "diagnose", "--set", "j0_damping:1") == 130

    ((twin, data),) = asked
    assert twin.dt == data.dt == pytest.approx(0.008) and twin.substeps == 4
    assert twin.values["j0_damping"] == 1.0
    rows = np.loadtxt(arm / "log2.csv", delimiter=",", skiprows=1)
    np.testing.assert_allclose(data.obs[0, :5], rows[:5, [2, 1, 3, 4]])
    np.testing.assert_allclose(data.actions[0, :5], rows[:5, 5:])


def test_names_of_joints_come_from_the_map_where_the_log_has_none(arm, asked, tmp_path, capsys):
    """The map of the error is corrected: columns are filled in, and velocities left out."""
    assert ask(arm, "audit", log="q.csv") == 1
    told, _, offered = capsys.readouterr().err.partition("\n\n")
    assert "has the name of j0_position, j1_position, j0_velocity and 3 more" in told
    assert yaml.safe_load(offered)["time"] == {"column": "t"}
    assert "# other columns: a, b, c, d\n" in offered
    lines = [line for line in offered.splitlines() if "_velocity" not in line]
    columns = iter(["b", "a", "c", "d"])
    chart = tmp_path / "map.yml"
    chart.write_text("\n".join(re.sub("NAME", lambda _: next(columns), line) for line in lines))

    assert ask(arm, "diagnose", "--columns", chart, log="q.csv") == 130

    ((twin, data),) = asked
    assert [channel.name for channel in twin.channels] == ["j0_position", "j1_position"]
    rows = np.loadtxt(arm / "q.csv", delimiter=",", skiprows=1)
    np.testing.assert_allclose(data.obs[0, :5], rows[:5, [2, 1]])


def test_columns_of_a_map_without_names_are_offered_by_their_place(arm, asked, tmp_path, capsys):
    """In the order of the twin, with what the map says of them."""
    chart, named = tmp_path / "map.yml", tmp_path / "named.yml"
    numbered = tmp_path / "log.csv"
    rows = np.loadtxt(arm / "log2.csv", delimiter=",", skiprows=1)
    np.savetxt(numbered, rows, "%.9f", ",")
    chart.write_text(
        "time: 0\nobs: [2, 1, {column: 3, unit: deg/s}, 4]\nactions: [{column: 5, scale: 2}, 6]"
    )

    assert ask(arm, "audit", "--columns", chart, log=numbered) == 1
    named.write_text(capsys.readouterr().err.partition("\n\n")[2])
    assert ask(arm, "diagnose", "--columns", named, log=numbered) == 130

    ((_, data),) = asked
    assert "{column: '3', unit: deg/s, name: j0_velocity}  # by its place" in named.read_text()
    expected = rows[:5, [2, 1, 3, 4]] * [1.0, 1.0, np.pi / 180.0, 1.0]
    np.testing.assert_allclose(data.obs[0, :5], expected)
    np.testing.assert_allclose(data.actions[0, :5], rows[:5, 5:] * [2.0, 1.0])


def test_a_map_for_a_model_is_printed_and_understood(arm, asked, tmp_path, capsys):
    chart, log = tmp_path / "map.yml", str(arm / "log2.csv")
    words = ["--model", str(arm / "arm2.xml"), *SERVOS]

    assert cli.main(["columns", log, *words]) == 0
    chart.write_text(capsys.readouterr().out)
    assert ask(arm, "diagnose", "--columns", chart) == 130

    names = [entry["name"] for entry in yaml.safe_load(chart.read_text())["obs"]]
    assert names == [channel.name for channel in asked[0][0].channels]
    assert asked[0][1].report.obs == tuple(names)
    assert cli.main(["columns", log, "--lock", "j0"]) == 1
    assert "--lock is about a model file" in capsys.readouterr().err


@pytest.fixture(scope="module")
def gripper(tmp_path_factory):
    """A URDF with two fingers, and a log that calls its joints otherwise and has no fingers."""
    folder = tmp_path_factory.mktemp("gripper")
    text = robots.GRIPPER_URDF.replace('"shoulder"', '"rob_joint1"').replace(
        '"elbow"', '"rob_joint2"'
    )
    (folder / "robot.urdf").write_text(re.sub('"(left|right)_finger"', r'"rob_\1_finger"', text))
    head = [f"arm_joint{i}_{kind}" for kind in ("pos", "vel", "torque") for i in (1, 2)]
    time = np.arange(400) * 0.01
    q = np.stack([np.sin(3.0 * time), np.cos(5.0 * time)], 1)
    rows = np.column_stack([time, q, np.gradient(q, 0.01, axis=0), np.sign(q)])
    write(folder / "log.csv", ",".join(["t", *head]), rows)
    return folder


def test_a_robot_with_a_gripper_gets_there_by_what_the_messages_say(gripper, asked, capsys):
    """From coupled fingers that the log lacks, and joints of other names, to a diagnosis."""
    command = ["diagnose", "--model", gripper / "robot.urdf", "--data", gripper / "log.csv"]
    command = list(map(str, command))
    lock = "pass --lock rob_left_finger rob_right_finger"

    assert cli.main(command) == 1
    told = capsys.readouterr().err
    assert f"If they stand still in the data, {lock}." in told and "--ignore equality." in told
    assert cli.main([*command, "--ignore", "equality"]) == 1
    told = capsys.readouterr().err
    assert "The log has no columns of rob_left_finger, rob_right_finger. " in told and lock in told
    assert cli.main([*command, *lock.split()[1:]]) == 130

    shown = capsys.readouterr().out
    assert "without 'arm_' and 'rob_': 'arm_joint1_pos' is rob_joint1_position." in shown
    ((twin, data),) = asked
    assert [joint.name for joint in twin.joints] == ["rob_joint1", "rob_joint2"]
    rows = np.loadtxt(gripper / "log.csv", delimiter=",", skiprows=1)
    np.testing.assert_allclose(data.obs[0, :5], rows[:5, 1:5])
    # In the second row the joints move towards opposite torques.
    np.testing.assert_allclose(data.actions[0, 1:5], rows[1:5, 5:])


def test_locked_joints_reach_every_command_and_file(gripper, asked, tmp_path, capsys, monkeypatch):
    robot, log, file = gripper / "robot.urdf", gripper / "log.csv", tmp_path / "twin.json"
    lock = ["--lock", "*_left_finger:0.03"]
    about = ["--model", str(robot), "--data", str(log), *lock]
    told = tmp_path / "map.yml"

    assert cli.main(["audit", *about]) == 0
    assert cli.main(["twins", "check", str(robot), *lock, "--set", "dt:0.01"]) == 0
    capsys.readouterr()
    assert cli.main(["columns", str(log), "--model", str(robot), *lock]) == 0
    told.write_text(capsys.readouterr().out)
    words = ["--free", "rob_joint1_damping", "--errors", "force", "--write", str(file)]
    assert cli.main(["calibrate", *about, "--columns", str(told), *words]) == 0
    # The file stands for the twin, with its locked joints.
    assert (
        cli.main(["diagnose", "--twin", str(file), "--data", str(log), "--columns", str(told)])
        == 130
    )
    twin, _ = asked[0]
    assert [joint.name for joint in twin.joints] == ["rob_joint1", "rob_joint2"]
    assert twin.mechanism.locked[0] == ("rob_left_finger", (0.03,))
    # Its joints are found by name, too.
    assert cli.main(["diagnose", "--twin", str(file), "--data", str(log)]) == 130
    assert "'arm_joint1_pos' is rob_joint1_position." in capsys.readouterr().out
    np.testing.assert_array_equal(asked[1][1].obs, asked[0][1].obs)
    given = cli.parser().parse_args(["diagnose", *about, "--each", str(tmp_path)])
    assert lock[1] in diagnose._arguments_of(given)


def test_a_locked_joint_that_the_log_has_elsewhere_is_a_warning(arm, capsys):
    """The second joint of the arm moves by more than a radian."""
    rows = np.loadtxt(arm / "log2.csv", delimiter=",", skiprows=1)
    low, high = rows[:, 1].min(), rows[:, 1].max()
    rows[:, 1] = 0.3
    write(arm / "still.csv", "t,j1_pos,j0_pos,j0_vel,j1_vel,j0_target,j1_target", rows)

    assert ask(arm, "audit", "--lock", "j1") == 0
    assert f"j1 is locked at 0, but moves from {low:.3g} to {high:.3g}" in capsys.readouterr().err
    assert ask(arm, "audit", "--lock", "j1", log="still.csv") == 0
    assert "but stands at 0.3 in the data: --lock j1:0.3." in capsys.readouterr().err
    assert ask(arm, "audit", "--lock", "j1:0.3", log="still.csv") == 0
    assert "locked" not in capsys.readouterr().err


@each(
    (["--twin", "Pendulum", "--lock", "hinge"], "--lock is about a model file"),
    (["--model", "ARM", "--lock", "j"], "--lock: no joint of the model has the name 'j'."),
    (
        ["--model", "ARM", "--lock", "j1:open"],
        "--lock: no joint of the model has the name 'j1:open'",
    ),
    (["--twin", "Pendulum", "--ignore", "limits"], "--ignore is about a model file"),
    (["--model", "missing.urdf"], "There is no file 'missing.urdf'"),
    (["--model", "ARM", "--actuators", "magic"], "actuators is one of 'torque'"),
    (["--model", "ARM", "--set", "weight:1"], "no parameter 'weight'"),
    (["--model", "ARM", "--write", "no/a.xml"], "there is no such folder"),
)
def test_a_question_that_makes_no_sense_is_one_message(words, message, arm, capsys):
    words = [str(arm / "arm2.xml") if word == "ARM" else word for word in words]
    assert cli.main(["calibrate", "--data", str(arm / "log2.csv"), *words]) == 1
    told = capsys.readouterr().err
    assert message in told and "Traceback" not in told
