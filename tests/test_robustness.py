"""What a table of robustness says, and the command that prints it."""

import csv

import gymnasium
import numpy as np
import pytest
from small_models import small
from test_open_loop import SWIMMER

from sb3_hds import OpenLoop, cli
from sb3_hds.errors import TrajectoryError
from sb3_hds.experiments import PERTURBATIONS, Robustness, measure_robustness, returns_of

pytestmark = pytest.mark.usefixtures("quick_compilation")
N_STEPS = 100


def short() -> gymnasium.Env:
    return gymnasium.make("Swimmer-v5", max_episode_steps=N_STEPS)


@pytest.fixture(scope="module")
def swimmer() -> OpenLoop:
    return OpenLoop("MlpPolicy", short(), seed=0).set_constants(**SWIMMER)


def test_sensors_do_not_matter_to_a_gait_whose_motors_have_encoders_of_their_own(swimmer):
    found = measure_robustness(swimmer, short, n_episodes=3, progress=False)

    for name in ("noise 0.25", "noise 0.5", "sensor zero", "sensor constant"):
        np.testing.assert_array_equal(found.returns[name], found.returns["none"])
    assert (found.returns["push"] != found.returns["none"]).all()
    # Without perturbation it is what every other measurement of returns finds.
    np.testing.assert_allclose(found.returns["none"], returns_of(swimmer, short(), 3), atol=1e-6)


def test_they_matter_where_the_loop_sees_what_the_policy_sees(swimmer):
    kinds = {name: PERTURBATIONS[name] for name in ("none", "noise 0.5")}

    found = measure_robustness(
        swimmer, short, perturbations=kinds, n_episodes=3, encoders="observation", progress=False
    )

    assert found.share("noise 0.5") < 0.9
    assert swimmer.policy.read_states is None


def test_they_matter_to_a_policy_that_has_eyes():
    model = small("droq")
    kinds = {name: PERTURBATIONS[name] for name in ("none", "sensor constant")}

    found = measure_robustness(
        model, "Pendulum-v1", perturbations=kinds, n_episodes=2, progress=False
    )

    assert (found.returns["sensor constant"] != found.returns["none"]).any()


def test_a_table_has_shares_of_the_return_without_perturbation():
    found = Robustness({"none": np.array([100.0, 300.0]), "push": np.array([50.0, 100.0])})

    assert found.share("push") == 0.375
    assert "push" in str(found) and "0.38" in str(found)
    assert np.isnan(Robustness({"none": np.array([-1.0])}).share("none"))


def test_a_question_that_makes_no_sense_is_refused(swimmer):
    with pytest.raises(TrajectoryError, match="n_episodes of at least 1"):
        measure_robustness(swimmer, short, n_episodes=0)
    with pytest.raises(TrajectoryError, match="a perturbation 'none'"):
        measure_robustness(swimmer, short, perturbations={"push": {"push": 5.0}})


def test_the_command_prints_and_writes_the_table(swimmer, tmp_path, capsys):
    swimmer.save(tmp_path / "model")
    words = ["--algo", "openloop", "--model", str(tmp_path / "model.zip"), "--env", "Swimmer-v5"]

    done = cli.main(["robustness", *words, "--episodes", "1", "--csv", str(tmp_path / "table.csv")])

    assert done == 0
    assert "sensor constant" in capsys.readouterr().out
    with (tmp_path / "table.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["perturbation"] for row in rows] == list(PERTURBATIONS)
    assert float(rows[1]["share"]) == 1.0


def test_the_command_names_an_algorithm_that_there_is_not(capsys):
    words = ["--algo", "opneloop", "--model", "model.zip", "--env", "Swimmer-v5"]

    assert cli.main(["robustness", *words]) == 1
    assert "no algorithm 'opneloop'" in capsys.readouterr().err
