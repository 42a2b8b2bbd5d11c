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
    with pytest.raises(TypeError, match="takes a subclass of Twin, got Pendulum"):
        inspect.unwrap(twins.register)(twins.make("Pendulum"))


def test_an_option_makes_another_program_and_is_read_from_an_environment():
    envs.register_environments()
    env = gymnasium.make("sb3_hds/PayloadPendulum-v0", goal="stop_at_origin", mass=0.5)

    twin = twins.from_env(env)

    assert (twin.goal, twin.values["mass"]) == ("stop_at_origin", 0.5)
    assert twin != twins.make("PayloadPendulum")
    assert twins.from_spec(json.loads(json.dumps(twin.to_spec()))) == twin
    with pytest.raises(ParameterError, match="one of 'stop', 'stop_at_origin', got 'fly'"):
        twins.make("PayloadPendulum", goal="fly")


_MODULE = """
from sb3_hds import twins


@twins.register
class Swing(twins.FreePendulum):
    name = "SwingOfAUser"
"""


def test_a_twin_of_ones_own_is_found_by_its_module(clean_registry, tmp_path, monkeypatch):
    (tmp_path / "rigs_of_a_user.py").write_text(_MODULE)
    monkeypatch.syspath_prepend(tmp_path)

    twin = twins.make("rigs_of_a_user:SwingOfAUser", mass=0.4)

    assert (twin.name, twin.values["mass"]) == ("SwingOfAUser", 0.4)
    for wanted, message in (
        ("rigs_of_nobody:Swing", "No module named 'rigs_of_nobody'"),
        ("rigs_of_a_user:Swing", "registers SwingOfAUser, not 'Swing'"),
        ("json:Swing", "module 'json' registers no twin"),
        ("rigs/swing.py:Swing", "module:Name, got"),
    ):
        with pytest.raises(NoTwinError, match=message):
            twins.make(wanted)
