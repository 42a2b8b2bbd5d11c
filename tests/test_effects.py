"""The contract every effect keeps. What each of them does is in ``test_effects_*.py``."""

import functools
import json
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import small_robots as robots
from free_mass import Mass

from sb3_hds import effects, twins
from sb3_hds.core import (
    ActionEffect,
    EffectChain,
    ForceEffect,
    JointEffect,
    Parameter,
    SensorEffect,
    State,
    rollout,
)
from sb3_hds.effects import CoulombFriction, ViscousFriction
from sb3_hds.errors import EffectError, ParameterError

pytestmark = pytest.mark.usefixtures("quick_compilation")


class DampedMass(Mass):
    """The same, declaring that viscous friction is what it calls damping."""

    native_effects = {("viscous_friction", 0): {"b": "damping"}}


# Members of each kind that carry memory: doubles of what the catalogue may hold, for the interface.


class Lag(ActionEffect):
    """A drive follows its command as a first-order lag, solved exactly over each sub-step."""

    name = "lag"
    parameters = {"T": Parameter(null=0.0, scale=0.1, unit="s", lower=0.0)}
    explanation = "The drive follows its command with a delay."
    source = "test"

    def memory(self, twin):
        return jnp.zeros(())

    def act(self, command, memory, h, params):
        slow = params["T"] > 0.0
        share = jnp.where(slow, 1.0 - jnp.exp(-h / jnp.where(slow, params["T"], 1.0)), 1.0)
        after = memory + share * (command - memory)
        return after, after


class DrivenSpring(JointEffect):
    """A spring to where the joint was at the start: its memory is the way from there."""

    name = "driven_spring"
    parameters = {"k": Parameter(null=0.0, scale=1.0, unit="N m/rad", lower=0.0)}
    explanation = "Something elastic holds the joint back."
    source = "test"

    def memory(self, twin):
        return {"way": jnp.zeros(())}

    def torque(self, joint, memory, params):
        return -params["k"] * memory["way"]

    def advance(self, moment, index, memory, params):
        return {"way": memory["way"] + moment.h * moment.v[index]}


class LateSensor(SensorEffect):
    """A sensor reports what was ``tau`` ago, plus ``bias``."""

    name = "late_sensor"
    parameters = {
        # Off the grid of samples, where the interpolation has a kink.
        "tau": Parameter(null=0.0, scale=0.07, unit="s", lower=0.0),
        "bias": Parameter(null=0.0, scale=0.1, unit="1"),
    }
    explanation = "The sensor is late and off by a constant."
    source = "test"
    longest = 0.5  # [s]

    def memory(self, measured, twin):
        return jnp.full(2 + int(self.longest / twin.dt), measured)

    def sense(self, measured, memory, dt, params):
        age = jnp.arange(len(memory)) * dt
        return jnp.interp(params["tau"], age, memory) + params["bias"]

    def invert(self, reported, params):
        return reported - params["bias"]

    def advance(self, measured, memory, dt, params):
        return jnp.concatenate([measured[None], memory[:-1]])


class Halved(SensorEffect):
    """A sensor reports half of what it measures, smoothed over two samples."""

    name = "halved"
    parameters = {"share": Parameter(null=1.0, scale=0.1, unit="1")}
    explanation = "The sensor has a wrong gain."
    source = "test"

    def memory(self, measured, twin):
        return measured

    def sense(self, measured, memory, dt, params):
        return params["share"] * memory

    def invert(self, reported, params):
        return reported / params["share"]

    def advance(self, measured, memory, dt, params):
        return measured


FRICTION = (ViscousFriction, CoulombFriction)
DOUBLES = (Lag, DrivenSpring, LateSensor, Halved)
PLACES = {"joint": "joints", "actuator": "actuators", "channel": "channels"}

# Every effect meets these: one joint with clips and one long step; one without clips and with four
# Runge-Kutta steps; a cart-pole whose drive does not act on the hinge. Together, they also meet
# three joints under a servo that reacts to the state.
SYSTEMS = ("Pendulum", "PendulumReal", "InvertedPendulum")
# And one that is made of a model file, some of whose parameters effects are.
MODEL = "Arm"
# These are cheap, and meet every joint and every actuator of every twin.
EVERYWHERE = (effects.ViscousFriction, effects.TorqueGain)

OF_EACH_KIND = (
    effects.TorqueGain,
    effects.CoulombFriction,
    effects.Stiffness,
    effects.JointElasticity,
    effects.SensorDelay,
)

# Where the generic size, null + 0.7 scale, is not felt within three steps.
SIZES = {
    "backlash": {"gap": 1e-4},
    # Edges that overlap, so that both are felt wherever the joint is.
    "clearance_spring": {"k": 0.3, "low": 4.0, "high": -4.0},
}
# Zero is absence and the smallest number is not (its docstring says why): no slope at null.
JUMP_AT_NULL = {"joint_elasticity", "saturation", "sign_flip"}
# Switches and numbers that do nothing at null for another reason: their slope is zero there.
WITHOUT_SLOPE = {"sign_flip.flipped"}


@functools.cache
def made(name):
    if name != MODEL:
        return twins.make(name)
    # Delays are no multiple of its step, where their derivative is one-sided.
    return twins.from_mujoco(robots.compiled(robots.chain(2), timestep=0.0023), dt=0.023)


def places(effect, twin):
    return range(len(getattr(twin, PLACES[effect.slot])))


def last_place(effect, name):
    return places(effect, made(name))[-1]


ENTRIES = (*effects.ALL, *effects.NAMELESS)
CASES = [(effect, name, last_place(effect, name)) for effect in ENTRIES for name in SYSTEMS]
CASES += [(effect, "Pendulum", 0) for effect in DOUBLES]
CASES += [(effect, MODEL, last_place(effect, MODEL)) for effect in ENTRIES]
CASES += [
    (effect, name, where)
    for effect in EVERYWHERE
    for name in twins.names()
    for where in places(effect, twins.make(name))
    if (effect, name, where) not in CASES
]
every_case = pytest.mark.parametrize(
    ("effect", "name", "where"),
    [
        pytest.param(
            *case,
            id=f"{case[0].name}-{case[1]}-{case[2]}",
            # One of each kind suffices day by day: of a drive, a joint, a gear and a sensor.
            marks=pytest.mark.expensive if case[1] == MODEL and case[0] not in OF_EACH_KIND else (),
        )
        for case in CASES
    ],
)
every_effect = pytest.mark.parametrize(
    "effect", (*ENTRIES, *DOUBLES), ids=lambda effect: effect.name
)
every_entry = pytest.mark.parametrize("effect", ENTRIES, ids=lambda effect: effect.name)


def sample_actions(twin, n):
    low, high = (np.array([getattr(a, end) for a in twin.actuators]) for end in ("low", "high"))
    share = np.random.default_rng(0).uniform(0.3, 0.7, (n, len(low)))
    return jnp.asarray(low + share * (high - low))


def replay(twin):
    state = twin.initial(jax.random.key(0), twin.params)
    actions = sample_actions(twin, 50)
    simulate = jax.jit(rollout, static_argnums=0)
    return simulate(twin, twin.params, state, actions).obs


@functools.cache
def replay_plain(name):
    return replay(made(name))


# --- the contract


@every_case
def test_a_null_effect_changes_nothing(x64, effect, name, where):
    extended = made(name).extend(effect(where))

    # Not bitwise: XLA fuses the two programs differently, and 50 steps of a system that falls over
    # amplify rounding of 1e-16 by up to 1e6.
    np.testing.assert_allclose(replay(extended), replay_plain(name), rtol=1e-9, atol=1e-9)


def sizes(effect, share=0.7):
    """Values off null, and off the grids of samples and sub-steps, where delays have a kink."""
    generic = {name: p.null + share * p.scale for name, p in effect.parameters.items()}
    return generic | SIZES.get(effect.name, {})


def outcome_of(twin):
    """
    Where a few steps lead, as a function of the parameters of all effects; and their values. Joints
    move both ways, and so do commands.
    """
    start = twin.initial(jax.random.key(0), twin.params)
    some = sample_actions(twin, 3)
    actions = jnp.stack([some, some.sum(0) - some])
    keys = [key for key in twin.params if key not in twin.base.params]

    def outcome(own):
        params = twin.params | dict(zip(keys, own, strict=True))

        def final(speed, actions):
            # Slower than any twin's limit, so that no clip hides the effect, and not at standstill.
            state = start._replace(v=jnp.full_like(start.v, speed))
            result = rollout(twin, params, state, actions)
            return jnp.concatenate([result.states.v[-1], result.obs[-1]])

        return jax.vmap(final)(jnp.array([0.03, -0.03]), actions).ravel()

    return outcome, np.array([twin.params[key] for key in keys])


def assert_gradient_is_that_of_finite_differences(outcome, at):
    """:return: the slopes, one row for each parameter"""

    along = jax.jit(lambda point, direction: jax.jvp(outcome, (point,), (direction,)))
    slopes = []
    for direction in np.eye(len(at)):
        # Small in units of the parameter: a gap is 1e-4 rad here.
        step = 1e-5 * min(1.0, abs(float(at @ direction)) or 1.0)
        ahead, behind = (along(at + way * step * direction, direction)[0] for way in (1, -1))
        slopes.append(np.asarray(along(at, direction)[1]))
        # Central differences: rounding of 1e-13 / step, and a third derivative times step^2.
        difference = np.subtract(ahead, behind) / (2.0 * step)
        np.testing.assert_allclose(slopes[-1], difference, rtol=1e-5, atol=1e-13 / step)
    return slopes


@every_case
def test_the_gradient_by_a_parameter_is_that_of_finite_differences(x64, effect, name, where):
    twin = made(name).extend(effect(where, **sizes(effect)))

    slopes = assert_gradient_is_that_of_finite_differences(*outcome_of(twin))

    for parameter, slope in zip(effect.parameters, slopes, strict=True):
        assert np.any(slope != 0.0) == (f"{effect.name}.{parameter}" not in WITHOUT_SLOPE)


def test_the_gradient_is_right_where_all_effects_act_at_once(x64):
    # No limit, which would hide how commands came about, and no flip, which has no slope.
    chosen = [e for e in effects.ALL if e.name not in ("saturation", "sign_flip")]
    twin = twins.make("PayloadPendulum").extend(*(e(0, **sizes(e)) for e in chosen))

    assert_gradient_is_that_of_finite_differences(*outcome_of(twin))


@every_entry
def test_the_gradient_at_null_is_that_of_the_smallest_size(x64, effect):
    """Searches begin there. Where null is a bound, it is the slope to the side that is left."""
    outcome, at = outcome_of(twins.make("Pendulum").extend(effect(0)))
    outcome = jax.jit(outcome)
    here, slopes = outcome(at), jax.jit(jax.jacfwd(outcome))(at)

    if effect.name in JUMP_AT_NULL:
        np.testing.assert_array_equal(slopes, 0.0)
        return
    for slope, direction in zip(slopes.T, 1e-7 * np.eye(len(at)), strict=True):
        # One-sided: rounding of 1e-15 / 1e-7, and a second derivative times 1e-7.
        np.testing.assert_allclose(slope, (outcome(at + direction) - here) / 1e-7, 1e-4, 1e-5)
    assert jnp.any(slopes != 0.0)


def slopes_of(*kinds):
    """
    With these effects at null and not, at rest without a command and in motion: the slope of what a
    few steps lead to by all that they depend on; summed along some direction, in forward and in
    reverse mode; and the gradient itself.
    """
    twin = twins.make("Pendulum").extend(*(kind(0) for kind in kinds))
    keys = [key for key in twin.params if key not in twin.base.params]

    def outcome(given):
        *own, q, v, command = given
        params = twin.params | dict(zip(keys, own, strict=True))
        start = twin.infer(jnp.stack([jnp.cos(q), jnp.sin(q), v]), params)
        return rollout(twin, params, start, jnp.full((3, 1), command)).obs[-1]

    @jax.jit
    @jax.vmap
    def slopes(given):
        direction, weights = jnp.linspace(1.0, 2.0, given.size), jnp.array([1.0, -2.0, 3.0])
        _, along = jax.jvp(outcome, (given,), (direction,))
        (gradient,) = jax.vjp(outcome, given)[1](weights)
        return weights @ along, gradient @ direction, gradient

    null = [twin.values[key] for key in keys]
    some = [value for kind in kinds for value in sizes(kind).values()]
    at_rest, moving = [0.0, 0.0, 0.0], [2.0, 1.0, -0.5]
    return slopes(jnp.array([own + state for own in (null, some) for state in (at_rest, moving)]))


@every_effect
def test_reverse_mode_agrees_with_forward_mode(x64, effect):
    forward, reverse, gradient = slopes_of(effect)

    # The same derivative, summed in another order.
    np.testing.assert_allclose(forward, reverse, rtol=1e-9, atol=1e-11)
    assert np.isfinite(gradient).all()


def test_derivatives_are_finite_in_single_precision():
    for slope in slopes_of(*ENTRIES):
        assert slope.dtype == jnp.float32
        assert np.isfinite(slope).all()


@every_effect
def test_a_value_beyond_its_physical_bounds_is_refused(effect):
    for name, parameter in effect.parameters.items():
        if parameter.lower == -np.inf:
            continue
        low = parameter.lower - parameter.scale
        message = f"Parameter '{effect.name}.{name}' must be finite and within"
        with pytest.raises(ParameterError, match=re.escape(message)):
            effect(0, **{name: low})
        twin = twins.Pendulum().extend(effect(0))
        full = next(key for key in twin.params if key.endswith(f".{name}"))
        with pytest.raises(ParameterError, match=re.escape(f"'{full}' must be finite and within")):
            twin.with_parameters(**{full: low})


@every_effect
def test_an_effect_says_what_it_is(effect):
    assert re.fullmatch(r"[a-z][a-z_]*", effect.name)
    assert effect.explanation.endswith(".") and effect.explanation[0].isupper()
    assert effect.source and effect.__doc__
    assert all(parameter.unit for parameter in effect.parameters.values())


def test_a_catalogue_entry_states_its_equation_and_where_it_comes_from():
    for effect in ENTRIES:
        assert ".. math::" in effect.__doc__ and "Source:" in effect.__doc__
    names = [effect.name for effect in ENTRIES]
    assert len(set(names)) == len(names)


def test_what_cannot_be_told_apart_is_known_and_says_so_on_both_sides():
    declared = {effect.name: effect.equivalents for effect in effects.ALL}
    parameters = {
        f"parameter.{name}" for twin in twins.names() for name in twins.get(twin).parameters
    }
    for name, others in declared.items():
        assert set(others) <= set(declared) | parameters
        for other, condition in others.items():
            assert condition[0].islower() and not condition.endswith(".")
            assert other in parameters or name in declared[other]


@every_effect
def test_an_effect_survives_its_spec(effect):
    values = {name: p.null + 0.5 * p.scale for name, p in effect.parameters.items()}
    twin = twins.make("InvertedPendulum").extend(effect(0, **values))

    spec = json.loads(json.dumps(twin.to_spec()))
    back = twins.from_spec(spec, (*effects.KNOWN, *DOUBLES))

    assert back == twin and hash(back) == hash(twin) and back.params == twin.params


@every_effect
def test_attaching_by_name_and_by_index_is_the_same(effect):
    twin = twins.make("InvertedPendulum")
    name = getattr(twin, PLACES[effect.slot])[0].name

    assert twin.extend(effect(name)) == twin.extend(effect(0))
    assert twin.extend(effect(name)).to_spec() == twin.extend(effect(0)).to_spec()


@every_effect
def test_attaching_an_effect_twice_is_an_error(effect):
    twin = twins.Pendulum()
    place = getattr(twin, PLACES[effect.slot])[0].name
    message = (
        f"An effect can be attached once at each place; {effect.name}.{place} came more than once."
    )

    for attach in (
        lambda: twin.extend(effect(0), effect(place)),
        lambda: twin.extend(effect(0)).extend(effect(0)),
    ):
        with pytest.raises(EffectError, match=f"^{re.escape(message)}$"):
            attach()


# --- composition


def test_units_follow_the_place():
    twin = twins.make("InvertedPendulum").extend(
        *(effect(where) for effect in FRICTION for where in ("slider", "hinge")),
        effects.DeadZone("motor"),
        effects.SensorBias("rate"),
    )

    own = {key: p.unit for key, p in twin.parameters.items() if key not in twin.base.parameters}
    assert own == {
        "viscous_friction.slider.b": "N s/m",
        "viscous_friction.hinge.b": "N m s/rad",
        "coulomb_friction.slider.tau_c": "N",
        "coulomb_friction.hinge.tau_c": "N m",
        "dead_zone.motor.width": "1",
        "sensor_bias.rate.bias": "rad/s",
    }
    # A tenth of the largest command, which is 3; of the drive's 300 N; of the pole's weight.
    assert twin.parameters["dead_zone.motor.width"].scale == pytest.approx(0.3)
    assert twin.parameters["coulomb_friction.slider.tau_c"].scale == pytest.approx(30.0)
    weight = twin.base.values["pole_mass"] * 9.81 * twin.base.values["pole_com"]
    assert twin.parameters["coulomb_friction.hinge.tau_c"].scale == pytest.approx(
        0.1 * weight, rel=1e-3
    )


def test_at_a_slider_no_unit_is_that_of_a_hinge():
    sliding = [effect for effect in ENTRIES if effect.slot == "joint"]
    twin = Mass().extend(*(effect(0) for effect in sliding))

    units = {key: parameter.unit for key, parameter in twin.parameters.items()}
    assert not [key for key, unit in units.items() if "rad" in unit or "N m" in unit]


@pytest.mark.parametrize("name", ["PendulumReal", "PayloadPendulum"])
def test_the_whole_catalogue_at_null_changes_nothing(x64, name):
    """Neither what happens, nor what is reported of a state that was moved without its memory."""
    plain = twins.make(name)
    everything = plain.extend(*(effect(0) for effect in effects.ALL))
    np.testing.assert_allclose(replay(everything), replay_plain(name), rtol=1e-9, atol=1e-9)

    start = everything.initial(jax.random.key(0), everything.params)
    elsewhere = start._replace(q=start.q + 0.1)
    np.testing.assert_array_equal(
        everything.observe(elsewhere, everything.params), plain.observe(elsewhere, plain.params)
    )


def test_forces_of_several_effects_add_up(x64):
    twin = Mass(mass=2.0).extend(ViscousFriction(b=0.5), CoulombFriction(tau_c=0.3))
    state = twin.infer(jnp.array([0.0, 4.0]), twin.params)

    after = twin.step(state, jnp.ones(1), twin.params)

    # At 4 m/s the sign of dry friction is saturated to 1 - 2e-348.
    assert float(after.v[0]) == pytest.approx(4.0 + 0.1 / 2.0 * (1.0 - 0.5 * 4.0 - 0.3), rel=1e-14)


FORCES = (
    effects.CoulombFriction(0, tau_c=0.1),
    effects.Cogging(0, amplitude=0.2, period=0.5, phase=0.1),
    effects.Stiffness(1, k=0.3, q0=0.2),
    effects.JointElasticity(0, k=30.0, d=0.1),
    effects.Backlash(1, gap=0.05),
)


def with_forces(*forces):
    return twins.make("DoublePendulum", dt=0.02).extend(*forces, effects.TorqueGain(0, gain=0.8))


@functools.partial(jax.jit, static_argnums=0)
def pushed(twin, params, chosen=None):
    """Where some pushes lead, and its slopes by all parameters."""
    chain, actions = EffectChain((), {}, chosen), jnp.sin(jnp.arange(25.0))[:, None]

    def end(params):
        start = twin.infer(jnp.array([0.5, -0.3, 0.0, 0.0]), params)
        go = lambda state, action: (twin.step(state, action, params, chain), None)  # noqa: E731
        return twin.observe(jax.lax.scan(go, start, actions)[0], params)

    return end(params), jax.jacfwd(end)(params)


@pytest.mark.parametrize("kept", [(), (2,), (0, 1, 2), (3,), (3, 4), (0, 1, 2, 3, 4)], ids=str)
def test_only_chosen_forces_act_and_slopes_are_theirs(x64, kept):
    """One program, told which of its forces to compute, is the twin that has these alone."""
    whole, alone = with_forces(*FORCES), with_forces(*(FORCES[i] for i in kept))

    chosen = whole.choose([whole.attached[i].key for i in kept])
    found, slopes = pushed(whole, whole.params, chosen)
    wanted, wanted_slopes = pushed(alone, alone.params)

    np.testing.assert_allclose(found, wanted, rtol=1e-11, atol=1e-13)
    for name, slope in slopes.items():
        np.testing.assert_allclose(slope, wanted_slopes.get(name, 0.0), rtol=1e-8, atol=1e-10)


def test_extending_an_extended_twin_flattens_and_keeps_order_and_values():
    at_once = Mass(mass=2.0).extend(Lag(T=0.1), CoulombFriction(tau_c=0.3), ViscousFriction(b=0.2))

    in_turn = Mass().extend(Lag(T=0.1)).with_parameters(mass=2.0)
    in_turn = in_turn.extend(CoulombFriction(tau_c=0.1), ViscousFriction(b=0.2))
    in_turn = in_turn.with_parameters(**{"coulomb_friction.rail.tau_c": 0.3})

    assert in_turn == at_once and in_turn.params == at_once.params
    assert [effect.name for effect in in_turn.effects] == [
        "lag", "coulomb_friction", "viscous_friction",
    ]  # fmt: skip
    assert repr(in_turn) == (
        "ExtendedTwin(Mass(mass=2, damping=0), Lag('push', T=0.1), "
        "CoulombFriction('rail', tau_c=0.3), ViscousFriction('rail', b=0.2))"
    )


def test_an_effect_that_the_twin_has_itself_adds_to_its_parameter(x64):
    own, native = Mass(damping=0.5), DampedMass(damping=0.2).extend(ViscousFriction(b=0.3))

    for twin in (own, native):
        state = twin.infer(jnp.array([0.0, 4.0]), twin.params)
        after = twin.step(state, jnp.ones(1), twin.params)
        assert float(after.v[0]) == pytest.approx(4.0 + 0.1 * (1.0 - 0.5 * 4.0), rel=1e-14)
    assert native.params["viscous_friction.rail.b"] == 0.3
    assert native.infer(jnp.zeros(2), native.params).memory == {}


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: Mass().extend(ViscousFriction("hinge")),
            "Effect 'viscous_friction' names joint 'hinge', but Mass has: 0 (rail).",
        ),
        (
            lambda: Mass().extend(LateSensor(2)),
            "Effect 'late_sensor' names channel 2, but Mass has: 0 (position), 1 (speed).",
        ),
        (
            lambda: Mass().extend(Lag(-1)),
            "Effect 'lag' names actuator -1, but Mass has: 0 (push).",
        ),
        (
            lambda: ViscousFriction(tau_c=0.1),
            "Effect 'viscous_friction' has no parameter 'tau_c'. Its parameters are: b.",
        ),
    ],
)
def test_a_wrong_extension_is_refused_with_what_exists(make, message):
    with pytest.raises(EffectError, match=f"^{re.escape(message)}$"):
        make()


# --- memory


@pytest.mark.parametrize("substeps", [1, 5])
def test_a_lagging_drive_answers_a_step_exactly_however_often_it_is_called(x64, substeps):
    twin = Mass(substeps=substeps).extend(Lag(T=0.25))
    start = twin.infer(jnp.zeros(2), twin.params)

    result = rollout(twin, twin.params, start, jnp.ones((20, 1)))

    time = 0.1 * np.arange(21)
    np.testing.assert_allclose(
        result.states.memory["lag.push"], 1.0 - np.exp(-time / 0.25), rtol=1e-12
    )
    # v = integral of the command; its value at the end of each sub-step stands for the sub-step.
    h = 0.1 / substeps
    exact = time - 0.25 * (1.0 - np.exp(-time / 0.25))
    np.testing.assert_allclose(result.states.v[:, 0], exact, atol=0.51 * h)


def test_a_remembered_spring_swings_without_gaining_energy(x64):
    # omega = sqrt(k / m) = 2 rad/s. Semi-implicit Euler keeps q^2 + (v / omega)^2 within
    # 1 +- omega h / 2 for ever; explicit Euler would multiply it by exp(omega^2 h t) = e^8 here.
    twin = Mass(dt=0.1, substeps=5, mass=0.5).extend(DrivenSpring(k=2.0))
    start = twin.infer(jnp.array([0.0, 2.0]), twin.params)

    states = rollout(twin, twin.params, start, jnp.zeros((1000, 1))).states

    energy = states.q[:, 0] ** 2 + (states.v[:, 0] / 2.0) ** 2
    np.testing.assert_allclose(energy, 1.0, atol=2.0 * 0.02 / 2.0 + 1e-3)
    way = states.memory["driven_spring.rail"]["way"]
    np.testing.assert_allclose(way, states.q[:, 0], atol=1e-10)  # sums of 5000 terms
    # Its frequency is off by (omega h)^2 / 24 = 7e-5: after 10 s the phase by 1.4e-3, and the
    # amplitude by omega h / 2.
    time = 0.1 * np.arange(101)
    np.testing.assert_allclose(states.q[:101, 0], np.sin(2.0 * time), atol=0.025)


def test_a_late_sensor_reports_the_past_and_its_bias(x64):
    twin = Mass().extend(LateSensor("position", tau=0.25, bias=3.0))
    start = twin.infer(jnp.array([4.0, 1.0]), twin.params)

    obs = rollout(twin, twin.params, start, jnp.zeros((10, 1))).obs

    # Inferred from a report of 4: the true start is 1, and it moves at 1 m/s.
    past = np.maximum(0.1 * np.arange(11) - 0.25, 0.0)
    np.testing.assert_allclose(obs[:, 0], 1.0 + past + 3.0, rtol=1e-12)
    np.testing.assert_allclose(obs[:, 1], 1.0)


@every_effect
def test_inferring_what_was_observed_at_the_start_is_the_start(x64, effect):
    values = {name: p.null + p.scale for name, p in effect.parameters.items()}
    twin = twins.Pendulum().extend(effect(0, **values))
    start = twin.initial(jax.random.key(3), twin.params)

    back = twin.infer(twin.observe(start, twin.params), twin.params)

    # arctan2 of cos and sin gives the angle back up to rounding.
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12), back, start)


def test_a_sensor_behind_another_measures_what_that_one_reports(x64):
    late, halved = LateSensor("position", tau=0.1, bias=3.0), Halved("position", share=0.5)
    first_late = Mass().extend(late, halved)
    first_halved = Mass().extend(halved, late)
    true = np.maximum(0.1 * np.arange(11) - 0.1, 0.0)  # 1 m/s, one sample ago

    for twin, expected in ((first_late, 0.5 * (true + 3.0)), (first_halved, 0.5 * true + 3.0)):
        start = twin.infer(jnp.array([expected[0], 1.0]), twin.params)
        obs = rollout(twin, twin.params, start, jnp.zeros((10, 1))).obs
        np.testing.assert_allclose(obs[:, 0], expected, rtol=1e-12, atol=1e-12)


def test_memory_batches_and_keeps_the_precision_of_the_state(x64):
    twin = Mass().extend(Lag(T=0.2), DrivenSpring(k=1.0), LateSensor(0, tau=0.1), Halved(1))
    obs = jnp.asarray(np.random.default_rng(0).normal(size=(4, 2)), jnp.float32)
    actions = jnp.ones((10, 1), jnp.float32)

    def simulate(obs):
        return rollout(twin, twin.params, twin.infer(obs, twin.params), actions)

    batch = jax.jit(jax.vmap(simulate))(obs)

    assert {leaf.dtype for leaf in jax.tree.leaves(batch.states)} == {jnp.dtype(jnp.float32)}
    np.testing.assert_allclose(batch.obs[2], simulate(obs[2]).obs, rtol=1e-5)  # float32


def test_a_force_effect_may_act_on_other_joints_than_its_own(x64):
    class Coupling(ForceEffect):
        """Pulls two joints together."""

        name = "coupling"
        parameters = {"k": Parameter(null=0.0, scale=1.0, unit="N m/rad", lower=0.0)}
        explanation, source = "A belt connects two joints.", "test"

        def force(self, moment, index, memory, params):
            pull = params["k"] * (moment.q[1] - moment.q[0])
            return jnp.stack([pull, -pull])

    plain = twins.make("Acrobot", dt=1e-6)
    coupled = plain.extend(Coupling(k=2.0))
    q = jnp.array([0.3, -0.2])

    def speed(twin, memory):
        return twin.step(State(q, jnp.zeros(2), memory), jnp.zeros(1), twin.params).v

    gained = (speed(coupled, {"coupling.shoulder": ()}) - speed(plain, {})) / 1e-6
    pull = 2.0 * (q[1] - q[0])
    expected = np.linalg.solve(plain.mass_matrix(q, plain.params), [pull, -pull])
    np.testing.assert_allclose(gained, expected, rtol=1e-5)  # first order in a step of 1e-6 s
