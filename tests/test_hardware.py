"""The stand-ins for hardware: independent of the twins, and as their arguments say."""

import functools

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import each
from gymnasium.utils.env_checker import check_env as check_gymnasium
from stable_baselines3.common.env_checker import check_env as check_sb3

from sb3_hds import envs, twins
from sb3_hds.core import State, rollout

PENDULUM, CART = "sb3_hds/PendulumReal-v1", "sb3_hds/InvertedPendulumFriction-v5"
BOTH = pytest.mark.parametrize("env_id", [PENDULUM, CART])


def driven(env, actions, state):
    """True positions and velocities along an episode, shape ``(T + 1, 2 dof)``."""
    env.reset(seed=0)
    bare = env.unwrapped
    bare.data.qpos[:], bare.data.qvel[:] = state
    path = [np.concatenate([bare.data.qpos, bare.data.qvel])]
    for action in actions:
        env.step(action)
        path.append(np.concatenate([bare.data.qpos, bare.data.qvel]))
    return np.array(path)


def simulated(twin, actions, state):
    return np.concatenate(_path(twin, twin.params, actions, *np.asarray(state, np.float64)), 1)


@functools.partial(jax.jit, static_argnums=0)
def _path(twin, params, actions, q, v):
    start = twin.infer(twin.observe(State(q, v, {}), params), params)
    path = rollout(twin, params, start._replace(q=q, v=v), actions).states
    return path.q, path.v


def commands(env, n_steps, seed=0):
    high = env.action_space.high
    return 0.4 * np.random.default_rng(seed).uniform(-high, high, (n_steps, len(high)))


def start_of(env_id):
    pendulum = (np.array([2.0]), np.array([0.5]))
    return pendulum if env_id == PENDULUM else (np.array([0.0, 3.0]), np.zeros(2))


def made(env_id, **settings):
    return gymnasium.make(env_id, **settings, **({"swing_up": True} if env_id == CART else {}))


@BOTH
def test_both_checkers_accept_them(env_id):
    env = gymnasium.make(env_id).unwrapped
    check_gymnasium(env, skip_render_check=True)
    check_sb3(env, skip_render_check=True)


@each({}, {"mass": 1.3, "length": 0.6, "gravity": 9.81, "damping": 0.1, "dt": 0.02})
def test_the_pendulums_twin_follows_the_engine_to_a_millionth(settings, x64):
    env = gymnasium.make(PENDULUM, **settings)
    twin = twins.from_env(env)
    step = jax.jit(twin.step)
    actions = commands(env, 20)

    for seed in range(5):
        angle, speed = np.random.default_rng(seed).uniform([-3.0, -8.0], [3.0, 8.0])
        path = driven(env, actions, ([angle], [speed]))
        for before, after, action in zip(path[:-1], path[1:], actions, strict=True):
            state = State(jnp.asarray(before[:1]), jnp.asarray(before[1:]), {})
            predicted = step(state, jnp.asarray(action), twin.params)
            # Four Runge-Kutta steps of the twin against twenty of the engine.
            np.testing.assert_allclose(np.r_[predicted.q, predicted.v], after, rtol=0.0, atol=1e-6)


@each(
    (PENDULUM, {"damping": 0.2, "friction": 0.3, "drag": 0.1}, 0.02),
    (PENDULUM, {"gain": 0.7, "delay": 0.07, "lag": 0.08, "payload": 0.3}, 0.02),
    (CART, {"slider_damping": 5.0, "hinge_damping": 1.0}, 0.02),
    # MuJoCo's dry friction is a soft constraint, the twin's a smooth function of speed; the
    # engine steps by 20 ms, in which either stops it.
    (CART, {"slider_friction": 20.0}, 0.06),
)
def test_the_truth_is_far_closer_than_the_data_sheet(env_id, hidden, share, x64):
    env = made(env_id, **hidden)
    actions, state = commands(env, 15), start_of(env_id)
    truth = driven(env, actions, state)

    known, nominal = (
        np.abs(simulated(twin, actions, state) - truth).max()
        for twin in (envs.true_twin(env), twins.from_env(env))
    )

    assert known < share * np.ptp(truth) and nominal > 4.0 * known


def test_the_nominal_cart_follows_the_engine_to_the_ends_of_its_rail(x64):
    env = gymnasium.make(CART, swing_up=True)
    twin, actions, state = twins.from_env(env), commands(env, 10), start_of(CART)
    fast, push = (np.array([0.9, np.pi]), np.array([2.0, 0.0])), np.full((10, 1), 0.5)

    truth, at_end = driven(env, actions, state), driven(env, push, fast)

    np.testing.assert_allclose(simulated(twin, actions, state), truth, rtol=0.0, atol=1e-9)
    assert at_end[:, 0].max() > 1.0
    assert np.abs(simulated(twin, push, fast)[:, 0] - at_end[:, 0]).max() < 0.03
    assert driven(gymnasium.make(CART, swing_up=True, rail_ends=False), push, fast)[-1, 0] > 1.2


def test_a_swing_up_begins_hanging_at_rest_and_rewards_being_upright_most():
    env = gymnasium.make(CART, swing_up=True).unwrapped
    starts = np.array([env.reset(seed=seed)[0] for seed in range(20)])
    angles, rewards = np.linspace(-np.pi, np.pi, 33), []
    for angle in angles:
        env.set_state(np.array([0.0, angle]), np.zeros(2))
        rewards.append(env.step(np.zeros(1))[1])

    # The environment's noise of a start state is uniform within 0.01 [m, rad, m/s, rad/s].
    assert np.abs(starts - [0.0, -1.0, 0.0, 0.0, 0.0]).max() <= 0.01 and (starts.std(0) > 0).all()
    assert angles[np.argmax(rewards)] == pytest.approx(0.0)
    assert abs(angles[np.argmin(rewards)]) == pytest.approx(np.pi)


@BOTH
def test_rewards_are_those_of_the_twin(env_id, x64):
    env = made(env_id)
    twin, bare = twins.from_env(env), env.unwrapped
    step = jax.jit(twin.step)
    env.reset(seed=1)
    for action in commands(env, 10):
        state = State(jnp.array(bare.data.qpos), jnp.array(bare.data.qvel), {})
        reward = env.step(action)[1]
        after = step(state, jnp.asarray(action), twin.params)
        expected = twin.reward(state, jnp.asarray(action), after, twin.params)
        assert reward == pytest.approx(float(expected), abs=1e-5)


@BOTH
def test_noise_has_the_size_asked_for_and_follows_the_seed(env_id):
    still, noisy = gymnasium.make(env_id).unwrapped, gymnasium.make(env_id, noise=0.1).unwrapped
    errors = []
    for seed in range(60):
        errors.append(noisy.reset(seed=seed)[0] - still.reset(seed=seed)[0])

    assert np.std(errors) == pytest.approx(0.1, rel=0.15)
    np.testing.assert_array_equal(noisy.reset(seed=3)[0], noisy.reset(seed=3)[0])


def test_a_payload_may_come_between_two_steps():
    env = gymnasium.make(PENDULUM).unwrapped
    env.reset(options={"state": (1.0, 0.0)})
    env.set_payload(1.0)

    assert env.data.qpos[0] == 1.0
    env.step(np.zeros(1))
    # (m / 2 + p) g sin / (m / 3 + p) l, over one interval of 0.05 s.
    assert env.data.qvel[0] == pytest.approx(0.05 * 15.0 * np.sin(1.0) / (4.0 / 3.0), rel=0.01)


@each(
    (lambda: gymnasium.make(PENDULUM, mass=0.0), "mass must be finite, above 0"),
    (lambda: gymnasium.make(PENDULUM, friction=-0.1), "friction must be finite, at least 0"),
    (lambda: gymnasium.make(PENDULUM, delay=0.5), "at most 0.2"),
    (lambda: envs.true_twin(gymnasium.make("Pendulum-v1")), r"twins\.make"),
    (lambda: gymnasium.make(PENDULUM).unwrapped.reset(options={"angle": 1.0}), "'state'"),
    (lambda: driven(gymnasium.make(PENDULUM), [[np.nan]], start_of(PENDULUM)), "one finite"),
)
def test_impossible_hardware_is_refused(attempt, says):
    with pytest.raises((ValueError, TypeError, gymnasium.error.Error), match=says):
        attempt()


def euler(start, torques, shifted=False):
    """
    Where the steps of Pendulum-v1 lead, without its limit of the speed.

    Angles at whole steps and speeds at half ones are a leapfrog, of second order: Euler's steps are
    that, with speeds and torques half a step too late.
    """
    dt, (angle, speed) = 0.05, start
    accelerated = lambda angle, torque: 15.0 * np.sin(angle) + 3.0 * torque  # noqa: E731
    before = torques[0]
    if shifted:
        speed -= 0.5 * dt * accelerated(angle, torques[0])
    for torque in torques:
        acting = 0.5 * (before + torque) if shifted else torque
        speed += dt * accelerated(angle, acting)
        angle += dt * speed
        before = torque
    if shifted:
        speed += 0.5 * dt * accelerated(angle, torques[-1])
    return np.array([angle, speed])


def test_the_steps_of_pendulum_v1_are_off_by_half_a_step_and_little_else(x64):
    env, slow = gymnasium.make(PENDULUM), ([1.0], [0.5])
    torques = commands(env, 5)
    np.testing.assert_allclose(
        euler(np.ravel(slow), torques[:, 0]),
        simulated(twins.make("Pendulum"), torques, slow)[-1],
        rtol=1e-9,
    )

    missed, missed_shifted, truth = [], [], []
    for seed in range(200):
        start = np.random.default_rng(seed).uniform([-3.0, -8.0], [3.0, 8.0])
        torques = 2.5 * commands(env, 20, seed)
        truth.append(driven(env, torques, (start[:1], start[1:])))
        missed.append(euler(start, torques[:, 0]) - truth[-1][-1])
        missed_shifted.append(euler(start, torques[:, 0], shifted=True) - truth[-1][-1])

    scale = np.std(truth, (0, 1))
    of = lambda missed: np.sqrt(np.mean((np.array(missed) / scale) ** 2))  # noqa: E731
    share, share_shifted = of(missed), of(missed_shifted)
    # After a second, from all angles and speeds up to 8 rad/s, in shares of the scale of both.
    assert share == pytest.approx(0.17, abs=0.01) and share_shifted < 0.01
