"""The command line: what it prints, what it writes, how it fails."""

import importlib
import json
import subprocess
import sys
import warnings
from argparse import Namespace
from importlib.metadata import version

import numpy as np
import pytest
from cases import each
from measuring import measured

from sb3_hds import Trajectories, cli, effects, twins
from sb3_hds.cli import catalogue
from sb3_hds.cli import measured as measured_room
from sb3_hds.cli.arguments import settings
from sb3_hds.errors import ParameterError
from sb3_hds.experiments import PolicyGain
from sb3_hds.experiments.policy_gain import _summarised
from sb3_hds.sysid import Diagnosis
from sb3_hds.twins import registry

diagnose_module = importlib.import_module("sb3_hds.sysid.diagnosis.diagnose")


def ask(*words):
    return cli.main(["diagnose", *map(str, words)])


@pytest.fixture(scope="module")
def swings(tmp_path_factory):
    """A free pendulum of 0.3 kg: its log in radians, with stamps in milliseconds, and a map."""
    folder = tmp_path_factory.mktemp("swings")
    twin = twins.make("FreePendulum", mass=0.3, damping=0.002, dt=1.0 / 150.0)
    obs = measured(twin, n=4, n_steps=300, commands=np.zeros((4, 300, 0))).obs
    time = np.tile(np.round(np.arange(301) / 150.0, 3), 4)
    run = np.repeat(np.arange(4), 301)
    for name, scale in (("rad", 1.0), ("deg", 180.0 / np.pi)):
        table = np.column_stack([time, run, scale * obs.reshape(-1, 2)])
        header = {"header": "t,run,angle,speed", "comments": ""}
        np.savetxt(folder / f"{name}.csv", table, "%.9f", ",", **header)
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

    assert question(swings, "audit", "deg") == 0 and "usable: yes" in capsys.readouterr().out
    assert question(swings, "audit", "deg", *twin) == 0
    assert "{column: angle, unit: deg}" in " ".join(capsys.readouterr().out.split())
    assert question(swings, "calibrate", "deg", *twin, "--write", tmp_path / "twin.json") == 1
    assert "sb3-hds: No parameter can be estimated" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_calibrated_twin_is_printed_written_and_read_again(swings, tmp_path, capsys):
    twin, told = tmp_path / "twin.json", tmp_path / "fit.json"
    about = ["--twin", "FreePendulum", "--set", "dt:0.00666667", "mass:0.3"]

    written = ["--json", told, "--write", twin]
    assert question(swings, "calibrate", "rad", *about, "--free", "com,damping", *written) == 0

    assert "com" in (shown := capsys.readouterr().out) and "95 % interval" in shown
    plain = json.loads(told.read_text())
    assert [e["name"] for e in plain["estimates"]] == ["com", "damping"] and plain["converged"]
    assert plain["estimates"][1]["estimate"] == pytest.approx(0.002, rel=0.02)
    assert json.loads(twin.read_text()) == {"twin": plain["twin"]}
    for path in (twin, told):
        again = measured_room.twin_of(Namespace(twin=str(path), set=["mass:0.31"]))
        assert again.values["damping"] == plain["estimates"][1]["estimate"]
        assert again.values["mass"] == 0.31
    extended = again.extend(effects.CoulombFriction(0, tau_c=0.1))
    told.write_text(json.dumps({"twin": extended.to_spec()}))
    again = measured_room.twin_of(Namespace(twin=str(told), set=[]))
    assert again == extended and again.params == extended.params
    told.write_text("[1, 2")
    assert question(swings, "audit", "rad", "--twin", told) == 1
    assert "holds no twin: it has to be what" in capsys.readouterr().err


@each(
    ("diagnose --twin Nothing --data {}", "no twin for 'Nothing'"),
    ("diagnose --twin FreePendulum --data missing.npz", "missing.npz"),
    ("diagnose {} --effects CoulombFrction", "Did you mean 'coulomb_friction'?"),
    ("diagnose {} --set mass=2", "--set takes NAME:VALUE, got 'mass=2'"),
    ("diagnose {} --set mas:1", "Did you mean 'mass'?"),
    ("diagnose {} --columns missing.yml", "missing.yml"),
    ("diagnose {} --report nowhere/out.html", "cannot be written"),
    ("diagnose {} --report r.pdf", "r.html in place of r.pdf"),
    ("diagnose {} --next n.csv", "--limits limits.yml"),
    ("diagnose {} --next n.txt --limits l.yml", "as .csv or .npz"),
    ("diagnose {} --next n.csv --limits missing.yml", "missing.yml"),
    ("diagnose {} --json .", "is a folder"),
    ("diagnose {} --env Pendulum-v1 --algo magic", "no algorithm 'magic'"),
    ("diagnose {} --env Pendulum-v1 --hyperparams speed:1", "speed"),
    ("diagnose {} --env Pendulum-v1 --algo sac", "learns nothing"),
    ("audit --data {} --set mass:1", "--set changes the twin"),
    ("audit --twin CartPole --data {}", "CartPole has 5 channels"),
    ("calibrate {} --free weight", "free must name parameters"),
    ("effects frictoin", "Did you mean 'friction'?"),
    ("twins chek Pendulum", "Did you mean 'check'?"),
    ("twins check", "Name one twin"),
)
def test_a_question_that_makes_no_sense_is_one_message(words, message, swings, capsys):
    data = f"{swings / 'rad.csv'} --columns {swings / 'map.yml'}"
    if " --data" not in words:
        data = f"--twin FreePendulum --data {data}"
        words = words.replace("{}", "{} --set dt:0.00666667") if "--set" not in words else words

    assert cli.main(words.format(data).split()) == 1
    told = capsys.readouterr().err
    assert message in told and "Traceback" not in told and told.count("sb3-hds: ") == 1


@each(
    (["diagnos"], "Did you mean 'diagnose'?"),
    (["diagnose", "--twin", "a", "--data", "b", "--efects", "x"], "option '--efects'. Did"),
    (["diagnose", "--twin", "a", "--data", "b", "--budget", "quik"], "mean 'quick'?"),
    ([], "are required: command"),
)
def test_words_that_are_not_understood_are_one_line(words, message, capsys):
    with pytest.raises(SystemExit) as end:
        cli.main(words)
    told = capsys.readouterr().err
    assert end.value.code == 2 and message in told and told.count("\n") == 1


def test_what_exists_is_listed_with_units_and_filtered_by_words(capsys):
    def shown(*words):
        assert cli.main(words) == 0
        return capsys.readouterr().out.replace("│", " ").split()

    listed = shown("effects")
    for effect in effects.ALL:
        units = [f"{name} [{p.unit}]" for name, p in effect.parameters.items() if name != "flipped"]
        words = [effect.name, *", ".join(units).split(), *effect.explanation.split()]
        assert set(words) <= set(listed), effect.name
    assert {"parameter.NAME", "direction"} <= set(listed) and "flipped" not in listed
    listed = shown("twins")
    assert {*twins.names(), *twins.all_ids(), "observe:qv", "dt:0.005"} <= set(listed)
    assert ":class:" not in listed
    some = shown("effects", "Coulomb-friction")
    assert "directional_coulomb_friction" in some and "quadratic_drag" not in some


def test_the_stored_list_of_effects_is_what_their_classes_say():
    assert catalogue.stored_rows() == catalogue.rows_of_effects(), (
        "write it anew: python -m sb3_hds.cli.catalogue"
    )


def test_help_and_the_list_of_effects_come_without_jax():
    code = (
        "import sys\n"
        "from sb3_hds.cli import main\n"
        "assert main(['effects', 'backlash']) == 0\n"
        "try: main(['--help'])\n"
        "except SystemExit as end: assert end.code == 0\n"
        "print({'jax', 'torch', 'pandas', 'scipy'} & set(sys.modules))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], text=True, capture_output=True)

    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == "set()" and "diagnose" in done.stdout


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


def empty_log(folder, n_obs=2, n_act=0, dt=0.01):
    data = Trajectories.from_arrays([np.zeros((9, n_obs))], [np.zeros((8, n_act))], dt=dt)
    return data.save(folder / "log")


def test_a_twin_is_set_by_words_and_commas_separate_names(asked, tmp_path, capsys):
    log = empty_log(tmp_path, 1, 1)
    given_settings = {
        "FreePendulum": ["observe:q", "zero:up", "driven:true", "mass:2e-1", "substeps:4"],
        "ServoPendulum": ["commands:goal, enable"],
    }
    words = ["--calibrate", "mass,com", "damping", "--effects", "stiffness,", "cogging"]

    for name, given in given_settings.items():
        ask("--twin", name, "--data", log, "--set", *given, *words)

    (free, _, given), (servo, *_) = asked
    assert (free.observed, free.zero, free.driven, free.substeps) == ("q", "up", True, 4)
    assert free.values["mass"] == 0.2 and len(servo.actuators) == 2
    assert given["calibrate"] == ["mass", "com", "damping"]
    assert given["effects"] == ["stiffness", "cogging"]
    # A warning is one line without code.
    assert capsys.readouterr().err == 2 * "warning: Rows are uneven.\n"


@each(
    ("a:1e-3", 1e-3),
    ("a:yes", "yes"),
    ("a:[0, 1.5]", [0, 1.5]),
    ("a:{b: 1}", {"b": 1}),
    ("a:true", True),
)
def test_options_of_environments_and_of_twins_are_read_alike(text, value):
    assert settings("--env-kwargs", [text]) == {"a": value}
    with pytest.raises(ParameterError, match="'\\[1' is no list"):
        settings("--set", ["a:[1"])


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


def test_what_the_audit_proposes_is_done_if_wanted_and_said(asked, tmp_path, capsys):
    """A filter in the drive: the speed comes four samples late."""
    time, told = 0.01 * np.arange(2000), tmp_path / "out.json"
    obs = np.stack([np.sin(3.0 * time), 3.0 * np.cos(3.0 * (time - 0.04))], 1)
    commands = np.random.default_rng(0).standard_normal((1999, 1))
    log = Trajectories.from_arrays([obs], [commands], dt=0.01).save(tmp_path / "log")

    for more in ([], ["--correct", "--json", told]):
        assert ask("--twin", "LinearAxis", "--data", log, *more) == 0
        shown = capsys.readouterr().out
        assert ("Caveat: 'axis_velocity' was shifted by -40 ms." in shown) == bool(more)
    assert json.loads(told.read_text())["caveats"]
    plain, corrected = (data.obs[0] for _, data, _ in asked)
    np.testing.assert_array_equal(plain, obs)
    speed = 3.0 * np.cos(3.0 * time[: len(corrected)])
    np.testing.assert_allclose(corrected[:, 1], speed, atol=0.02)

    assert cli.main(["audit", "--data", str(log), "--correct", "--json", str(told)]) == 0
    shown, audited = capsys.readouterr().out, json.loads(told.read_text())
    assert "'obs[1]' was shifted by -40 ms." in shown and shown.count("Audit of 1 trajectory") == 2
    assert audited["corrections"] and audited["corrected"]["velocity_shift"] == {}


def test_a_diagnosis_and_the_gain_in_policy_are_printed_and_written(tmp_path, capsys, monkeypatch):
    returns = {"believed": np.array([[-9.0, -7.0]]), "extended": np.array([[-4.0, -2.0]])}
    compared = []

    def measure(found, env, learner, **given):
        compared.append((env.unwrapped.spec.id, learner.__name__, given))
        return PolicyGain(returns, _summarised(returns["extended"] - returns["believed"]))

    monkeypatch.setattr("sb3_hds.experiments.measure_policy_gain", measure)
    twin, page, plain = twins.make("PendulumReal"), tmp_path / "out.html", tmp_path / "out.json"
    rubbing = twin.extend(effects.CoulombFriction(0, tau_c=0.1))
    log = measured(rubbing, n=8, n_steps=80, noise=0.01).save(tmp_path / "log")

    code = ask(
        *("--twin", "PendulumReal", "--data", log, "--effects", "coulomb_friction"),
        *("--budget", "quick", "--report", page, "--json", plain),
        *("--env", "sb3_hds/PendulumReal-v1", "--env-kwargs", "friction:0.1"),
        *("--policies", 1, "--episodes", 2, "--hyperparams", "n_rollouts:4"),
    )

    assert code == 0
    ((env, learner, given),) = compared
    assert (env, learner) == ("sb3_hds/PendulumReal-v1", "HDS")
    assert (given["seeds"], given["n_episodes"], given["n_rollouts"]) == (1, 2, 4)
    shown, told = capsys.readouterr().out, json.loads(plain.read_text())
    assert "coulomb_friction at joint hinge" in shown and "2 start states, one run" in shown
    assert told["findings"][0]["effect"] == "coulomb_friction"
    assert told["policy_gain"]["gain"]["mean"] == 5.0 and "5.0" in page.read_text()


def test_where_nothing_was_found_no_policies_are_compared(asked, tmp_path, capsys):
    words = ["--twin", "PendulumReal", "--data", empty_log(tmp_path, 3, 1, 0.05)]
    assert ask(*words, "--env", "sb3_hds/PendulumReal-v1") == 0
    assert "no policies to compare" in capsys.readouterr().out


def test_a_log_without_a_column_map_is_refused_with_the_way_to_write_one(tmp_path, capsys):
    log, empty = tmp_path / "log.csv", tmp_path / "map.yml"
    log.write_text("t,q\n0.0,0.1\n")
    empty.write_text("[]")

    for words in ([], ["--columns", empty]):
        assert ask("--twin", "FreePendulum", "--data", log, *words) == 1
        told = capsys.readouterr().err
        assert "--columns map.yml:" in told and "    actions: [NAME]" in told
        assert "columns={" not in told


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
        "from sb3_hds.cli import catalogue\n"
        "def slow(given):\n"
        "    try: os.kill(os.getpid(), signal.SIGINT)\n"
        "    except KeyboardInterrupt: pass\n"
        "    time.sleep(20)\n"
        "catalogue.run_effects = slow\n"
        "sys.argv = ['sb3-hds', 'effects']\n"
        "sys.exit(cli.main())\n"
    )

    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=15)

    assert (done.returncode, done.stdout, done.stderr) == (130, "", "sb3-hds: interrupted\n")
