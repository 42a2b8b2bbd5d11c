"""The core: parameters, integrators, linear algebra, twins and their wrappers, rollouts."""

import json
import re

import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from cases import each
from free_mass import Mass

from sb3_hds import effects, twins
from sb3_hds.core import (
    Actuator,
    EffectChain,
    ExtendedTwin,
    Moment,
    Parameter,
    RescaleAction,
    RescaleObservation,
    State,
    TransformedTwin,
    explicit_euler,
    rk4,
    rollout,
    rollout_policy,
    semi_implicit_euler,
    solve_spd,
)
from sb3_hds.core.effect import at_joint
from sb3_hds.core.effect_chain import Attached
from sb3_hds.effects import DeadZone, TorqueGain
from sb3_hds.errors import EffectError, ParameterError


class Slider(Mass):
    """A mass on a rail with a spring; an episode ends at ``end``, each of its steps earns 1."""

    name = "Slider"
    actuators = (Actuator("push", "N", -1.0, 1.0),)
    parameters = Mass.parameters | {"stiffness": Parameter(null=0.0, scale=1.0, unit="N/m")}
    options = {"end": 0.95}

    def bias(self, q, v, params):
        return params["stiffness"] * q

    def reward(self, state, action, next_state, params):
        return jnp.ones(())

    def planning_reward(self, state, action, next_state, params):
        return next_state.q[0]

    def terminated(self, state, params):
        return state.q[0] > self.end


def kilograms(**settings):
    return Parameter(**{"null": 0.0, "scale": 1.0, "unit": "kg"} | settings)


def behind(**wrappers):
    return TransformedTwin(Slider(), **wrappers)


FLIPPED = {"transforms": [[{"transform": "flip"}]]}


@each(
    (lambda: kilograms(scale=0.0), "scale must be positive, got 0.0 kg"),
    (lambda: kilograms(null=-1.0, lower=0.0), "null value, -1.0 kg, must lie within"),
    (lambda: Slider(mass="heavy"), "'mass' must be a number [kg], got 'heavy'"),
    (lambda: Slider(mass=0.0), "'mass' must be finite and within [0.1, inf] kg, got 0.0"),
    (lambda: Slider().with_parameters(stiffness=float("nan")), "[-inf, inf] N/m, got nan"),
    (lambda: Slider(lenght=1.0), "no parameter 'lenght'. Its parameters are: mass, damp"),
    (lambda: Slider(substeps=0), "needs a finite dt > 0 s and at least one sub-step"),
    (lambda: RescaleAction(1.0, 1.0), "needs finite bounds with low < high"),
    (lambda: behind(action=RescaleAction((-1.0, -1.0), 1.0)), "has bounds for 2 actuators"),
    (lambda: behind(observation=RescaleObservation()), "these have none: position, speed"),
    (lambda: twins.from_spec(Slider().to_spec() | FLIPPED), "flip"),
)
def test_an_impossible_value_is_refused_with_name_unit_and_bounds(make, message, monkeypatch):
    monkeypatch.setitem(twins.registry._TWINS, "Slider", Slider)
    with pytest.raises(ParameterError, match=re.escape(message)):
        make()
    assert Parameter(0.0, 0.05, "N m s/rad").prismatic() == Parameter(0.0, 0.05, "N s/m")


_SYSTEM = np.array([[0.0, 1.0], [-4.0, -0.3]])  # dq/dt = v, dv/dt = -4 q - 0.3 v


def integrate(integrator, h, duration=2.0):
    def acceleration(q, v):
        return -4.0 * q - 0.3 * v

    def step(_, state):
        return integrator(acceleration, *state, h, lambda v: v)

    n_steps = round(duration / h)
    return np.concatenate(jax.lax.fori_loop(0, n_steps, step, (jnp.ones(1), jnp.zeros(1))))


@each((explicit_euler, 1), (semi_implicit_euler, 1), (rk4, 4))
def test_the_error_falls_with_the_order_of_the_integrator(integrator, order, x64):
    steps = 2.0 / np.array([40, 80, 160])
    exact = scipy.linalg.expm(2.0 * _SYSTEM) @ [1.0, 0.0]

    errors = [np.linalg.norm(integrate(integrator, h) - exact) for h in steps]

    slope = np.polyfit(np.log(steps), np.log(errors), 1)[0]
    assert slope == pytest.approx(order, abs=0.15)  # terms of the next order bend the line


def spd(rng, n, batch):
    root = rng.normal(size=(batch, n, n))
    return root @ root.transpose(0, 2, 1) + n * np.eye(n)


@pytest.mark.parametrize(("n", "columns"), [(1, ()), (2, (3,)), (6, ()), (12, (3,)), (20, (2,))])
def test_a_batch_of_small_systems_is_solved_as_lapack_does(x64, n, columns):
    rng = np.random.default_rng(n)
    matrices, right = spd(rng, n, 20), rng.normal(size=(20, n, *columns))

    ours = jax.jit(jax.vmap(solve_spd))(jnp.asarray(matrices), jnp.asarray(right))

    theirs = np.linalg.solve(matrices, right if columns else right[..., None])
    # The matrices are conditioned better than 1e2, so 1e-12 leaves rounding a factor of 100.
    np.testing.assert_allclose(ours, theirs.reshape(ours.shape), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("n", [2, 12, 16])
def test_programs_that_solve_up_to_sixteen_rows_may_run_at_once(n):
    """LAPACK waits for threads that another program may hold."""
    given = jnp.zeros((8, n, n)), jnp.zeros((8, n))
    program = jax.jit(jax.vmap(solve_spd)).lower(*given).compile().as_text()
    assert "custom-call" not in program


def test_the_derivative_of_a_solution_is_the_implicit_one(x64):
    n, rng = 6, np.random.default_rng(6)
    matrix, change = spd(rng, n, 2)
    right, shift = rng.normal(size=(2, n))

    _, ours = jax.jvp(solve_spd, (matrix, right), (change, shift))
    pulled = jax.grad(lambda b: solve_spd(jnp.asarray(matrix), b).sum())(jnp.asarray(right))

    x = np.linalg.solve(matrix, right)
    expected = np.linalg.solve(matrix, shift - change @ x)  # d(A^-1 b) = A^-1 (db - dA A^-1 b)
    np.testing.assert_allclose(ours, expected, rtol=1e-11)  # rounding, as above
    np.testing.assert_allclose(pulled, np.linalg.inv(matrix).sum(0), rtol=1e-11)


def test_a_least_pivot_replaces_a_negative_one_and_leaves_good_ones(x64):
    indefinite, right = jnp.diag(jnp.array([2.0, -1.0])), jnp.ones(2)
    np.testing.assert_allclose(solve_spd(indefinite, right, min_pivot=0.1), [0.5, 10.0])


def test_the_inertia_of_a_joint_is_what_a_force_there_accelerates(x64):
    matrix = spd(np.random.default_rng(0), 3, 1)[0]
    moment = Moment(*[jnp.zeros(3)] * 4, jnp.asarray(matrix), 0.1)
    inertia = [at_joint(moment, joint).inertia for joint in range(3)]
    np.testing.assert_allclose(inertia, 1.0 / np.diag(np.linalg.inv(matrix)), rtol=1e-12)


def test_a_command_meets_effects_in_order_and_a_joined_chain_last(x64):
    params = {"torque_gain.push.gain": 3.0, "dead_zone.push.width": 2.0}
    gain, dead = (Attached(f"{e.name}.push", e, 0) for e in (TorqueGain(), DeadZone()))
    memory = {gain.key: (), dead.key: ()}

    def command(chain):
        return float(chain.act(jnp.full(1, 2.0), memory, 0.1)[0][0])

    assert command(EffectChain((gain, dead), params)) == 5.0
    assert command(EffectChain((dead, gain), params)) == 3.0
    assert command(EffectChain((dead,), params) + EffectChain((gain,), params)) == 3.0


def test_a_transformed_twin_reproduces_the_wrapped_environment(x64):
    env = gym.wrappers.RescaleAction(gym.make("Pendulum-v1"), np.float32(-1.0), np.float32(3.0))
    low, high = np.array([-2.0, -1.0, 0.0], np.float32), np.array([2.0, 0.0, 1.0], np.float32)
    env = gym.wrappers.RescaleObservation(env, low, high)
    observation, action = RescaleObservation(low.tolist(), high.tolist()), RescaleAction(-1.0, 3.0)
    twin = TransformedTwin(twins.make("Pendulum"), observation=observation, action=action)
    obs, _ = env.reset(seed=0)
    env.action_space.seed(0)

    @jax.jit
    def go(obs, action):
        state = twin.infer(obs, twin.params)
        after = twin.step(state, action, twin.params)
        reward = twin.reward(state, action, after, twin.params)
        return twin.observe(state, twin.params), twin.observe(after, twin.params), reward

    for _ in range(200):
        action = env.action_space.sample()
        again, seen, ours = go(jnp.asarray(obs, jnp.float64), jnp.asarray(action, jnp.float64))
        # What is observed through a wrapper is inferred through it, but for arctan2 of float32.
        np.testing.assert_allclose(again, obs, atol=1e-6)
        obs, reward, *_ = env.step(action)
        # One step from a float32 observation: rounding 6e-8 of a speed of 8, torque likewise; the
        # reward squares an angle of up to pi and a speed of up to 8.
        np.testing.assert_allclose(seen, obs, atol=2e-6)
        assert float(ours) == pytest.approx(reward, abs=2e-5)
    np.testing.assert_allclose([a.low for a in twin.actuators], env.action_space.low)
    np.testing.assert_allclose([c.high for c in twin.channels], env.observation_space.high)
    assert {a.unit for a in twin.actuators} == {c.unit for c in twin.channels} == {"1"}


def test_effects_attach_to_the_plant_below_the_wrapper(x64):
    wrapper = RescaleAction(-0.5, 0.5)  # Slider takes -1 to 1 N
    inside = TransformedTwin(Slider().extend(DeadZone(width=0.1)), action=wrapper)

    outside = behind(action=wrapper).extend(DeadZone(width=0.1))

    assert outside == inside and outside.params == inside.params
    state = outside.infer(jnp.zeros(2), outside.params)
    after = outside.step(state, jnp.full(1, 0.1), outside.params)
    assert float(after.v[0]) == pytest.approx(0.1 * (0.2 - 0.05), rel=1e-12)
    with pytest.raises(EffectError, match=re.escape("Use twin.extend(*effects), which does that")):
        ExtendedTwin(behind(action=wrapper), DeadZone())


def test_values_and_effects_survive_a_spec_through_wrappers():
    twin = TransformedTwin(twins.make("Pendulum", mass=2.0), action=RescaleAction(-1.0, 1.0))
    twin = TransformedTwin(twin, observation=RescaleObservation((0.0, 0.0, -1.0), 1.0))
    twin = twin.extend(effects.CoulombFriction(tau_c=0.3)).with_parameters(gravity=9.0)

    back = twins.from_spec(json.loads(json.dumps(twin.to_spec())), effects.ALL)

    assert back == twin and back.params == twin.params and repr(back) == repr(twin)


def test_an_effect_is_taken_away_again_and_the_rest_keeps_its_values():
    base = Slider().with_parameters(mass=2.0)
    one = base.extend(effects.ViscousFriction(b=0.3))
    gain, friction = "torque_gain.push", "viscous_friction.rail"
    both = one.extend(TorqueGain(gain=0.5))

    assert both.without(gain).to_spec() == one.to_spec()
    assert both.without(gain, friction).to_spec() == base.to_spec()
    seen = TransformedTwin(both, action=RescaleAction(-1.0, 1.0))
    assert seen.without(gain).base.to_spec() == one.to_spec()
    for twin in (one, base):
        with pytest.raises(EffectError, match=r"no effect torque_gain\.push attached"):
            twin.without(gain)


def test_a_rollout_is_a_loop_of_steps(x64):
    twin = twins.make("Pendulum")
    actions = jnp.asarray(np.random.default_rng(0).uniform(-2, 2, (30, 1)))
    start = state = twin.initial(jax.random.key(0), twin.params)

    @jax.jit
    def go(state, action):
        after = twin.step(state, action, twin.params)
        reward = twin.reward(state, action, after, twin.params)
        return after, twin.observe(state, twin.params), reward

    result = rollout(twin, twin.params, start, actions)

    assert result.obs.shape == (31, 3) and result.rewards.shape == (30,) and result.alive.all()
    np.testing.assert_array_equal(result.actions, actions)
    for k, action in enumerate(actions):
        np.testing.assert_allclose(result.states.q[k], state.q, atol=1e-12)  # other fusion
        state, obs, reward = go(state, action)
        np.testing.assert_allclose(result.obs[k], obs, atol=1e-12)
        assert float(result.rewards[k]) == pytest.approx(float(reward), rel=1e-10)
    np.testing.assert_allclose(result.obs[-1], twin.observe(state, twin.params), atol=1e-12)


def test_rewards_stop_with_the_step_that_terminates(x64):
    # At 1 m/s and 0.1 s the mass passes 0.95 m in the tenth step.
    twin, over = Slider(), State(jnp.ones(1), jnp.zeros(1), {})
    begin = State(jnp.zeros(1), jnp.ones(1), {})
    result = rollout(twin, twin.params, begin, jnp.zeros((15, 1)))
    planned = rollout(twin, twin.params, begin, jnp.zeros((5, 1)), twin.planning_reward)
    ended = rollout(twin, twin.params, over, jnp.ones((3, 1)))

    assert result.rewards.tolist() == [1.0] * 10 + [0.0] * 5
    assert result.alive.tolist() == [True] * 10 + [False] * 5
    np.testing.assert_allclose(result.states.q[:, 0], [0.1 * min(k, 10) for k in range(16)])
    np.testing.assert_allclose(planned.rewards, 0.1 * np.arange(1, 6))
    assert not ended.alive.any() and not ended.rewards.any()
    np.testing.assert_array_equal(ended.states.q, jnp.ones((4, 1)))


def test_what_comes_after_the_end_cannot_spoil_a_gradient(x64):
    # Pushed away from the middle, the position multiplies by about 1e5 per step: inf soon after.
    twin = Slider(stiffness=-1e7)

    def earned(speed):
        state = State(jnp.zeros(1), speed * jnp.ones(1), {})
        still = jnp.zeros((100, 1))
        return rollout(twin, twin.params, state, still, twin.planning_reward).rewards.sum()

    value, slope = jax.value_and_grad(earned)(1e-6)

    assert float(slope) == pytest.approx(float(value) / 1e-6, rel=1e-9)  # linear in the speed


def test_a_policy_sees_what_the_sensors_report(x64):
    twin = twins.make("Pendulum")
    state = twin.initial(jax.random.key(1), twin.params)

    closed = rollout_policy(twin, twin.params, state, lambda obs: -0.5 * obs[2:3], 40)
    opened = rollout(twin, twin.params, state, closed.actions)

    np.testing.assert_allclose(closed.actions, -0.5 * closed.obs[:-1, 2:3], atol=1e-12)
    # The same 40 steps in another program: rounding, amplified by a swinging pendulum.
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-10), closed, opened)
