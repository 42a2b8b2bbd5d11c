"""What a twin has to return: refused in one line before anything is compiled."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from free_mass import Mass

from sb3_hds import HDS, Trajectories, calibrate, diagnose, twins
from sb3_hds.core import Actuator, AnalyticTwin, Channel, Joint, Parameter, State, TransformedTwin
from sb3_hds.core.contract import check_methods
from sb3_hds.core.filters import LowPass
from sb3_hds.effects import CoulombFriction
from sb3_hds.envs import TwinEnv, TwinVecEnv
from sb3_hds.errors import ParameterError, TwinError
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


# By mistake: what is changed, and a part of what is said.
WRONG = {
    "a command that would push every joint": (
        {"actuate": lambda self, state, action, params: action},
        "Leg.actuate returns shape (1,), expected (3,): one generalised force for each joint",
    ),
    "a load that would pull every joint": (
        {"bias": lambda self, q, v, params: jnp.sum(q)},
        "Leg.bias returns shape (), expected (3,)",
    ),
    "a vector in the place of a matrix": (
        {"mass_matrix": lambda self, q, params: jnp.ones(3, q.dtype)},
        "Leg.mass_matrix returns shape (3,), expected (3, 3)",
    ),
    "a mass of whole numbers": (
        {"mass_matrix": lambda self, q, params: jnp.eye(3, dtype=int)},
        "Leg.mass_matrix returns int32, expected float32",
    ),
    "single precision where data are fitted": (
        {"bias": lambda self, q, v, params: jnp.sin(q).astype(jnp.float32)},
        "Leg.bias returns float32, expected float64",
    ),
    "a channel that is not measured": (
        {"observe": lambda self, state, params: state.q},
        "Leg.observe returns shape (3,), expected (6,): one entry for each channel (q0, q1, q2,",
    ),
    "a pair in the place of a state": (
        {"infer": lambda self, obs, params: (obs[:3], obs[3:])},
        "Leg.infer returns a tuple, expected State(q, v, memory).",
    ),
    "a state of another size": (
        {"infer": lambda self, obs, params: State(obs, obs, {})},
        "Leg.infer(...).q returns shape (6,), expected (3,)",
    ),
    "a memory that is none": (
        {"initial": lambda self, key, params: State(jnp.zeros(3), jnp.zeros(3), None)},
        "Leg.initial(...).memory returns None, expected a dictionary",
    ),
    "a step that forgets": (
        {
            "initial": lambda self, key, params: State(
                *jnp.zeros((2, 3)), {"clock": jnp.zeros(())}
            ),
            "step": lambda self, state, action, params: State(state.q, state.v, {}),
        },
        "Leg.step(...).memory returns {}, expected {'clock': 'float32[]'}",
    ),
    "a reward for each joint": (
        {"reward": lambda self, state, action, next_state, params: -(next_state.q**2)},
        "Leg.reward returns shape (3,), expected (): one number",
    ),
    "a plan that is rewarded joint by joint": (
        {"planning_reward": lambda self, state, action, next_state, params: next_state.q},
        "Leg.planning_reward returns shape (3,), expected ()",
    ),
    "an end that is a number": (
        {"terminated": lambda self, state, params: state.q[0]},
        "Leg.terminated returns float32, expected bool",
    ),
    "a limit that returns velocities alone": (
        {"limit": lambda self, q, v: v},
        "Leg.limit returns one array of shape (3,), expected the pair (q, v).",
    ),
    "one speed for all": (
        {"limit_velocity": lambda self, v: jnp.max(v)},
        "Leg.limit_velocity returns shape (), expected (3,)",
    ),
    "a sketch without a second coordinate": (
        {"sketch": lambda self, state, params: state.q},
        "Leg.sketch returns one array of shape (3,), expected shape (points, 2)",
    ),
    "a name that is no parameter": (
        {"bias": lambda self, q, v, params: params["mass"] * q},
        "'mass'. Its parameters are: inertia.",
    ),
    "a branch": (
        {"bias": lambda self, q, v, params: q if q[0] > 0 else -q},
        "Replace `if` on an array by jnp.where.",
    ),
    "numpy": (
        {"bias": lambda self, q, v, params: np.asarray(q)},
        "Use jax.numpy in place of numpy and math.",
    ),
    "a joint without its comma": ({"joints": Joint("hip")}, "Write joints = (Joint(...),), with"),
    "joints of one name": ({"joints": (Joint("hip"),) * 3}, "Leg has joints of the same name: hip"),
    "limits the wrong way round": (
        {"actuators": (Actuator("motor", "N m", 1.0, -1.0),)},
        "The limits of 'motor' in Leg must be low < high",
    ),
    "an effect that adds to nothing": (
        {"native_effects": {("viscous_friction", 0): {"b": "damping"}}},
        "maps ('viscous_friction', 0) to damping, which is no parameter.",
    ),
    "an option that is a list": ({"options": {"masses": [1.0]}}, "options of Leg must be hashable"),
}


@pytest.mark.parametrize("mistake", WRONG)
def test_what_breaks_the_contract_is_refused_in_one_line(mistake):
    changes, message = WRONG[mistake]

    with pytest.raises(TwinError) as refusal:
        check_methods(broken(**changes))

    assert message in str(refusal.value) and "\n" not in str(refusal.value)


def test_a_failing_method_is_told_with_its_file_and_line():
    class Failing(Leg):
        def bias(self, q, v, params):
            return q @ jnp.ones((2, 2))

    with pytest.raises(TwinError, match=r"Failing.bias raises TypeError \(test_.*\.py, line \d+\)"):
        check_methods(Failing())


@pytest.fixture
def clean_registry(monkeypatch):
    monkeypatch.setattr(registry, "_TWINS", dict(registry._TWINS))


class Broadcasting(Leg):
    name, env_id = "Broadcasting", "Broadcasting-v0"

    def actuate(self, state, action, params):
        return action


DATA = Trajectories.from_arrays([np.zeros((41, 6))] * 2, [np.zeros((40, 1))] * 2, dt=0.02)


@pytest.mark.parametrize(
    "door",
    [
        lambda twin: twins.register(type(twin)),
        lambda twin: calibrate(twin, DATA),
        lambda twin: diagnose(twin, DATA, progress=False),
        lambda twin: TwinEnv(twin),
        lambda twin: TwinVecEnv(twin, 2),
        lambda twin: HDS(TwinEnv(Leg()), twin=twin),
    ],
)
def test_every_door_refuses_it(door, clean_registry):
    with pytest.raises(TwinError, match=r"Broadcasting.actuate returns shape \(1,\)"):
        door(Broadcasting())
    assert "Broadcasting" not in twins.names()


def test_effects_and_filters_keep_the_contract(x64):
    extended = Mass().extend(CoulombFriction(0))
    check_methods(TransformedTwin(extended, stateful=LowPass(cutoff=0.1, order=1)))


def test_a_class_that_is_not_finished_is_not_registered(clean_registry):
    class Half(AnalyticTwin):
        name, dt, parameters = "Half", 0.1, {}
        joints = actuators = channels = ()

        def initial(self, key, params):
            return State(jnp.zeros(0), jnp.zeros(0), {})

    class Nameless(Leg):
        name = None

    class Bare(Leg):
        name, parameters = "Bare", {"inertia": 1.0}

    with pytest.raises(TwinError, match="Half lacks actuate, bias, infer, mass_matrix, observe:"):
        twins.register(Half)
    with pytest.raises(TwinError, match="Nameless has no name"):
        twins.register(Nameless)
    with pytest.raises(TwinError, match="Bare must declare parameters as a dictionary"):
        twins.register(Bare)


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


def test_a_twin_is_checked_once(monkeypatch):
    calls = []

    class Counted(Leg):
        def bias(self, q, v, params):
            calls.append(q)
            return jnp.sin(q)

    check_methods(Counted())
    n = len(calls)
    check_methods(Counted(inertia=2.0))

    assert n == len(calls) > 0


def test_a_name_that_is_no_parameter_suggests_the_nearest():
    with pytest.raises(ParameterError, match=r"no parameter 'inertai'\. Did you mean 'inertia'"):
        Leg(inertai=1.0)
