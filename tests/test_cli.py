"""The command line: what it prints, what it writes, how it fails."""

import json

import numpy as np
import pytest
from measuring import measured

from sb3_hds import Trajectories, cli, effects, twins


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    twin = twins.make("PendulumReal").extend(effects.CoulombFriction(0, tau_c=0.1))
    data = measured(twin, n=12, n_steps=100, noise=0.01)
    return str(data.save(tmp_path_factory.mktemp("log") / "data"))


def ask(*words):
    return cli.main(["diagnose", *map(str, words)])


def test_a_diagnosis_is_printed_and_written(log, tmp_path, capsys):
    page, plain = tmp_path / "out.html", tmp_path / "out.json"
    chosen = ["--effects", "coulomb_friction", "viscous_friction"]

    code = ask("--twin", "PendulumReal", "--data", log, *chosen, "--report", page, "--json", plain)

    assert code == 0
    assert "coulomb_friction at joint hinge" in capsys.readouterr().out
    assert json.loads(plain.read_text())["findings"][0]["effect"] == "coulomb_friction"
    assert page.read_text().startswith("<!DOCTYPE html>")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["out.html", "out.json"]


def test_any_verdict_is_success(tmp_path, capsys):
    rng = np.random.default_rng(0)
    still = np.array([-1.0, 0.0, 0.0]) + 1e-3 * rng.standard_normal((8, 61, 3))
    data = Trajectories.from_arrays(list(still), [np.zeros((60, 1))] * 8, dt=0.05)

    code = ask("--twin", "PendulumReal", "--data", data.save(tmp_path / "still"))

    assert code == 0
    assert "not_identifiable" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"--twin": "Nothing"}, "There is no twin for 'Nothing'"),
        ({"--data": "missing.npz"}, "missing.npz"),
        ({"--effects": "magic"}, "There is no effect magic"),
        ({"--set": "mass=2"}, "NAME:VALUE"),
        ({"--set": "mass:-1"}, "mass"),
        ({"--calibrate": "weight"}, "Its parameters are"),
    ],
)
def test_a_question_that_makes_no_sense_is_one_message(log, capsys, changes, message):
    words = {"--twin": "PendulumReal", "--data": log} | changes

    code = ask(*(word for pair in words.items() for word in pair))

    assert code == 1
    told = capsys.readouterr().err
    assert told.startswith("sb3-hds: ") and message in told and "Traceback" not in told


def test_what_exists_is_listed_with_units(capsys):
    assert cli.main(["effects"]) == cli.main(["twins"]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert "coulomb_friction" in shown and "tau_c [N m]" in shown
    assert "PendulumReal" in shown
    assert np.all([effect.name in shown for effect in effects.ALL])
