"""The contract that every twin keeps. A new twin is tested by being registered."""

import functools
import json
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import small_robots as robots
from cases import each
from jax.flatten_util import ravel_pytree

from sb3_hds import effects, twins
from sb3_hds.core import AnalyticTwin, ExtendedTwin
from sb3_hds.errors import ParameterError
from sb3_hds.twins.mujoco.engine.twin import EngineTwin

# Every twin that has a name, and one that is made of a model file.
PLAIN = [twins.make(name) for name in twins.names()] + [
    # Delays are no multiple of its step, where their derivative is one-sided.
    twins.from_mujoco(robots.compiled(robots.chain(2), timestep=0.0023))
]
# One of each kind: forces, a command with memory, a delay. Every effect has its own tests.
ATTACHED = (effects.CoulombFriction, effects.QuadraticDrag, effects.TorqueGain, effects.MotorLag)


def sizes_of(kind):
    return {name: p.null + 0.7 * p.scale for name, p in kind.parameters.items()}


EXTENDED = twins.make("Pendulum").extend(
    *(kind(0, **sizes_of(kind)) for kind in (*ATTACHED, effects.ActionDelay))
)
name_of = {"ids": lambda twin: twin.name + "+" * isinstance(twin, ExtendedTwin)}
every_twin = pytest.mark.parametrize("twin", [*PLAIN, EXTENDED], **name_of)


def with_settings(twin, **settings):
    return type(twin)(**twin.to_spec()["options"] | settings)


def an_action(twin, share=0.65):
    """A command inside its limits, and not in the middle."""
    limits = [(max(a.low, -1.0), min(a.high, 1.0)) for a in twin.actuators]
    return jnp.array([low + share * (high - low) for low, high in limits])


@functools.partial(jax.jit, static_argnums=0)
def step(twin, states, action, params):
    """Of several states at once: compiled once for all tests of a twin."""
    return jax.vmap(twin.step, (0, None, None))(states, action, params)


@functools.cache
def starts_of(twin):
    keys = jax.random.split(jax.random.key(0), 100)
    return jax.jit(jax.vmap(lambda key: twin.initial(key, twin.params)))(keys)


@functools.cache
def states_in_motion(twin):
    """Two of them, away from clips: shortly after the start of an episode."""
    states = jax.tree.map(lambda leaf: leaf[:2], starts_of(twin))
    for _ in range(max(3, round(0.05 / twin.dt))):
        states = step(twin, states, an_action(twin), twin.params)
    return states


def row(tree, i=0):
    return jax.tree.map(lambda leaf: leaf[i], tree)


def a_state(twin):
    return row(states_in_motion(twin))


def flat(tree):
    return np.asarray(ravel_pytree(tree)[0])


@every_twin
def test_an_episode_starts_alive_within_bounds_and_is_drawn_as_a_line_that_moves(twin, x64):
    starts = starts_of(twin)

    @jax.jit
    @jax.vmap
    def seen(state):
        over, other = twin.terminated(state, twin.params), row(starts)
        again = twin.retract(other, twin.difference(state, other))
        return twin.observe(state, twin.params), twin.sketch(state, twin.params), over, again

    obs, sketches, over, again = jax.tree.map(np.asarray, seen(starts))

    assert not over.any() and np.ptp(starts.q, 0).max() > 0.0
    assert np.all(obs >= [channel.low for channel in twin.channels])
    assert np.all(obs <= [channel.high for channel in twin.channels])
    assert sketches.ndim == 3 and sketches.shape[2] == 2 and np.isfinite(sketches).all()
    moving = twin.sketch(a_state(twin), twin.params)
    assert not np.allclose(moving, sketches[0])
    # What an engine has read belongs to no tangent.
    parts = 2 if isinstance(twin, EngineTwin) else 3
    np.testing.assert_allclose(
        flat(again[:parts]), flat(starts[:parts]), 0.0, 1e-14
    )  # one rounding


@each(twins.make("InvertedDoublePendulum"), PLAIN[-1], EXTENDED, **name_of)
def test_a_compiled_batch_of_steps_equals_a_plain_one(twin, x64):
    states, action = states_in_motion(twin), an_action(twin)

    batched = step(twin, states, action, twin.params)
    with jax.disable_jit():
        plain = twin.step(row(states, 1), action, twin.params)

    # Fusing reorders sums: a few roundings of 1e-16 at speeds up to 10, through a 3 x 3 solve.
    np.testing.assert_allclose(flat(row(batched, 1)), flat(plain), rtol=1e-12, atol=1e-12)


def motion(twin, state, action):
    """The next state and observation by small changes of state, action and parameters in scales."""
    scales = {name: parameter.scale for name, parameter in twin.parameters.items()}

    def moved(change):
        tangent, push, shift = change
        params = {name: twin.values[name] + shift[name] * scales[name] for name in scales}
        after = twin.step(twin.retract(state, tangent), action + push, params)
        return twin.difference(after, state), twin.observe(after, params)

    nothing = jnp.zeros_like(twin.difference(state, state))
    return moved, (nothing, jnp.zeros_like(action), {name: jnp.asarray(0.0) for name in scales})


def random_like(tree, seed=0):
    leaves, structure = jax.tree.flatten(tree)
    rng = np.random.default_rng(seed)
    return structure.unflatten(jnp.asarray(rng.normal(size=leaf.shape)) for leaf in leaves)


@every_twin
def test_the_derivative_of_a_step_equals_a_finite_difference(twin, x64):
    """With respect to state, action and every parameter at once, in three directions."""
    moved, here = motion(twin, a_state(twin), an_action(twin))
    width = 3e-6

    @jax.jit
    def forward(direction):
        ahead = moved(jax.tree.map(lambda d: width * d, direction))
        behind = moved(jax.tree.map(lambda d: -width * d, direction))
        difference = jax.tree.map(lambda a, b: (a - b) / (2.0 * width), ahead, behind)
        return difference, jax.jvp(moved, (here,), (direction,))[1]

    for seed in range(3):
        difference, derivative = forward(random_like(here, seed))
        # Central differences over 3e-6: truncation 1e-11 and rounding 3e-11, times derivatives of
        # up to 1e4, for dry friction changes direction within 0.01. Engines take one-sided ones
        # over 1e-6, with an error of half of that times the curvature, large where contacts begin.
        error = 1e-6
        if isinstance(twin, EngineTwin):
            # Derivatives of what an engine reads are those of its next state.
            difference, derivative, error = difference[0], derivative[0], 1e-2
        np.testing.assert_allclose(flat(derivative), flat(difference), rtol=error, atol=error)


@every_twin
def test_reverse_mode_is_the_transpose_of_forward_mode(twin, x64):
    moved, here = motion(twin, a_state(twin), an_action(twin))
    if twin.name != "MountainCar" and twin is not EXTENDED:
        # It takes long to compile, but for one with clips and one with effects: what cannot be
        # transposed fails while it is traced.
        weights = jax.eval_shape(moved, here)
        jax.eval_shape(lambda weights: jax.vjp(moved, here)[1](weights), weights)
        return
    direction = random_like(here)

    ahead = jax.jit(lambda d: jax.jvp(moved, (here,), (d,))[1])(direction)
    weights = random_like(ahead, seed=1)
    (back,) = jax.jit(lambda w: jax.vjp(moved, here)[1](w))(weights)

    # <w, J d> = <J^T w, d>; rounding only.
    assert flat(weights) @ flat(ahead) == pytest.approx(flat(back) @ flat(direction), rel=1e-9)


@every_twin
def test_values_act_only_through_params_and_make_no_other_program(twin, x64):
    name, parameter = next(iter(twin.parameters.items()))
    changed = twin.with_parameters(**{name: twin.values[name] + parameter.scale})
    states, action = states_in_motion(twin), an_action(twin)

    assert changed == twin and hash(changed) == hash(twin) and changed.values != twin.values
    same = step(changed, states, action, twin.params)
    other = step(changed, states, action, changed.params)
    before = flat(step(twin, states, action, twin.params))
    np.testing.assert_array_equal(flat(same), before)
    assert np.abs(flat(other) - before).max() > 1e-9
    if twin is not EXTENDED:
        assert with_settings(twin, dt=2.0 * twin.dt) != twin
        assert with_settings(twin, substeps=twin.substeps + 1) != twin


@every_twin
def test_a_twin_survives_being_written_down_and_refuses_what_it_cannot_be(twin):
    changed = {name: twin.values[name] + 0.5 * p.scale for name, p in twin.parameters.items()}
    changed = twin.with_parameters(**changed)

    again = twins.from_spec(json.loads(json.dumps(changed.to_spec())), effects.ALL)

    assert again == changed and again.values == changed.values
    for name, parameter in twin.parameters.items():
        assert parameter.unit and parameter.lower <= twin.values[name] <= parameter.upper
    name, parameter = next((n, p) for n, p in twin.parameters.items() if p.lower > -math.inf)
    for value in (parameter.lower - 1.0, math.nan):
        with pytest.raises(ParameterError, match=rf"{name}.*within \[{parameter.lower}, "):
            twin.with_parameters(**{name: value})
    with pytest.raises(ParameterError, match=f"{twin.name} has no parameter 'weight'"):
        twin.with_parameters(weight=1.0)


@pytest.mark.parametrize("twin", [t for t in PLAIN if t.env_id], ids=lambda twin: twin.name)
def test_planning_has_something_to_climb(twin, x64):
    state, action = a_state(twin), an_action(twin)

    @jax.jit
    @jax.jacfwd
    def climb(change):
        tangent, push = change
        start = twin.retract(state, tangent)
        after = twin.step(start, action + push, twin.params)
        steps = (start, action + push, after, twin.params)
        return twin.planning_reward(*steps), twin.reward(*steps)

    nothing = jnp.zeros_like(twin.difference(state, state))
    to_plan, to_report = climb((nothing, jnp.zeros_like(action)))

    assert np.abs(flat(to_plan)).max() > 1e-3 and np.all(np.isfinite(flat(to_plan)))
    assert (np.abs(to_report[0]).max() > 1e-3) == twin.reward_has_gradient


def damping_of(twin):
    """Parameters that are damping of a joint, by its number."""
    native = twin.native_effects.items()
    return {i: targets["b"] for (kind, i), targets in native if kind == "viscous_friction"}


# All but the payload's, whose drive makes up for the damping that it knows of, and those of model
# files and engines, which take it at the end of a step.
DAMPED = [
    twin
    for twin in PLAIN[:-1]
    if isinstance(twin, AnalyticTwin) and damping_of(twin) and twin.name != "PayloadPendulum"
]


@pytest.mark.parametrize("twin", DAMPED, **name_of)
def test_friction_on_damped_joints_equals_a_force_of_its_own(twin, x64):
    """The native parameter and the force are the same physics at every Runge-Kutta stage."""

    class Undamped(type(twin)):
        native_effects = {}

    sizes = {i: twin.parameters[name].scale for i, name in damping_of(twin).items()}
    frictions = [effects.ViscousFriction(i, b=b) for i, b in sizes.items()]
    native, forced = twin.extend(*frictions), Undamped().extend(*frictions)
    states, action = states_in_motion(twin), an_action(twin)

    def stepped(extended):
        memory = extended.infer(twin.observe(row(states), twin.params), extended.params).memory
        memory = jax.tree.map(lambda leaf: jnp.stack([leaf] * 2), memory)
        return step(extended, states._replace(memory=memory), action, extended.params)[:2]

    by_parameter, by_force, without = map(stepped, (native, forced, twin))

    assert all(native.params[name] == twin.params[name] for name in damping_of(twin).values())
    # The same sum in another order.
    np.testing.assert_allclose(flat(by_parameter), flat(by_force), rtol=1e-12, atol=1e-12)
    assert (np.abs(by_parameter[1] - without[1]).min(0)[list(sizes)] > 1e-7).all()


def test_layers_have_the_forces_and_effects_of_the_twin_inside():
    plain = twins.make("DoublePendulum")
    extended = plain.extend(effects.CoulombFriction(0))

    assert max(plain.typical_forces()) > 1.0
    assert extended.typical_forces() == plain.typical_forces()
    assert extended.native_effects == plain.native_effects != {}
