"""What a twin has to return: refused in one line before anything is compiled."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import each
from free_mass import Mass

from sb3_hds import HDS, Trajectories, calibrate, diagnose, twins
from sb3_hds.core import Actuator, AnalyticTwin, Channel, Joint, Parameter, State, TransformedTwin
from sb3_hds.core.contract import check_methods
from sb3_hds.core.transforms.filters import LowPass
from sb3_hds.effects import CoulombFriction
from sb3_hds.envs import TwinEnv, TwinVecEnv
from sb3_hds.errors import TwinError
from sb3_hds.twins import registry


class Leg(AnalyticTwin):
    """Three masses in a row, of which the first is pushed."""

    name = "Leg"
    dt, max_episode_steps = 0.02, 20
    joints = (Joint("hip"), Joint("knee"), Joint("ankle"))
    actuators = (Actuator("motor", "N m", -1.0, 1.0),)
    channels = tuple(Channel(f"{kind}{i}", "rad") for kind in "qv" for i in range(3))
    parameters = {"inertia": Parameter(1.0, 0.1, "kg m2", lower=1e-3)}

    def initial(self, key, params):
        return State(jax.random.normal(key, (3,)), jnp.zeros(3), {})

    def infer(self, obs, params):
        return State(obs[:3], obs[3:], {})

    def observe(self, state, params):
        return jnp.concatenate([state.q, state.v])

    def actuate(self, state, action, params):
        return jnp.zeros(3, action.dtype).at[0].set(action[0])

    def mass_matrix(self, q, params):
        return params["inertia"] * jnp.eye(3, dtype=q.dtype)

    def bias(self, q, v, params):
        return jnp.sin(q)

    def reward(self, state, action, next_state, params):
        return -jnp.sum(next_state.q**2)


def broken(**changes):
    """:return: a leg with other methods or declarations"""
    return type("Leg", (Leg,), changes)()


def clocked(self, key, params):
    return State(*jnp.zeros((2, 3)), {"clock": jnp.zeros(())})


FORGETFUL = {"initial": clocked, "step": lambda self, state, u, p: state._replace(memory={})}


@each(
    ({"actuate": lambda self, state, action, p: action}, "(3,): one generalised force"),
    ({"bias": lambda self, q, v, p: jnp.sum(q)}, "Leg.bias returns shape (), expected (3,)"),
    ({"bias": lambda self, q, v, p: jnp.float32(q)}, "returns float32, expected float64"),
    ({"mass_matrix": lambda self, q, p: jnp.ones(3, q.dtype)}, "expected (3, 3)"),
    ({"mass_matrix": lambda self, q, p: jnp.eye(3, dtype=int)}, "int32, expected float32"),
    ({"observe": lambda self, state, p: state.q}, "expected (6,): one entry for each channel"),
    ({"infer": lambda self, obs, p: (obs[:3], obs[3:])}, "expected State(q, v, memory)."),
    ({"infer": lambda self, obs, p: State(obs, obs, {})}, "infer(...).q returns shape (6,)"),
    ({"initial": lambda self, k, p: State(*jnp.ones((2, 3)), None)}, "memory returns None"),
    (FORGETFUL, "Leg.step(...).memory returns {}, expected {'clock': 'float32[]'}"),
    ({"reward": lambda self, state, u, after, p: after.q}, "expected (): one number"),
    ({"terminated": lambda self, state, p: state.q[0]}, "returns float32, expected bool"),
    ({"limit": lambda self, q, v: v}, "expected the pair (q, v)."),
    ({"sketch": lambda self, state, p: state.q}, "expected shape (points, 2)"),
    ({"bias": lambda self, q, v, p: p["mass"] * q}, "'mass'. Its parameters are: inertia."),
    ({"bias": lambda self, q, v, p: q @ jnp.ones((2, 2))}, "TypeError (test_twin_contract.py"),
    ({"bias": lambda self, q, v, p: q if q[0] > 0 else -q}, "Replace `if` on an array by"),
    ({"bias": lambda self, q, v, p: np.asarray(q)}, "Use jax.numpy instead of numpy"),
    ({"joints": Joint("hip")}, "Write joints = (Joint(...),), with"),
    ({"joints": (Joint("hip"),) * 3}, "Leg has joints of the same name: hip"),
    ({"actuators": (Actuator("motor", "N m", 1.0, -1.0),)}, "in Leg must be low < high"),
    ({"native_effects": {("x", 0): {"b": "damping"}}}, "to damping, which is no parameter."),
    ({"options": {"masses": [1.0]}}, "options of Leg must be hashable"),
)
def test_what_breaks_the_contract_is_refused_in_one_line(changes, message):
    with pytest.raises(TwinError) as refusal:
        check_methods(broken(**changes))
    assert message in str(refusal.value) and "\n" not in str(refusal.value)


@pytest.fixture
def clean_registry(monkeypatch):
    monkeypatch.setattr(registry, "_TWINS", dict(registry._TWINS))


class Broadcasting(Leg):
    name, env_id = "Broadcasting", "Broadcasting-v0"

    def actuate(self, state, action, params):
        return action


DATA = Trajectories.from_arrays([np.zeros((41, 6))] * 2, [np.zeros((40, 1))] * 2, dt=0.02)


@each(
    lambda twin: twins.register(type(twin)),
    lambda twin: calibrate(twin, DATA),
    lambda twin: diagnose(twin, DATA, progress=False),
    lambda twin: TwinEnv(twin),
    lambda twin: TwinVecEnv(twin, 2),
    lambda twin: HDS(TwinEnv(Leg()), twin=twin),
)
def test_every_door_refuses_it(door, clean_registry):
    with pytest.raises(TwinError, match=r"Broadcasting.actuate returns shape \(1,\)"):
        door(Broadcasting())
    assert "Broadcasting" not in twins.names()


def test_effects_and_filters_keep_the_contract(x64):
    extended = Mass().extend(CoulombFriction(0))
    check_methods(TransformedTwin(extended, stateful=LowPass(cutoff=0.1, order=1)))


def test_a_class_that_is_not_finished_is_not_registered(clean_registry):
    half = {"name": "Half", "dt": 0.1, "parameters": {}, "initial": Leg.initial}
    half |= dict.fromkeys(("joints", "actuators", "channels"), ())

    for base, members, says in (
        (AnalyticTwin, half, "lacks actuate, bias, infer, mass_matrix, observe:"),
        (Leg, {"name": None}, "Leg has no name"),
        (Leg, {"name": "Bare", "parameters": {"inertia": 1.0}}, "parameters as a dictionary"),
    ):
        with pytest.raises(TwinError, match=says):
            twins.register(type("Leg", (base,), members))


def test_a_class_without_defaults_is_checked_when_it_is_made(clean_registry):
    class Choosing(Leg):
        name = "Choosing"

        def __init__(self, length, **settings):
            super().__init__(**settings)
            self.length = length

        def actuate(self, state, action, params):
            return action if self.length > 1.0 else super().actuate(state, action, params)

        def structure(self):
            return (*super().structure(), self.length)

    twins.register(Choosing)

    assert twins.make("Choosing", length=0.5).length == 0.5
    with pytest.raises(TwinError, match=r"Choosing\.actuate"):
        twins.make("Choosing", length=2.0)
