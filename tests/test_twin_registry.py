"""How twins are found, added, chosen between and refused."""

import inspect
import json

import gymnasium
import pytest

from sb3_hds import envs, twins
from sb3_hds.core import AnalyticTwin
from sb3_hds.errors import NoTwinError, ParameterError


def test_the_registry_finds_twins_by_name_and_by_id():
    assert type(twins.make("Pendulum")) is type(twins.make("Pendulum-v1")) is twins.Pendulum
    assert twins.make("Pendulum", gravity=9.81).values["gravity"] == 9.81
    assert {"InvertedPendulum-v5", "sb3_hds/PayloadPendulum-v0"} <= set(twins.all_ids())


def test_a_missing_twin_is_refused_with_what_exists_and_how_to_add_one():
    with pytest.raises(NoTwinError, match=r"Did you mean 'Pendulum-v1'(.|\n)*@twins.register"):
        twins.make("Pendulum-v2")


@pytest.fixture
def clean_registry(monkeypatch):
    monkeypatch.setattr(twins.registry, "_TWINS", dict(twins.registry._TWINS))


def test_a_registered_twin_is_found_and_listed_and_its_name_is_given_once(clean_registry):
    @twins.register
    class Spring(twins.Pendulum):
        name, env_id = "Spring", "lab/Spring-v0"

    class Other(AnalyticTwin):
        name, env_id = "Pendulum", None

    assert twins.get("lab/Spring-v0") is twins.get("Spring") is Spring
    assert "Spring" in twins.names() and "lab/Spring-v0" in twins.all_ids()
    with pytest.raises(ValueError, match="'Pendulum' is already the twin Pendulum"):
        twins.register(Other)
    register = inspect.unwrap(twins.register)  # without the type checks of the tests
    with pytest.raises(TypeError, match="takes a subclass of Twin, got Pendulum"):
        register(twins.make("Pendulum"))


def test_an_option_makes_another_program_and_is_written_down():
    twin = twins.make("PayloadPendulum", goal="stop_at_origin")

    assert twin != twins.make("PayloadPendulum")
    assert twins.from_spec(json.loads(json.dumps(twin.to_spec()))) == twin
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


@pytest.fixture
def module(clean_registry, tmp_path, monkeypatch):
    """Somebody's own module that registers a twin: a name that no other test imports."""

    def write(name, twin):
        (tmp_path / f"{name}.py").write_text(_MODULE.format(name=twin))
        monkeypatch.syspath_prepend(tmp_path)

    return write


def test_a_twin_of_ones_own_is_found_by_its_module(module):
    module("rigs_of_a_user", "SwingOfAUser")

    twin = twins.make("rigs_of_a_user:SwingOfAUser", mass=0.4)

    assert (twin.name, twin.values["mass"]) == ("SwingOfAUser", 0.4)


@pytest.mark.parametrize(
    ("wanted", "message"),
    [
        ("rigs_of_nobody:Swing", "No module named 'rigs_of_nobody'"),
        ("other_rigs_of_a_user:Swing", "registers OtherSwingOfAUser, not 'Swing'"),
        ("json:Swing", "module 'json' registers no twin"),
        ("rigs/swing.py:Swing", "module:Name, got"),
    ],
)
def test_what_a_module_does_not_register_is_refused(module, wanted, message):
    module("other_rigs_of_a_user", "OtherSwingOfAUser")

    with pytest.raises(NoTwinError, match=message):
        twins.make(wanted)
