"""The contract every effect keeps. What each of them does is in ``test_effects_*.py``."""

import functools
import json
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import each
from free_mass import Mass, moved

from sb3_hds import effects, twins
from sb3_hds.core import EffectChain, ForceEffect, Moment, rollout
from sb3_hds.effects import CoulombFriction, ViscousFriction
from sb3_hds.errors import EffectError, ParameterError


class DampedMass(Mass):
    """The same, declaring that viscous friction is what it calls damping."""

    native_effects = {("viscous_friction", 0): {"b": "damping"}}


PLACES = {"joint": "joints", "actuator": "actuators", "channel": "channels"}
ENTRIES = (*effects.ALL, *effects.NAMELESS)
every_entry = pytest.mark.parametrize("effect", ENTRIES, ids=lambda effect: effect.name)


# Where the generic size, null + 0.7 scale, is not felt within three steps.
SIZES = {
    "backlash": {"gap": 1e-4},
    # Edges that overlap, so that both are felt wherever the joint is.
    "clearance_spring": {"k": 0.3, "low": 4.0, "high": -4.0},
}
# Zero is absence and the smallest number is not (its docstring says why): no slope at null.
JUMP_AT_NULL = {"joint_elasticity", "saturation", "sign_flip"}


def sizes(effect, share=0.7):
    """Values off null, and off the grids of samples and sub-steps, where delays have a kink."""
    generic = {name: p.null + share * p.scale for name, p in effect.parameters.items()}
    return generic | SIZES.get(effect.name, {})


def replay(twin):
    low, high = (np.array([getattr(a, end) for a in twin.actuators]) for end in ("low", "high"))
    share = np.random.default_rng(0).uniform(0.3, 0.7, (50, len(low)))
    actions = low + share * (high - low) if np.isfinite(low).all() else share - 0.4
    state = twin.initial(jax.random.key(0), twin.params)
    return jax.jit(rollout, static_argnums=0)(twin, twin.params, state, jnp.asarray(actions)).obs


def test_the_whole_catalogue_at_null_changes_nothing(x64):
    """Neither what happens, nor what is reported of a state that was moved without its memory."""
    # Its drive does not act on the hinge.
    plain = twins.make("InvertedPendulum")
    last = {slot: len(getattr(plain, places)) - 1 for slot, places in PLACES.items()}
    everything = plain.extend(*(kind(last[kind.slot]) for kind in ENTRIES))

    # Not bitwise: XLA fuses the two programs differently, and 50 steps of a system that falls over
    # amplify rounding of 1e-16 by up to 1e6.
    np.testing.assert_allclose(replay(everything), replay(plain), rtol=1e-9, atol=1e-9)
    start = everything.initial(jax.random.key(0), everything.params)
    elsewhere = start._replace(q=start.q + 0.1)
    np.testing.assert_array_equal(
        everything.observe(elsewhere, everything.params), plain.observe(elsewhere, plain.params)
    )


GROUPS = {
    slot: [effect for effect in ENTRIES if effect.__module__.endswith(slot)]
    for slot in ("joint", "position", "flexible", "transmission", "actuator", "sensor")
}
# The limit hides how commands came about.
GROUPS["actuator"].remove(effects.Saturation)
GROUPS["sensor"].append(effects.Saturation)


@pytest.mark.parametrize("group", GROUPS)
def test_derivatives_are_those_of_differences_in_both_modes_at_null_and_off_it(group):
    """At rest and in motion. Where null is a bound, the slope is that to the side that is left."""
    kinds = GROUPS[group]
    twin = twins.make("Pendulum").extend(*(kind(0) for kind in kinds))
    keys = [key for key in twin.params if key not in twin.base.params]

    def outcome(given):
        *own, q, v, command = given
        params = twin.params | dict(zip(keys, own, strict=True))
        start = twin.infer(jnp.stack([jnp.cos(q), jnp.sin(q), v]), params)
        return rollout(twin, params, start, jnp.full((3, 1), command)).obs[-1]

    @jax.jit
    @jax.vmap
    def derivatives(given):
        return outcome(given), jax.jacfwd(outcome)(given), jax.jacrev(outcome)(given)

    null = [twin.values[key] for key in keys]
    some = [value for kind in kinds for value in sizes(kind).values()]
    states = [[2.0, 1.0, -0.5], [2.0, -1.0, 0.5], [0.0, 0.0, 0.0]]
    points = np.array([own + state for own in (null, some) for state in states])
    # Then each parameter a little larger, in both motions.
    off = 1e-7 * np.eye(points.shape[1])[: len(keys), None]

    for slopes in jax.jit(jax.vmap(jax.jacrev(outcome)))(jnp.asarray(points, jnp.float32)):
        assert slopes.dtype == jnp.float32 and np.isfinite(slopes).all()
    with jax.enable_x64(True):
        near = np.concatenate([points[:2] + off, points[3:5] + off]).reshape(-1, points.shape[1])
        every = jnp.asarray(np.concatenate([points, near]))
        values, forward, reverse = map(np.asarray, derivatives(every))
    # The same derivative, summed in another order.
    np.testing.assert_allclose(forward, reverse, rtol=1e-9, atol=1e-11)
    felt, ahead = {0: set(), 3: set()}, values[6:].reshape(2, len(keys), 2, -1)
    for k, at in enumerate(felt):
        for i, key in enumerate(keys):
            name, slope = key.split(".")[0], forward[at : at + 2, :, i]
            felt[at] |= {name} if slope.any() else set()
            if at or name not in JUMP_AT_NULL:
                # One-sided: rounding of 1e-15 / 1e-7, and a second derivative times 1e-7.
                difference = (ahead[k, i] - values[at : at + 2]) / 1e-7
                np.testing.assert_allclose(slope, difference, 1e-4, 1e-5, err_msg=key)
    names = {kind.name for kind in kinds}
    assert felt == {0: names - JUMP_AT_NULL, 3: names - {"sign_flip"}}


def test_a_value_beyond_its_physical_bounds_is_refused():
    twin, full = Mass().extend(CoulombFriction(0)), "coulomb_friction.rail.tau_c"
    with pytest.raises(ParameterError, match=r"coulomb_friction\.tau_c' must be finite and within"):
        CoulombFriction(0, tau_c=-0.1)
    with pytest.raises(ParameterError, match=f"'{full}' must be finite and within"):
        twin.with_parameters(**{full: -0.1})
    lower = {name: p.lower for kind in ENTRIES for name, p in kind.parameters.items()}
    unbounded = {name for name in lower if lower[name] == -np.inf}
    assert unbounded == {"q0", "phase", "tau_0", "bias", "low", "high"}


@every_entry
def test_an_effect_says_what_it_is_and_where_it_comes_from(effect):
    assert re.fullmatch(r"[a-z][a-z_]*", effect.name)
    assert effect.explanation.endswith(".") and effect.explanation[0].isupper() and effect.source
    assert all(parameter.unit for parameter in effect.parameters.values())
    assert ".. math::" in effect.__doc__ and "Source:" in effect.__doc__
    assert [other.name for other in ENTRIES].count(effect.name) == 1


def test_effects_declare_their_equivalents_mutually():
    declared = {effect.name: effect.equivalents for effect in effects.ALL}
    owners = map(twins.get, twins.names())
    parameters = {f"parameter.{name}" for twin in owners for name in twin.parameters}
    for name, others in declared.items():
        assert set(others) <= set(declared) | parameters
        for other, condition in others.items():
            assert condition[0].islower() and not condition.endswith(".")
            assert other in parameters or name in declared[other]


@every_entry
def test_an_effect_is_attached_once_by_name_or_index_and_survives_its_spec(effect):
    plain = twins.make("InvertedPendulum")
    place = getattr(plain, PLACES[effect.slot])[0].name
    twin = plain.extend(effect(0, **sizes(effect, 0.5)))

    back = twins.from_spec(json.loads(json.dumps(twin.to_spec())), effects.KNOWN)

    assert back == twin and hash(back) == hash(twin) and back.params == twin.params
    assert plain.extend(effect(place)).to_spec() == plain.extend(effect(0)).to_spec()
    for attach in (lambda: plain.extend(effect(0), effect(place)), lambda: twin.extend(effect(0))):
        with pytest.raises(EffectError, match=f"once at each place; {effect.name}.{place} was"):
            attach()


def test_units_follow_the_place():
    sliding = Mass().extend(*(effect(0) for effect in ENTRIES if effect.slot == "joint"))
    units = {key: parameter.unit for key, parameter in sliding.parameters.items()}
    assert not [key for key, unit in units.items() if "rad" in unit or "N m" in unit]

    twin = twins.make("InvertedPendulum").extend(
        *(CoulombFriction(where) for where in ("slider", "hinge")),
        effects.DeadZone("motor"),
        effects.SensorBias("rate"),
    )

    own = {key: p for key, p in twin.parameters.items() if key not in twin.base.parameters}
    assert {key: p.unit for key, p in own.items()} == {
        "coulomb_friction.slider.tau_c": "N",
        "coulomb_friction.hinge.tau_c": "N m",
        "dead_zone.motor.width": "1",
        "sensor_bias.rate.bias": "rad/s",
    }
    # A tenth of the pole's weight, of the drive's 300 N, and of the largest command, which is 3.
    weight = twin.base.values["pole_mass"] * 9.81 * twin.base.values["pole_com"]
    scales = [own[key].scale for key in sorted(own)][:3]
    np.testing.assert_allclose(scales, [0.1 * weight, 30.0, 0.3], rtol=1e-3)


FORCES = (
    effects.CoulombFriction(0, tau_c=0.1),
    effects.Stiffness(0, k=0.3, q0=0.2),
    effects.JointElasticity(0, k=30.0, d=0.1),
)


@functools.partial(jax.jit, static_argnums=0)
def pushed(twin, params, chosen=None):
    """Where some pushes lead, and its slopes by all parameters."""
    chain, actions = EffectChain((), {}, chosen), jnp.sin(jnp.arange(25.0))[:, None]

    def end(params):
        start = twin.infer(jnp.array([0.5, 0.0]), params)
        go = lambda state, action: (twin.step(state, action, params, chain), None)  # noqa: E731
        return twin.observe(jax.lax.scan(go, start, actions)[0], params)

    return end(params), jax.jacfwd(end)(params)


def test_only_chosen_forces_act_and_slopes_are_theirs(x64):
    """One program, told which of its forces to compute, is the twin that has these alone."""
    gain, plain = effects.TorqueGain(0, gain=0.8), twins.make("LinearAxis", dt=0.02)
    whole, alone = (plain.extend(*forces, gain) for forces in (FORCES, FORCES[1:]))

    chosen = whole.choose([attached.key for attached in whole.attached[1:3]])
    found, slopes = pushed(whole, whole.params, chosen)
    wanted, wanted_slopes = pushed(alone, alone.params)

    np.testing.assert_allclose(found, wanted, rtol=1e-11, atol=1e-13)
    for name, slope in slopes.items():
        np.testing.assert_allclose(slope, wanted_slopes.get(name, 0.0), rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize(
    "effect", [e for e in ENTRIES if issubclass(e, ForceEffect)], ids=lambda effect: effect.name
)
def test_an_effect_that_says_so_does_not_depend_on_the_load(effect, x64):
    """What it says decides whether the load is computed for it at all."""
    twin = twins.make("DoublePendulum").extend(effect(0, **sizes(effect)))
    memory = twin.initial(jax.random.key(0), twin.params).memory.get(twin.attached[0].key, ())
    own = twin.attached[0].own(twin.params)

    def felt(load, bend):
        q, v = jnp.array([0.3, -0.4]), jnp.array([0.9, 0.5])
        matrix = jnp.array([[2.0, 0.3], [0.3, 1.0]]) * (1.0 + bend)
        moment = Moment(q, v, jnp.array([0.2, 0.1]), load, matrix, 1e-3)
        bound = twin.attached[0].effect
        return bound.force(moment, 0, memory, own), bound.advance(moment, 0, memory, own)

    slopes = jax.jacfwd(felt, (0, 1))(jnp.array([0.7, -0.2]), jnp.array(0.0))

    felt_at_all = any(np.any(np.asarray(slope)) for slope in jax.tree.leaves(slopes))
    assert felt_at_all == effect.uses_load


def test_extending_an_extended_twin_flattens_and_keeps_order_and_values():
    lag, friction = effects.MotorLag(time_constant=0.1), ViscousFriction(b=0.2)
    at_once = Mass(mass=2.0).extend(lag, CoulombFriction(tau_c=0.3), friction)

    in_turn = Mass().extend(lag).with_parameters(mass=2.0)
    in_turn = in_turn.extend(CoulombFriction(tau_c=0.1), friction)
    in_turn = in_turn.with_parameters(**{"coulomb_friction.rail.tau_c": 0.3})

    assert in_turn == at_once and in_turn.params == at_once.params
    assert repr(in_turn) == (
        "ExtendedTwin(Mass(mass=2, damping=0), MotorLag('push', time_constant=0.1), "
        "CoulombFriction('rail', tau_c=0.3), ViscousFriction('rail', b=0.2))"
    )


def test_forces_add_up_and_one_that_the_twin_has_itself_adds_to_its_parameter(x64):
    dry = CoulombFriction(tau_c=0.3)
    added = Mass(mass=2.0).extend(ViscousFriction(b=0.5), dry)
    native = DampedMass(mass=2.0, damping=0.2).extend(ViscousFriction(b=0.3), dry)

    for twin in (added, native):
        after = twin.step(twin.infer(jnp.array([0.0, 4.0]), twin.params), jnp.ones(1), twin.params)
        # At 4 m/s the sign of dry friction is saturated to 1 - 2e-348.
        expected = 4.0 + 0.1 / 2.0 * (1.0 - 0.5 * 4.0 - 0.3)
        assert float(after.v[0]) == pytest.approx(expected, rel=1e-14)
    assert native.params["viscous_friction.rail.b"] == 0.3
    assert "viscous_friction.rail" not in native.infer(jnp.zeros(2), native.params).memory


@each(
    (lambda: Mass().extend(ViscousFriction("hinge")), "joint 'hinge', but Mass has: 0 (rail)"),
    (lambda: Mass().extend(effects.SensorBias(2)), "Mass has: 0 (position), 1 (speed)"),
    (lambda: Mass().extend(effects.TorqueGain(-1)), "actuator -1, but Mass has: 0 (push)"),
    (lambda: ViscousFriction(tau_c=0.1), "has no parameter 'tau_c'. Its parameters are: b."),
)
def test_a_wrong_extension_is_refused_with_what_exists(make, message):
    with pytest.raises(EffectError, match=re.escape(message)):
        make()


def test_a_sensor_behind_another_measures_what_that_one_reports(x64):
    biased = effects.SensorBias("position", bias=3.0)
    halved = effects.SensorScale("position", scale=0.5)
    late = effects.SensorDelay("position", delay=0.1)
    true = np.maximum(0.1 * np.arange(11) - 0.1, 0.0)  # 1 m/s, one sample ago

    for order, expected in (
        ((biased, late, halved), 0.5 * (true + 3.0)),
        ((halved, biased, late), 0.5 * true + 3.0),
    ):
        obs = moved(Mass().extend(*order), np.zeros(10), position=expected[0], speed=1.0).obs
        np.testing.assert_allclose(obs[:, 0], expected, rtol=1e-12, atol=1e-12)
