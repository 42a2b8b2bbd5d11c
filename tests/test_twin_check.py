"""What checking a twin finds, and that every twin of the library passes."""

import inspect

import jax.numpy as jnp
import numpy as np
import pytest
from cases import each
from free_mass import Mass
from test_twin_contract import broken

from sb3_hds import twins
from sb3_hds.core import (
    AnalyticTwin,
    Parameter,
    State,
    TransformedTwin,
    Twin,
    rk4,
    semi_implicit_euler,
)
from sb3_hds.core.transforms.filters import Delay
from sb3_hds.effects import CoulombFriction, SensorBias
from sb3_hds.twins.mechanics import Points, check_mechanics


@pytest.mark.parametrize(
    "name",
    [
        # Those of two joints take ten seconds each; they have their parity tests, too.
        pytest.param(name, marks=() if len(twins.get(name).joints) == 1 else pytest.mark.expensive)
        for name in twins.names()
    ],
)
def test_every_twin_passes(name):
    found = twins.check(name)
    assert found.ok, found
    energy = [item for item in found.items if item.name in ("mass matrix", "energy")]
    assert len(energy) == 2 * issubclass(twins.get(name), AnalyticTwin)


class Cart(Mass):
    """A mass that is quick to check."""

    substeps = 1
    integrator = staticmethod(semi_implicit_euler)


def light(lower):
    return {"mass": Parameter(1.0, 0.1, "kg", lower=lower)}


def own_mass(self, q, params):
    return self.values["mass"] * jnp.ones((1, 1), q.dtype)


def vanishing(self, q, params):
    return jnp.full((1, 1), params["mass"] - 1.2, q.dtype)


def drag(self, q, v, params):
    return 0.1 * v


def doubled(self, obs, params):
    return State(obs[:1], 2.0 * obs[1:], {})


# Without a derivative where every episode starts.
DISTANT = {
    "parameters": light(0.1),
    "bias": drag,
    "initial": lambda self, key, p: State(jnp.zeros(1), jnp.zeros(1), {}),
    "reward": lambda self, state, action, after, p: -jnp.sqrt(jnp.sum(state.q**2)),
}


@each(
    ({"bias": lambda self, q, v, p: v / (q - q)}, "finite", "with the twin's own values"),
    ({"parameters": light(0.0), "bias": drag}, "finite", "after 1 of 20 steps with mass = 0"),
    (DISTANT, "finite", "the derivative of reward is not finite"),
    ({"infer": doubled}, "infer inverts observe", "differs from obs in 'speed' by 100.0%"),
    ({"mass_matrix": own_mass}, "parameters", "motion, observation and reward: mass"),
    ({"actuate": lambda self, s, u, p: 0.0 * u}, "commands", "effect on the motion: push"),
    ({"mass_matrix": vanishing}, "mass matrix", "rail has an inertia of -"),
)
def test_a_flaw_is_found_by_its_check(changes, name, message):
    found = twins.check(type("Cart", (Cart,), changes)())

    assert found.failed == (name,)
    told = " ".join(str(found).split())
    assert f"FAIL {name}: " in told and message in told
    assert max(map(len, str(found).splitlines())) <= 80


class Arm(Mass):
    """Two links that hang; mass matrix and forces of inertia as in every textbook."""

    name, dt = "Arm", 0.01
    joints = twins.DoublePendulum.joints
    actuators = channels = ()
    parameters = {}
    integrator = staticmethod(semi_implicit_euler)

    def actuate(self, state, action, params):
        return jnp.zeros_like(state.q)

    def mass_matrix(self, q, params):
        both = 1.0 + jnp.cos(q[1])
        return jnp.stack([3.0 + 2.0 * jnp.cos(q[1]), both, both, 0.0 * both + 1.0]).reshape(2, 2)

    def bias(self, q, v, params):
        return self.coriolis(q, v) + self.weight(q)

    def coriolis(self, q, v):
        return jnp.sin(q[1]) * jnp.stack([-v[1] * (2.0 * v[0] + v[1]), v[0] ** 2])

    def weight(self, q):
        outer = 9.81 * jnp.sin(q[0] + q[1])
        return jnp.stack([19.62 * jnp.sin(q[0]) + outer, outer])


def judged(low=-3.0, speed=1.0, **changes):
    rng = np.random.default_rng(0)
    points = Points({}, rng.uniform(low, 3.0, (8, 2)), speed * rng.standard_normal((8, 2)))
    return check_mechanics(type("Arm", (Arm,), changes)(), points)


def test_an_arm_conserves_its_energy_but_for_the_error_of_the_integrator(x64):
    items = judged()

    assert [item.name for item in items if item.ok] == [
        "mass matrix", "gravity and springs", "forces of inertia", "energy"
    ]  # fmt: skip
    assert "they do no work, to" in items[2].found and "no damping" in items[2].found
    # Semi-implicit Euler is of first order: a quarter of the step, a quarter of the error.
    assert items[3].found.endswith("the integrator's error")
    damped = judged(bias=lambda self, q, v, p: self.coriolis(q, v) + self.weight(q) + 0.3 * v)
    assert all(item.ok for item in damped) and "own damping dissipates" in damped[2].found


def inertia(*rows):
    return {"mass_matrix": lambda self, q, params: jnp.array(rows)}


WHIRL = {"weight": lambda self, q: 9.81 * jnp.stack([jnp.sin(q[0] + q[1]), jnp.sin(q[1])])}
PUMP = {"coriolis": lambda self, q, v: 0.9 * Arm.coriolis(self, q, v) + 0.3 * v}
GROW = {"integrator": staticmethod(lambda a, q, v, h, limit: (q + h * v, v * (1.0 + h)))}


@each(
    (inertia([2.0, 1.0], [0.5, 2.0]), "mass matrix", "not symmetric: entry (joint1, joint2)"),
    # Eigenvalues 1 - 1.5 and 1 + 1.5.
    (inertia([1.0, 1.5], [1.5, 1.0]), "mass matrix", "smallest eigenvalue -0.5"),
    (WHIRL, "gravity and springs", "the load of joint1 changes with joint2 by"),
    # At high speed, where damping does not hide it.
    (PUMP, "forces of inertia", "they add energy"),
    (inertia([np.nan, 0.0], [0.0, 1.0]), "equation of motion", "mass_matrix is not finite"),
    (GROW, "energy", "which is no error of the integrator"),
)
def test_what_is_not_mechanical_is_named(changes, name, message, x64):
    failed = [item for item in judged(**changes) if not item.ok]
    assert failed[0].name == name and message in failed[0].found and failed[0].way_out


def test_angles_that_a_twin_wraps_lose_no_energy(x64):
    def wrapped(self, q, v):
        return (q + jnp.pi) % (2.0 * jnp.pi) - jnp.pi, v

    # Fast, from just below half a turn, and without an error of the integrator that would hide it.
    fast = {"low": 2.5, "speed": 5.0, "integrator": staticmethod(rk4)}
    items = judged(limit=wrapped, **fast)

    assert all(item.ok for item in items) and "limit" not in items[-1].found


def test_effects_and_wrappers_are_looked_through(x64):
    extended = Cart().extend(CoulombFriction(0, tau_c=0.3), SensorBias(1, bias=0.1))
    found = twins.check(TransformedTwin(extended, stateful=Delay(steps=2)))
    assert found.ok, found


def test_without_a_mass_matrix_there_is_no_energy_to_check():
    class Plain(Twin):
        name, dt = "Plain", 0.1
        joints, actuators, channels = Cart.joints, Cart.actuators, Cart.channels
        parameters = {"rate": Parameter(1.0, 0.1, "1/s")}
        initial, infer, observe = Cart.initial, Cart.infer, Cart.observe

        def step(self, state, action, params):
            return State(state.q + 0.1 * state.v, params["rate"] * state.v + action, {})

    found = twins.check(Plain)

    assert found.ok and "not checked: energy, without a mass matrix" in str(found)


def test_positions_that_are_not_observed_are_named():
    found = twins.check(twins.make("LinearAxis", observe="q"))
    assert found.ok and "infer does not recover velocity of axis" in " ".join(str(found).split())


def test_a_twin_that_breaks_the_contract_is_told_and_not_raised():
    found = twins.check(broken(bias=lambda self, q, v, params: jnp.sum(q)))

    assert found.failed == ("shapes and dtypes",) and repr(found) == str(found)
    assert not twins.check(broken(options={"masses": [1.0, 2.0]})).ok
    with pytest.raises(TypeError, match="takes a twin, its class or its name, got 5"):
        inspect.unwrap(twins.check)(5)
