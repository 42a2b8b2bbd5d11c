"""How twins are found, added, chosen between and refused."""

import inspect
import json

import gymnasium
import pytest

from sb3_hds import envs, twins
from sb3_hds.core import AnalyticTwin
from sb3_hds.errors import NoTwinError, ParameterError
from sb3_hds.twins import registry


def test_the_registry_finds_twins_by_name_and_by_id():
    assert type(twins.make("Pendulum")) is type(twins.make("Pendulum-v1")) is twins.Pendulum
    assert twins.make("Pendulum", gravity=9.81).values["gravity"] == 9.81
    assert set(twins.all_ids()) >= {
        "InvertedDoublePendulum-v5",
        "InvertedPendulum-v5",
        "MountainCarContinuous-v0",
        "Pendulum-v1",
        "sb3_hds/AcrobotContinuous-v0",
        "sb3_hds/CartPoleSwingUp-v0",
        "sb3_hds/PayloadPendulum-v0",
    }


def test_a_missing_twin_is_refused_with_what_exists_and_how_to_add_one():
    with pytest.raises(NoTwinError) as refusal:
        twins.make("Pendulum-v2")

    assert str(refusal.value) == (
        "There is no twin for 'Pendulum-v2'. Did you mean 'Pendulum-v1'?\n"
        f"Environments with a twin: {', '.join(twins.all_ids())}.\n"
        f"Twins by name: {', '.join(twins.names())}.\n"
        "To add your own (see 'Your own twin' in the documentation):\n\n"
        "    from sb3_hds import twins\n"
        "    from sb3_hds.core import AnalyticTwin\n\n"
        "    @twins.register\n"
        "    class MyTwin(AnalyticTwin):\n"
        '        name, env_id, dt = "MyTwin", "Pendulum-v2", 0.05\n'
        "        ...  # joints, actuators, channels, parameters; initial, infer, observe,\n"
        "        ...  # actuate, mass_matrix, bias, reward"
    )


@pytest.fixture
def clean_registry(monkeypatch):
    monkeypatch.setattr(twins.registry, "_TWINS", dict(twins.registry._TWINS))


def test_a_registered_twin_is_found_and_listed(clean_registry):
    @twins.register
    class Spring(twins.Pendulum):
        name, env_id = "Spring", "lab/Spring-v0"

    assert twins.get("lab/Spring-v0") is twins.get("Spring") is Spring
    assert "Spring" in twins.names()
    assert "lab/Spring-v0" in twins.all_ids()


def test_a_name_is_given_once(clean_registry):
    class Other(AnalyticTwin):
        name, env_id = "Pendulum", None

    with pytest.raises(ValueError, match="'Pendulum' is already the twin Pendulum"):
        twins.register(Other)


def test_only_classes_are_registered():
    register = inspect.unwrap(twins.register)  # without the type checks of the tests

    with pytest.raises(TypeError, match="takes a subclass of Twin, got Pendulum"):
        register(twins.make("Pendulum"))


@pytest.mark.parametrize(
    ("name", "option"),
    [
        ("InvertedDoublePendulum", {"healthy_reward": 1.0}),
        ("InvertedPendulum", {"reset_noise_scale": 0.1}),
        ("MountainCar", {"goal_velocity": 0.01}),
        ("PayloadPendulum", {"goal": "stop_at_origin"}),
    ],
)
def test_an_option_makes_another_program_and_is_written_down(name, option):
    twin = twins.make(name, **option)

    assert twin != twins.make(name)
    assert twins.from_spec(json.loads(json.dumps(twin.to_spec()))) == twin


def test_an_unknown_goal_is_refused_with_the_known_ones():
    with pytest.raises(ParameterError, match="one of 'stop', 'stop_at_origin', got 'fly'"):
        twins.make("PayloadPendulum", goal="fly")


def test_an_environment_made_of_a_twin_hands_it_back():
    envs.register_environments()
    env = gymnasium.make("sb3_hds/PayloadPendulum-v0", goal="stop_at_origin", mass=0.5)

    twin = twins.from_env(env)

    assert twin.goal == "stop_at_origin"
    assert twin.values["mass"] == 0.5


_MODULE = """
from sb3_hds import twins


@twins.register
class Swing(twins.FreePendulum):
    name = "{name}"
"""


def test_a_twin_of_ones_own_is_found_by_its_module(tmp_path, monkeypatch):
    (tmp_path / "rigs_of_a_user.py").write_text(_MODULE.format(name="SwingOfAUser"))
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(registry, "_TWINS", dict(registry._TWINS))

    twin = twins.make("rigs_of_a_user:SwingOfAUser", mass=0.4)

    assert (twin.name, twin.values["mass"]) == ("SwingOfAUser", 0.4)


@pytest.mark.parametrize(
    ("wanted", "message"),
    [
        ("rigs_of_nobody:Swing", "No module named 'rigs_of_nobody'"),
        ("other_rigs_of_a_user:Swing", "registers OtherSwingOfAUser, not 'Swing'"),
        ("json:Swing", "module 'json' registers no twin"),
        (":Swing", "module:Name, got ':Swing'"),
        ("rigs/swing.py:Swing", "module:Name, got"),
    ],
)
def test_what_a_module_does_not_register_is_refused(tmp_path, monkeypatch, wanted, message):
    text = _MODULE.format(name="OtherSwingOfAUser")
    (tmp_path / "other_rigs_of_a_user.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(registry, "_TWINS", dict(registry._TWINS))

    with pytest.raises(NoTwinError) as refusal:
        twins.make(wanted)

    assert message in str(refusal.value)
