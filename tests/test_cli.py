"""The command line: what it prints, what it writes, how it fails."""

import importlib
import json
import subprocess
import sys
import warnings
from argparse import Namespace
from importlib.metadata import version

import jax.numpy as jnp
import numpy as np
import pytest
from measuring import measured

from sb3_hds import Trajectories, cli, effects, twins
from sb3_hds.cli import measured as measured_room
from sb3_hds.core import State, rollout
from sb3_hds.sysid import Diagnosis
from sb3_hds.twins import registry

diagnose_module = importlib.import_module("sb3_hds.sysid.diagnose")


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    twin = twins.make("PendulumReal").extend(effects.CoulombFriction(0, tau_c=0.1))
    data = measured(twin, n=12, n_steps=100, noise=0.01)
    return str(data.save(tmp_path_factory.mktemp("log") / "data"))


def ask(*words):
    return cli.main(["diagnose", *map(str, words)])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"--twin": "Nothing"}, "no twin for 'Nothing'"),
        ({"--data": "missing.npz"}, "missing.npz"),
        ({"--effects": "CoulombFrction"}, "Did you mean 'coulomb_friction'?"),
        ({"--set": "mass=2"}, "--set takes NAME:VALUE, got 'mass=2'"),
        ({"--set": "mass:heavy"}, "must be a number [kg]"),
        ({"--set": "mas:1"}, "Did you mean 'mass'?"),
        ({"--calibrate": "weight"}, "Its parameters are"),
        ({"--columns": "missing.yml"}, "missing.yml"),
        ({"--report": "nowhere/out.html"}, "cannot be written"),
        ({"--report": "r.pdf"}, "r.html in place of r.pdf"),
        ({"--json": "."}, "is a folder"),
        ({"--env": "Nothing-v0"}, "Nothing"),
        ({"--env": "Pendulum-v1", "--algo": "magic"}, "no algorithm 'magic'"),
        ({"--env": "Pendulum-v1", "--env-kwargs": "friction:1"}, "friction"),
        ({"--env": "Pendulum-v1", "--hyperparams": "speed:1"}, "speed"),
        ({"--env": "Pendulum-v1", "--policies": "0"}, "at least 1"),
        ({"--env": "Pendulum-v1", "--algo": "sac"}, "learns nothing"),
        ({"--env": "MountainCarContinuous-v0"}, "observations of shape (2,)"),
    ],
)
def test_a_question_that_makes_no_sense_is_one_message(log, capsys, changes, message):
    words = {"--twin": "PendulumReal", "--data": log} | changes

    assert ask(*(word for pair in words.items() for word in pair)) == 1
    told = capsys.readouterr().err
    assert told.startswith("sb3-hds: ") and message in told and "Traceback" not in told


@pytest.fixture(scope="module")
def swings(tmp_path_factory):
    """A free pendulum of 0.3 kg: its log in radians, with stamps in milliseconds, and a map."""
    folder = tmp_path_factory.mktemp("swings")
    twin = twins.make("FreePendulum", mass=0.3, damping=0.002, dt=1.0 / 150.0)
    starts = np.linspace(0.6, 1.6, 6)
    rows = []
    for run, start in enumerate(starts):
        state = State(jnp.array([start]), jnp.zeros(1), {})
        obs = np.asarray(rollout(twin, twin.params, state, jnp.zeros((450, 0))).obs)
        stamps = np.round(np.arange(451) / 150.0, 3)
        rows.append(np.column_stack([stamps, np.full(451, run), obs]))
    table = np.concatenate(rows)
    for name, scale in (("rad", 1.0), ("deg", 180.0 / np.pi)):
        scaled = table * [1.0, 1.0, scale, scale]
        np.savetxt(
            folder / f"{name}.csv", scaled, "%.9f", ",", header="t,run,angle,speed", comments=""
        )
    (folder / "map.yml").write_text("{time: t, episode: run, obs: [angle, speed], actions: []}")
    return folder


def question(swings, command, name="rad", *words):
    about = ["--data", swings / f"{name}.csv", "--columns", swings / "map.yml"]
    return cli.main([command, *map(str, [*about, *words])])


def test_an_audit_needs_no_twin_and_says_what_the_clock_was(swings, tmp_path, capsys):
    told = tmp_path / "audit.json"

    assert question(swings, "audit", "rad", "--json", told) == 0

    shown = capsys.readouterr().out
    assert "regular clock of 150 Hz, stamps rounded to 1 ms" in shown and "usable: yes" in shown
    plain = json.loads(told.read_text())
    assert plain["usable"] and plain["reading"]["recordings"][0]["clock"] == "rounded"
    assert plain["dt"] == pytest.approx(1.0 / 150.0, rel=1e-9)


def test_an_audit_with_a_twin_sees_degrees_and_any_verdict_is_success(swings, tmp_path, capsys):
    twin = ["--twin", "FreePendulum", "--set", "mass:0.3", "dt:0.00666667"]

    assert question(swings, "audit", "deg") == 0
    assert "usable: yes" in capsys.readouterr().out
    assert question(swings, "audit", "deg", *twin) == 0
    assert "{column: angle, unit: deg}" in " ".join(capsys.readouterr().out.split())
    assert question(swings, "calibrate", "deg", *twin, "--write", tmp_path / "twin.json") == 1
    assert "sb3-hds: No parameter can be estimated" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_calibrated_twin_is_printed_written_and_read_again(swings, tmp_path, capsys):
    twin, told = tmp_path / "twin.json", tmp_path / "fit.json"
    about = ["--twin", "FreePendulum", "--set", "dt:0.00666667", "mass:0.3"]

    code = question(
        swings, "calibrate", "rad", *about, "--free", "com,damping", "--json", told, "--write", twin
    )

    assert code == 0
    assert "com" in (shown := capsys.readouterr().out) and "95 % interval" in shown
    plain = json.loads(told.read_text())
    assert [e["name"] for e in plain["estimates"]] == ["com", "damping"] and plain["converged"]
    assert plain["estimates"][1]["estimate"] == pytest.approx(0.002, rel=0.02)
    assert json.loads(twin.read_text()) == {"twin": plain["twin"]}
    for path in (twin, told):
        again = measured_room.twin_of(Namespace(twin=str(path), set=["mass:0.31"]))
        assert again.values["damping"] == plain["estimates"][1]["estimate"]
        assert again.values["mass"] == 0.31


FREE = ["--twin", "FreePendulum"]


@pytest.mark.parametrize(
    ("command", "words", "message"),
    [
        ("audit", ["--set", "mass:1"], "--set changes the twin"),
        ("audit", ["--json", "nowhere/out.json"], "cannot be written"),
        ("audit", ["--twin", "CartPole"], "CartPole has 5 channels"),
        ("calibrate", FREE, "steps by 0.01 s"),
        ("calibrate", [*FREE, "--free", "weight"], "free must name parameters"),
        ("calibrate", [*FREE, "--set", "dt:0.00666667", "--prior", "-1"], "prior must be"),
        ("calibrate", [*FREE, "--set", "dt:0.00666667", "--level", "95"], "level must lie"),
    ],
)
def test_other_questions_that_make_no_sense_are_one_message_too(
    swings, capsys, command, words, message
):
    assert question(swings, command, "rad", *words) == 1
    told = capsys.readouterr().err
    assert message in told and "Traceback" not in told
    assert len([line for line in told.splitlines() if line.startswith("sb3-hds: ")]) == 1


def test_what_exists_is_listed_with_units_and_explanations(capsys):
    assert cli.main(["effects"]) == 0
    shown = capsys.readouterr().out.replace("│", " ").split()
    for effect in effects.ALL:
        assert effect.name in shown
        units = [f"{name} [{p.unit}]" for name, p in effect.parameters.items() if name != "flipped"]
        words = [*", ".join(units).split(), *effect.explanation.split()]
        assert set(words) <= set(shown), effect.name

    assert {"parameter.NAME", "slider,", "direction"} <= set(shown) and "flipped" not in shown

    assert cli.main(["twins"]) == 0
    shown = capsys.readouterr().out
    words = shown.replace("│", " ").split()
    assert {*twins.names(), *twins.all_ids()} <= set(words)
    assert {"observe:qv", "zero:down", "driven:both", "dt:0.005"} <= set(words)
    assert "A carriage with a ball screw" in " ".join(words) and ":class:" not in shown


@pytest.fixture
def asked(monkeypatch):
    """What a diagnosis would be asked: twins, data and further arguments."""
    seen = []

    def diagnose(twin, data, **given):
        seen.append((twin, data, given))
        warnings.warn("Rows are\nuneven.", UserWarning, stacklevel=2)
        return Diagnosis("none", twin, twin, data_hash="", seed=0)

    monkeypatch.setattr("sb3_hds.sysid.diagnose", diagnose)
    return seen


def empty_log(folder, n_obs=2, n_act=0):
    data = Trajectories.from_arrays([np.zeros((9, n_obs))], [np.zeros((8, n_act))], dt=0.01)
    return data.save(folder / "log")


def test_a_twin_is_set_by_words_and_commas_separate_names(asked, tmp_path, capsys):
    log = empty_log(tmp_path, 1, 1)
    settings = {
        "FreePendulum": ["observe:q", "zero:up", "driven:true", "mass:2e-1", "substeps:4"],
        "ServoPendulum": ["commands:goal, enable"],
    }
    words = ["--calibrate", "mass,com", "damping", "--effects", "stiffness,", "cogging"]

    for name, given in settings.items():
        ask("--twin", name, "--data", log, "--set", *given, *words)

    (free, _, given), (servo, *_) = asked
    assert (free.observed, free.zero, free.driven, free.substeps) == ("q", "up", True, 4)
    assert free.values["mass"] == 0.2 and len(servo.actuators) == 2
    assert given["calibrate"] == ["mass", "com", "damping"]
    assert given["effects"] == ["stiffness", "cogging"]
    # A warning is one line without code.
    assert capsys.readouterr().err == 2 * "warning: Rows are uneven.\n"


def test_a_log_without_a_map_of_columns_is_told_how_to_write_one(tmp_path, capsys):
    log, empty = tmp_path / "log.csv", tmp_path / "map.yml"
    log.write_text("t,q\n0.0,0.1\n")
    empty.write_text("[]")

    for words in ([], ["--columns", empty]):
        assert ask("--twin", "FreePendulum", "--data", log, *words) == 1
        told = capsys.readouterr().err
        assert "--columns map.yml:" in told and "    actions: [NAME]" in told
        assert "{'time'" not in told and "columns={" not in told


@pytest.fixture
def own_modules(tmp_path, monkeypatch):
    """A folder to work in, and registries that forget what its modules register."""
    monkeypatch.setattr("sys.path", [path for path in sys.path if path])
    monkeypatch.setattr(registry, "_TWINS", dict(registry._TWINS))
    monkeypatch.delitem(sys.modules, "rigs_in_a_folder", raising=False)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rigs_in_a_folder.py").write_text(
        "from sb3_hds import twins\n\n\n@twins.register\n"
        "class Slide(twins.LinearAxis):\n    name = 'SlideInAFolder'\n"
        "    def bias(self, q, v, params):\n        return -params['damping'] * v\n"
    )
    return tmp_path


def test_a_twin_of_ones_own_is_taken_from_a_module_in_the_folder(own_modules, asked, capsys):
    log = empty_log(own_modules)

    assert ask("--twin", "rigs_in_a_folder:SlideInAFolder", "--data", log) == 0
    assert asked[0][0].name == "SlideInAFolder"

    capsys.readouterr()
    assert ask("--twin", "FreePendulun", "--data", log) == 1
    told = capsys.readouterr().err
    assert "Did you mean 'FreePendulum'? " in told and "--twin module:Name" in told
    assert told.count("\n") == 1 and len(told) < 300


def test_a_twin_is_checked_and_a_flaw_is_a_failure(own_modules, capsys):
    assert cli.main(["twins", "check", "rigs_in_a_folder:SlideInAFolder"]) == 1
    told = capsys.readouterr().out
    assert "SlideInAFolder: 1 of 8 checks failed" in told and "FAIL forces of inertia" in told
    assert cli.main(["twins", "check", "LinearAxis", "--set", "mass:3"]) == 0
    assert "LinearAxis: all 9 checks passed" in capsys.readouterr().out


def test_the_twin_that_was_extended_is_asked_again(log, tmp_path, capsys):
    extended = twins.make("PendulumReal").extend(effects.CoulombFriction(0, tau_c=0.1))
    told = tmp_path / "out.json"
    told.write_text(json.dumps({"twin": extended.to_spec()}))
    about = ["--data", log, "--effects", "viscous_friction", "--budget", "quick"]

    assert ask("--twin", told, *about) == 0
    assert capsys.readouterr().out.startswith("none:")

    told.write_text("[1, 2")
    assert ask("--twin", told, *about) == 1
    assert "holds no twin: it has to be what" in capsys.readouterr().err


def test_what_the_audit_proposes_is_done_if_wanted_and_said(asked, tmp_path, capsys):
    """A filter in the drive: the speed comes four samples late."""
    time = 0.01 * np.arange(2000)
    obs = np.stack([np.sin(3.0 * time), 3.0 * np.cos(3.0 * (time - 0.04))], 1)
    commands = np.random.default_rng(0).standard_normal((1999, 1))
    log = str(Trajectories.from_arrays([obs], [commands], dt=0.01).save(tmp_path / "log"))
    words, told = ["--twin", "LinearAxis", "--data", log], str(tmp_path / "out.json")

    assert ask(*words) == 0
    assert "shifted" not in capsys.readouterr().out
    assert ask(*words, "--correct", "--json", told) == 0
    assert "Caveat: 'axis_velocity' was shifted by -40 ms." in capsys.readouterr().out
    assert json.loads((tmp_path / "out.json").read_text())["caveats"]
    (_, plain, _), (_, corrected, _) = asked
    np.testing.assert_array_equal(plain.obs[0], obs)
    speed = 3.0 * np.cos(3.0 * time[: len(corrected.obs[0])])
    np.testing.assert_allclose(corrected.obs[0, :, 1], speed, atol=0.02)

    assert cli.main(["audit", "--data", log, "--correct", "--json", told]) == 0
    shown, audited = capsys.readouterr().out, json.loads((tmp_path / "out.json").read_text())
    assert "'obs[1]' was shifted by -40 ms." in shown and shown.count("Audit of 1 trajectory") == 2
    assert audited["corrections"] and audited["corrected"]["velocity_shift"] == {}


def test_a_diagnosis_and_the_gain_in_policy_are_printed_and_written(log, tmp_path, capsys):
    page, plain = tmp_path / "out.html", tmp_path / "out.json"
    small = ["pretrain_epochs:1", "n_rollouts:4", "n_random_plans:0", "compare_every:0"]

    code = ask(
        *("--twin", "PendulumReal", "--data", log, "--effects", "coulomb_friction"),
        *("viscous_friction", "--budget", "quick", "--report", page, "--json", plain),
        *("--env", "sb3_hds/PendulumReal-v1", "--env-kwargs", "friction:0.1"),
        *("--policies", 1, "--episodes", 2, "--hyperparams", *small),
    )

    assert code == 0
    shown, told = capsys.readouterr().out, json.loads(plain.read_text())
    assert "coulomb_friction at joint hinge" in shown and "2 start states, one run" in shown
    assert told["findings"][0]["effect"] == "coulomb_friction"
    assert set(told["policy_gain"]["simulations"]) == {"believed", "extended", "true"}
    assert page.read_text().startswith("<!DOCTYPE html>")
    assert f"{told['policy_gain']['gain']['mean']:.1f}" in page.read_text()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["out.html", "out.json"]


def test_any_verdict_is_success_and_where_nothing_was_found_no_policies_are_compared(
    tmp_path, capsys, monkeypatch
):
    monkeypatch.setattr("sb3_hds.algos.HDS.learn", None)
    still = np.array([-1.0, 0.0, 0.0]) + np.zeros((8, 61, 3))
    data = Trajectories.from_arrays(list(still), [np.zeros((60, 1))] * 8, dt=0.05)
    words = ["--twin", "PendulumReal", "--data", data.save(tmp_path / "still")]

    code = ask(*words, "--env", "sb3_hds/PendulumReal-v1")

    shown = capsys.readouterr().out
    assert code == 0 and "no policies to compare" in shown and "not_identifiable" in shown


# --- what is meant, what exists, and what is sound


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["diagnos"], "Did you mean 'diagnose'?"),
        (["diagnose", "--twin", "a", "--data", "b", "--efects", "x"], "option '--efects'. Did"),
        (["diagnose", "--twin", "a", "--data", "b", "--budget", "quik"], "mean 'quick'?"),
        (["diagnose", "--twin", "a"], "are required: --data"),
        ([], "are required: command"),
    ],
)
def test_words_that_are_not_understood_are_one_line(words, message, capsys):
    with pytest.raises(SystemExit) as end:
        cli.main(words)

    told = capsys.readouterr().err
    assert end.value.code == 2 and message in told and told.count("\n") == 1


def test_version_and_help_come_without_jax():
    code = (
        "import sys; from sb3_hds import cli\n"
        "for words in (['--version'], ['--help'], ['diagnose', '--help']):\n"
        "    try: cli.main(words)\n"
        "    except SystemExit as end: assert not end.code\n"
        "assert not {'jax', 'torch', 'pandas'} & set(sys.modules), 'slow'\n"
    )

    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)

    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(f"sb3-hds {version('sb3-hds')}\n")


def test_an_interrupt_ends_any_command_with_one_line():
    """Also one that is lost as an exception, as in a callback of the garbage collector."""
    code = (
        "import os, signal, sys, time; from sb3_hds import cli\n"
        "from sb3_hds.cli import listing\n"
        "def slow(given):\n"
        "    try: os.kill(os.getpid(), signal.SIGINT)\n"
        "    except KeyboardInterrupt: pass\n"
        "    time.sleep(20)\n"
        "listing.run_effects = slow\n"
        "sys.argv = ['sb3-hds', 'effects']\n"
        "sys.exit(cli.main())\n"
    )

    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=15)

    assert (done.returncode, done.stdout, done.stderr) == (130, "", "sb3-hds: interrupted\n")


def test_an_effect_is_named_as_in_python_or_as_in_the_catalogue():
    found = diagnose_module.classes_of(["CoulombFriction", "coulomb_friction", "Coulomb friction"])

    assert found == (effects.CoulombFriction,) * 3
    assert effects.effect_named("sb3_hds.effects.MotorLag", effects.ALL) is effects.MotorLag


@pytest.mark.parametrize(
    ("words", "there", "not_there"),
    [
        (["effects", "Coulomb-friction"], "directional_coulomb_friction", "viscous_friction"),
        (["twins", "payload", "handle"], "PayloadPendulum", "PendulumReal"),
    ],
)
def test_lists_are_filtered_by_words(words, there, not_there, capsys):
    assert cli.main(words) == 0
    rows = [line for line in capsys.readouterr().out.splitlines() if line.startswith("│")]
    first_column = [row.split("│")[1].strip() for row in rows]
    assert there in first_column and not_there not in first_column


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["effects", "frictoin"], "Did you mean 'friction'?"),
        (["twins", "chek", "Pendulum"], "Did you mean 'check'?"),
        (["twins", "check"], "Name one twin"),
        (["twins", "check", "Pendulun"], "Did you mean 'Pendulum'"),
        (["twins", "cart", "--set", "mass:1"], "--set changes the twin that is checked"),
    ],
)
def test_a_list_without_entries_is_one_message(words, message, capsys):
    assert cli.main(words) == 1
    told = capsys.readouterr().err
    assert message in told and told.count("\n") == 1
