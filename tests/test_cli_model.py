"""A robot's model file on the command line: joints matched by name, a corrected file written."""

import json

import mujoco
import numpy as np
import pytest
import small_robots as robots
from cases import each

from sb3_hds import cli

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
    assert ask(arm, "audit", log="q.csv") == 1
    told = capsys.readouterr().err
    assert "No column of the log has the name of:" in told
    assert "obs: [{column: NAME, name: j0_position}, ...]" in told
    entry = "{{column: {}, name: {}}}".format
    obs = ", ".join([entry("a", "j1_position"), entry("b", "j0_position")])
    actions = ", ".join([entry("c", "j0"), entry("d", "j1")])
    chart = tmp_path / "map.yml"
    chart.write_text(f"time: t\nobs: [{obs}]\nactions: [{actions}]\n")

    assert ask(arm, "diagnose", "--columns", chart, log="q.csv") == 130

    ((twin, data),) = asked
    assert [channel.name for channel in twin.channels] == ["j0_position", "j1_position"]
    rows = np.loadtxt(arm / "q.csv", delimiter=",", skiprows=1)
    np.testing.assert_allclose(data.obs[0, :5], rows[:5, [2, 1]])


@each(
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
