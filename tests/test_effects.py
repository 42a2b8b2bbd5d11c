"""The contract every effect keeps. What each of them does is in ``test_effects_*.py``."""

import functools
import json
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import small_robots as robots
from free_mass import Mass, moved

from sb3_hds import effects, twins
from sb3_hds.core import EffectChain, ForceEffect, Parameter, State, rollout
from sb3_hds.effects import CoulombFriction, ViscousFriction
from sb3_hds.errors import EffectError, ParameterError

pytestmark = pytest.mark.usefixtures("quick_compilation")


class DampedMass(Mass):
    """The same, declaring that viscous friction is what it calls damping."""

    native_effects = {("viscous_friction", 0): {"b": "damping"}}


PLACES = {"joint": "joints", "actuator": "actuators", "channel": "channels"}
ENTRIES = (*effects.ALL, *effects.NAMELESS)
every_entry = pytest.mark.parametrize("effect", ENTRIES, ids=lambda effect: effect.name)

# A cart-pole whose drive does not act on the hinge; one joint with clips and one long step; one
# without clips and with four Runge-Kutta steps; and one that is made of a model file, some of whose
# parameters effects are.
SYSTEMS = [
    "InvertedPendulum",
    *(
        pytest.param(name, marks=pytest.mark.expensive)
        for name in ("Pendulum", "PendulumReal", "Arm")
    ),
]
every_system = pytest.mark.parametrize("name", SYSTEMS)

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
# The limit hides how commands came about, and the flip has no slope: they are told apart alone.
APART = (effects.Saturation, effects.SignFlip)
TOGETHER = tuple(effect for effect in ENTRIES if effect not in APART)


@functools.cache
def made(name):
    if name != "Arm":
        return twins.make(name)
    # Delays are no multiple of its step, where their derivative is one-sided.
    return twins.from_mujoco(robots.compiled(robots.chain(2), timestep=0.0023), dt=0.023)


def with_all(twin, kinds, sized=False):
    """Each at the last place of its kind, at null or of a size."""
    last = {slot: len(getattr(twin, places)) - 1 for slot, places in PLACES.items()}
    return twin.extend(*(kind(last[kind.slot], **(sizes(kind) if sized else {})) for kind in kinds))


def sizes(effect, share=0.7):
    """Values off null, and off the grids of samples and sub-steps, where delays have a kink."""
    generic = {name: p.null + share * p.scale for name, p in effect.parameters.items()}
    return generic | SIZES.get(effect.name, {})


def sample_actions(twin, n):
    low, high = (np.array([getattr(a, end) for a in twin.actuators]) for end in ("low", "high"))
    share = np.random.default_rng(0).uniform(0.3, 0.7, (n, len(low)))
    return jnp.asarray(low + share * (high - low)) if np.isfinite(low).all() else share - 0.4


def replay(twin):
    state = twin.initial(jax.random.key(0), twin.params)
    simulate = jax.jit(rollout, static_argnums=0)
    return simulate(twin, twin.params, state, sample_actions(twin, 50)).obs


# --- the contract


@every_system
def test_the_whole_catalogue_at_null_changes_nothing(x64, name):
    """Neither what happens, nor what is reported of a state that was moved without its memory."""
    plain = made(name)
    everything = with_all(plain, ENTRIES)

    # Not bitwise: XLA fuses the two programs differently, and 50 steps of a system that falls over
    # amplify rounding of 1e-16 by up to 1e6.
    np.testing.assert_allclose(replay(everything), replay(plain), rtol=1e-9, atol=1e-9)
    start = everything.initial(jax.random.key(0), everything.params)
    elsewhere = start._replace(q=start.q + 0.1)
    np.testing.assert_array_equal(
        everything.observe(elsewhere, everything.params), plain.observe(elsewhere, plain.params)
    )


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

    return outcome, np.array([twin.params[key] for key in keys]), keys


def assert_gradient_is_that_of_finite_differences(twin):
    outcome, at, keys = outcome_of(twin)
    # Small in units of the parameter: a gap is 1e-4 rad here.
    steps = 1e-5 * np.minimum(1.0, np.where(at == 0.0, 1.0, np.abs(at)))

    points = at + np.concatenate([0.0 * np.diag(steps), np.diag(steps), -np.diag(steps)])

    along = jax.jit(jax.vmap(lambda point, way: jax.jvp(outcome, (point,), (way,))))
    values, slopes = along(jnp.asarray(points), jnp.tile(jnp.eye(len(at)), (3, 1)))
    _, ahead, behind = np.split(np.asarray(values), 3)
    differences = (ahead - behind) / (2.0 * steps[:, None])

    for key, slope, difference, step in zip(
        keys, np.asarray(slopes), differences, steps, strict=False
    ):
        # Central differences: rounding of 1e-13 / step, and a third derivative times step^2.
        np.testing.assert_allclose(slope, difference, 1e-5, 1e-13 / step, err_msg=key)
        name, _, parameter = key.split(".")
        assert np.any(slope != 0.0) == (f"{name}.{parameter}" not in WITHOUT_SLOPE), key


@every_system
def test_the_gradient_where_all_effects_act_at_once_is_that_of_finite_differences(x64, name):
    assert_gradient_is_that_of_finite_differences(with_all(made(name), TOGETHER, sized=True))


@pytest.mark.parametrize("effect", APART)
def test_so_is_the_gradient_of_what_hides_other_effects(x64, effect):
    assert_gradient_is_that_of_finite_differences(with_all(made("Pendulum"), [effect], sized=True))


@pytest.mark.parametrize("name", twins.names())
def test_effects_act_at_every_joint_and_actuator_of_every_twin(x64, name):
    plain, kinds = made(name), (effects.ViscousFriction, effects.TorqueGain)
    twin = plain.extend(
        *(kind(i) for kind in kinds for i in range(len(getattr(plain, PLACES[kind.slot]))))
    )
    outcome, null, _ = outcome_of(twin)

    slopes = jax.jit(jax.jacfwd(outcome))(null)

    assert slopes.any(0).all() and np.isfinite(slopes).all()


GROUPS = {
    slot: [effect for effect in ENTRIES if effect.__module__.endswith(slot)]
    for slot in ("joint", "position", "nameless", "transmission", "actuator", "sensor")
}


@pytest.mark.parametrize("group", GROUPS)
def test_derivatives_at_null_are_those_of_the_smallest_size_in_both_modes(group):
    """
    At rest without a command and in motion, of what a few steps lead to, by all that they depend
    on. Searches begin at null; where that is a bound, the slope is that to the side that is left.
    """
    kinds = GROUPS[group]
    twin = with_all(twins.make("Pendulum"), kinds)
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
        every = np.concatenate([points, (points[:2] + off).reshape(-1, points.shape[1])])
        values, forward, reverse = map(np.asarray, derivatives(jnp.asarray(every)))
    # The same derivative, summed in another order.
    np.testing.assert_allclose(forward, reverse, rtol=1e-9, atol=1e-11)
    felt = set()
    for i, key in enumerate(keys):
        name, slope = key.split(".")[0], forward[:2, :, i]
        felt |= {name} if slope.any() else set()
        if name not in JUMP_AT_NULL:
            # One-sided: rounding of 1e-15 / 1e-7, and a second derivative times 1e-7.
            difference = (values[6 + 2 * i : 8 + 2 * i] - values[:2]) / 1e-7
            np.testing.assert_allclose(slope, difference, 1e-4, 1e-5, err_msg=key)
    assert felt == {kind.name for kind in kinds} - JUMP_AT_NULL


@every_entry
def test_a_value_beyond_its_physical_bounds_is_refused(effect):
    twin = twins.Pendulum().extend(effect(0))
    for name, parameter in effect.parameters.items():
        if parameter.lower == -np.inf:
            continue
        low = parameter.lower - parameter.scale
        with pytest.raises(
            ParameterError, match=f"{effect.name}.{name}' must be finite and within"
        ):
            effect(0, **{name: low})
        full = next(key for key in twin.params if key.endswith(f".{name}"))
        with pytest.raises(ParameterError, match=re.escape(f"'{full}' must be finite and within")):
            twin.with_parameters(**{full: low})


@every_entry
def test_an_effect_says_what_it_is_and_where_it_comes_from(effect):
    assert re.fullmatch(r"[a-z][a-z_]*", effect.name)
    assert effect.explanation.endswith(".") and effect.explanation[0].isupper() and effect.source
    assert all(parameter.unit for parameter in effect.parameters.values())
    assert ".. math::" in effect.__doc__ and "Source:" in effect.__doc__
    assert [other.name for other in ENTRIES].count(effect.name) == 1


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


@every_entry
def test_an_effect_is_attached_once_by_name_or_index_and_survives_its_spec(effect):
    plain = twins.make("InvertedPendulum")
    place = getattr(plain, PLACES[effect.slot])[0].name
    twin = plain.extend(effect(0, **sizes(effect, 0.5)))

    back = twins.from_spec(json.loads(json.dumps(twin.to_spec())), effects.KNOWN)

    assert back == twin and hash(back) == hash(twin) and back.params == twin.params
    assert plain.extend(effect(place)).to_spec() == plain.extend(effect(0)).to_spec()
    for attach in (lambda: plain.extend(effect(0), effect(place)), lambda: twin.extend(effect(0))):
        with pytest.raises(EffectError, match=f"once at each place; {effect.name}.{place} came"):
            attach()


# --- composition


def test_units_follow_the_place():
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


def test_at_a_slider_no_unit_is_that_of_a_hinge():
    sliding = [effect for effect in ENTRIES if effect.slot == "joint"]
    twin = Mass().extend(*(effect(0) for effect in sliding))

    units = {key: parameter.unit for key, parameter in twin.parameters.items()}
    assert not [key for key, unit in units.items() if "rad" in unit or "N m" in unit]


def test_forces_of_several_effects_add_up(x64):
    twin = Mass(mass=2.0).extend(ViscousFriction(b=0.5), CoulombFriction(tau_c=0.3))
    state = twin.infer(jnp.array([0.0, 4.0]), twin.params)

    after = twin.step(state, jnp.ones(1), twin.params)

    # At 4 m/s the sign of dry friction is saturated to 1 - 2e-348.
    assert float(after.v[0]) == pytest.approx(4.0 + 0.1 / 2.0 * (1.0 - 0.5 * 4.0 - 0.3), rel=1e-14)


FORCES = (
    effects.CoulombFriction(0, tau_c=0.1),
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


@pytest.mark.parametrize("kept", [(), (0, 1), (1, 2, 3)], ids=str)
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
        (lambda: Mass().extend(ViscousFriction("hinge")), "joint 'hinge', but Mass has: 0 (rail)"),
        (lambda: Mass().extend(effects.SensorBias(2)), "Mass has: 0 (position), 1 (speed)"),
        (lambda: Mass().extend(effects.TorqueGain(-1)), "actuator -1, but Mass has: 0 (push)"),
        (lambda: ViscousFriction(tau_c=0.1), "has no parameter 'tau_c'. Its parameters are: b."),
    ],
)
def test_a_wrong_extension_is_refused_with_what_exists(make, message):
    with pytest.raises(EffectError, match=re.escape(message)):
        make()


# --- memory


@pytest.mark.parametrize("effect", GROUPS["sensor"], ids=lambda effect: effect.name)
def test_inferring_what_was_observed_at_the_start_is_the_start(x64, effect):
    twin = twins.Pendulum().extend(effect(0, **sizes(effect)))
    start = twin.initial(jax.random.key(3), twin.params)

    back = twin.infer(twin.observe(start, twin.params), twin.params)

    # arctan2 of cos and sin gives the angle back up to rounding.
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12), back, start)


def test_a_sensor_behind_another_measures_what_that_one_reports(x64):
    biased, halved = (
        effects.SensorBias("position", bias=3.0),
        effects.SensorScale("position", scale=0.5),
    )
    late = effects.SensorDelay("position", delay=0.1)
    true = np.maximum(0.1 * np.arange(11) - 0.1, 0.0)  # 1 m/s, one sample ago

    for order, expected in (
        ((biased, late, halved), 0.5 * (true + 3.0)),
        ((halved, biased, late), 0.5 * true + 3.0),
    ):
        obs = moved(Mass().extend(*order), np.zeros(10), position=expected[0], speed=1.0).obs
        np.testing.assert_allclose(obs[:, 0], expected, rtol=1e-12, atol=1e-12)


def test_memory_batches_and_keeps_the_precision_of_the_state(x64):
    twin = Mass().extend(
        effects.MotorLag(time_constant=0.2),
        effects.Hysteresis(**sizes(effects.Hysteresis)),
        effects.SensorDelay(0, delay=0.1),
    )
    obs = jnp.asarray(np.random.default_rng(0).normal(size=(4, 2)), jnp.float32)
    actions = jnp.ones((10, 1), jnp.float32)

    def simulate(obs):
        return rollout(twin, twin.params, twin.infer(obs, twin.params), actions)

    batch = jax.jit(jax.vmap(simulate))(obs)

    assert {leaf.dtype for leaf in jax.tree.leaves(batch.states)} == {jnp.dtype(jnp.float32)}
    np.testing.assert_allclose(batch.obs[2], jax.jit(simulate)(obs[2]).obs, rtol=1e-5)  # float32


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
