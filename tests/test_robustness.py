"""What a table of robustness says, and the command that prints it."""

import csv
import functools
import shlex
import zipfile

import gymnasium
import numpy as np
import pytest
from cases import each
from small_models import small
from test_open_loop import SWIMMER

from sb3_hds import OpenLoop, algos, cli
from sb3_hds.cli import policies
from sb3_hds.errors import EnvironmentMismatchError, TrajectoryError
from sb3_hds.experiments import PERTURBATIONS, Robustness, measure_robustness, returns_of
from sb3_hds.wrappers import CPGPrior, LowPassAction

N_STEPS, EXPENSIVE = 60, pytest.mark.expensive


def short() -> gymnasium.Env:
    return gymnasium.make("Swimmer-v5", max_episode_steps=N_STEPS)


@pytest.fixture(scope="module")
def swimmer() -> OpenLoop:
    return OpenLoop("MlpPolicy", short(), seed=0).set_constants(**SWIMMER)


def test_sensors_do_not_matter_to_a_gait_whose_motors_have_encoders_of_their_own(swimmer):
    found = measure_robustness(swimmer, short, n_episodes=2, progress=False)

    for name in ("noise 0.25", "noise 0.5", "sensor zero", "sensor constant"):
        np.testing.assert_array_equal(found.returns[name], found.returns["none"])
    assert (found.returns["push"] != found.returns["none"]).all()
    # Without perturbation it is what every other measurement of returns finds.
    np.testing.assert_allclose(found.returns["none"], returns_of(swimmer, short(), 2), atol=1e-6)


def test_they_matter_where_the_loop_sees_what_the_policy_sees(swimmer):
    kinds = {name: PERTURBATIONS[name] for name in ("none", "noise 0.5")}

    found = measure_robustness(
        swimmer, short, perturbations=kinds, n_episodes=2, encoders="observation", progress=False
    )

    assert found.share("noise 0.5") < 0.9 and swimmer.policy.read_states is None


def test_a_table_has_shares_of_the_return_without_perturbation_where_they_mean_something():
    """A share of a return that is negative, and the spread of a single episode, do not."""
    found = Robustness({"none": np.array([100.0, 300.0]), "push": np.array([50.0, 100.0])})
    negative = Robustness({"none": np.array([-100.0, -300.0]), "push": np.array([-400.0, -500.0])})
    single = Robustness({"none": np.array([100.0]), "push": np.array([50.0])})

    assert found.share("push") == 0.375 and "0.38" in str(found)
    assert negative.share("push") is None and "-450.0" in str(negative)
    assert single.to_rows()[1]["std"] is None and "std" not in str(single)
    assert "nan" not in f"{negative}{single}"


def test_a_question_that_makes_no_sense_is_refused(swimmer):
    with pytest.raises(TrajectoryError, match="n_episodes of at least 1"):
        measure_robustness(swimmer, short, n_episodes=0)
    with pytest.raises(TrajectoryError, match="a perturbation 'none'"):
        measure_robustness(swimmer, short, perturbations={"push": {"push": 5.0}})
    endless = lambda: gymnasium.make("Swimmer-v5", max_episode_steps=-1)  # noqa: E731
    with pytest.raises(EnvironmentMismatchError, match="TimeLimit"):
        measure_robustness(swimmer, endless)

    class Pictures(gymnasium.Env):
        observation_space = gymnasium.spaces.Box(0, 255, (8, 8, 3), np.uint8)
        action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,))

    with pytest.raises(EnvironmentMismatchError, match="a Box with one axis"):
        measure_robustness(small("droq"), Pictures, n_episodes=1)


def test_what_wrappers_add_is_no_sensor():
    wrap = functools.partial(CPGPrior, omega_swing=4.0)
    model = small("droq", wrap(gymnasium.make("Pendulum-v1")))
    seen = []

    class Seeing(gymnasium.ObservationWrapper):
        def observation(self, observation):
            seen.append(observation)
            return observation

    kinds = {name: PERTURBATIONS[name] for name in ("none", "noise 0.5")}
    how = {"perturbations": kinds, "n_episodes": 1, "progress": False}
    measure_robustness(model, "Pendulum-v1", wrapper=lambda env: Seeing(wrap(env)), **how)

    calm, noisy = np.array_split(np.array(seen), 2)
    # Cosine and sine of the angle, which the sensors show; sine and cosine of the clock.
    assert np.abs(np.hypot(calm[:, 0], calm[:, 1]) - 1.0).max() < 1e-6
    assert np.abs(np.hypot(noisy[:, 0], noisy[:, 1]) - 1.0).max() > 0.1
    np.testing.assert_allclose(np.hypot(noisy[:, 3], noisy[:, 4]), 1.0, atol=1e-6)


def test_the_command_takes_what_the_environment_was_made_and_wrapped_with(tmp_path, capsys):
    env = LowPassAction(gymnasium.make("Pendulum-v1", g=5.0), cutoff=4.0)
    small("droq", env).save(tmp_path / "model")
    words = ["--algo", "droq", "--model", str(tmp_path / "model.zip"), "--env", "Pendulum-v1"]
    wrapper = ["--env-wrapper", "sb3_hds.wrappers.LowPassAction: {cutoff: 4.0}"]
    made = ["--env-kwargs", "g:5.0", "render_mode:null"]
    ask = ["robustness", *words, *made, "--episodes", "1", "--csv"]

    assert cli.main([*ask, str(tmp_path / "table.csv"), *wrapper]) == 0
    shown = capsys.readouterr().out
    assert "sensor constant" in shown and "push is left out: A push needs" in shown
    without = cli.main([*ask, str(tmp_path / "none.csv")])

    model = algos.DroQ.load(tmp_path / "model.zip")
    rows = list(csv.DictReader((tmp_path / "table.csv").open(newline="")))
    assert float(rows[0]["return"]) == pytest.approx(returns_of(model, env, 1)[0], rel=1e-5)
    kinds = [row["perturbation"] for row in rows]
    assert kinds == [kind for kind in PERTURBATIONS if kind != "push"]
    # Without the filter, whose state is observed.
    assert without == 1 and "same arguments and wrappers" in capsys.readouterr().err


@each(("sbx.SAC", "MlpPolicy"), pytest.param("ppo_lstm", "MlpLstmPolicy", marks=EXPENSIVE))
def test_the_command_runs_models_of_the_packages_around(name, policy, tmp_path, capsys):
    pytest.importorskip("sb3_contrib")
    policies.algorithm(name)(policy, "Pendulum-v1", seed=0).save(tmp_path / "model")
    words = ["--algo", name, "--model", str(tmp_path / "model.zip"), "--env", "Pendulum-v1"]

    assert cli.main(["robustness", *words, "--episodes", "1"]) == 0
    assert "sensor constant" in capsys.readouterr().out


@each(
    ("--algo opneloop", "Did you mean 'openloop'?"),
    ("--algo sbx.Nothing", "no class 'sbx.Nothing'"),
    ("--env-wrapper [1,2]", "--env-wrapper takes"),
    ("--env-kwargs weight:5", "no 'Pendulum-v1' with {'weight': 5}"),
    ("--env Nothing-v0", "no 'Nothing-v0'"),
    ("--model FOLDER/modle", "Did you mean 'FOLDER/model.zip'?"),
    ("--model FOLDER/other.zip", "holds no model of droq"),
)
def test_the_command_says_in_one_line_what_it_does_not_know(words, message, tmp_path, capsys):
    small("droq").save(tmp_path / "model")
    with zipfile.ZipFile(tmp_path / "other.zip", "w") as archive:
        archive.writestr("data", "{}")
    known = f"--algo droq --model {tmp_path / 'model.zip'} --env Pendulum-v1"
    given = words.replace("FOLDER", str(tmp_path))

    assert cli.main(["robustness", *known.split(), *shlex.split(given)]) == 1
    told = capsys.readouterr().err
    assert message.replace("FOLDER", str(tmp_path)) in told and told.count("\n") == 1
