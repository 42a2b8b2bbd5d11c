"""Each twin against what it mirrors: step for step, and in what it reads from the environment."""

import math

import gymnasium
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from cases import each
from scipy.integrate import solve_ivp
from scipy.stats import ks_2samp

from sb3_hds import envs, twins
from sb3_hds.core import State
from sb3_hds.errors import EnvironmentMismatchError

MUJOCO = ["InvertedPendulum-v5", "InvertedDoublePendulum-v5"]
CLASSIC = ["MountainCarContinuous-v0", "Pendulum-v1"]
N_STEPS = 200


def state_of(q, v):
    return State(jnp.asarray(q, jnp.float64), jnp.asarray(v, jnp.float64), {})


def simulator(twin):
    """Compiled step, observation, reward and termination of a twin with its own values."""

    @jax.jit
    def simulate(state, action):
        after = twin.step(state, action, twin.params)
        reward = twin.reward(state, action, after, twin.params)
        terminated = twin.terminated(after, twin.params)
        return after, twin.observe(after, twin.params), reward, terminated

    return simulate


def mujoco_state(env):
    return state_of(env.data.qpos.copy(), env.data.qvel.copy())


def away_from_limits(env):
    """The rail ends at 1 m with a margin of 1 cm, the hinge of the single pole at 90 degrees."""
    return abs(env.data.qpos[0]) < 0.95 and abs(env.data.qpos[1]) < 1.5


def random_episodes(env, twin, seed=0):
    """Environment and twin under the same commands, away from limits."""
    rng, simulate = np.random.default_rng(seed), simulator(twin)
    low, high = twin.actuators[0].low, twin.actuators[0].high
    env.reset(seed=seed)
    state, n_steps, n_resets = mujoco_state(env), 0, 1
    while n_steps < N_STEPS:
        action = 0.3 * rng.uniform(low, high, 1)
        obs, reward, terminated, *_ = env.step(action)
        if away_from_limits(env):
            after = simulate(state, jnp.asarray(action))
            yield obs, reward, terminated, *after
            state, n_steps = after[0], n_steps + 1
        if terminated or not away_from_limits(env):
            env.reset()
            state, n_resets = mujoco_state(env), n_resets + 1
    assert n_resets > 3


def change_constants(model):
    """Give a MuJoCo model other masses, shapes, damping, armature, gravity, gear and time step."""
    rng = np.random.default_rng(1)
    model.body_mass[1:] *= rng.uniform(0.7, 1.3, model.body_mass[1:].shape)
    model.body_inertia[1:] *= rng.uniform(0.7, 1.3, model.body_inertia[1:].shape)
    model.body_ipos[2:, 2] += rng.uniform(-0.05, 0.05, model.body_ipos[2:, 2].shape)
    model.dof_damping[:] *= rng.uniform(0.5, 2.0, model.dof_damping.shape)
    model.dof_armature[:] = rng.uniform(0.1, 0.3, model.dof_armature.shape)
    model.opt.gravity[:] = 0.7, 0.0, -8.0
    model.actuator_gear[0, 0] *= 0.8
    model.opt.timestep *= 0.7
    if model.nbody > 3:
        model.body_pos[3, 2] += 0.1
        model.site_pos[0, 2] -= 0.05


@pytest.mark.parametrize("env_id", MUJOCO)
def test_mujoco_twins_follow_mujoco(env_id, x64):
    single = env_id == "InvertedPendulum-v5"
    env = gymnasium.make(env_id, frame_skip=3, **({} if single else {"healthy_reward": 7.0}))
    env = env.unwrapped
    change_constants(env.model)
    twin = twins.from_env(env)

    for obs, reward, ended, state, twin_obs, twin_reward, twin_ended in random_episodes(env, twin):
        # Rounding of 1e-16 per operation, grown along unstable episodes of some ten steps.
        scale = np.maximum(1.0, np.abs([*env.data.qpos, *env.data.qvel]))
        error = np.concatenate([state.q - env.data.qpos, state.v - env.data.qvel]) / scale
        assert np.abs(error).max() < 1e-12
        np.testing.assert_allclose(twin_obs, obs, rtol=1e-12, atol=1e-12)
        if single:
            assert (ended, reward) == (twin_ended, twin_reward)
            continue
        # As the environment has it, the tip is where the last Runge-Kutta stage put it: O(h^3) off.
        assert ended != twin_ended or twin_reward == pytest.approx(reward, abs=5e-3)
        mujoco.mj_kinematics(env.model, env.data)
        x, _, z = env.data.site_xpos[0]
        expected, _ = env._get_rew(x, z, bool(z <= 1.0))
        assert twin_reward == pytest.approx(expected, rel=1e-12) and twin_ended == (z <= 1.0)


@pytest.mark.parametrize("env_id", MUJOCO)
def test_declared_constants_are_those_of_the_shipped_model(env_id):
    twin = twins.from_env(gymnasium.make(env_id))
    assert twin == twins.make(env_id)
    # The compiler derives masses and inertias from shapes; declared to 16 digits.
    assert twin.values == pytest.approx(twins.make(env_id).values, rel=1e-14)


@each(
    (lambda m: m.dof_frictionloss.__setitem__(0, 0.1), "joints without dry friction"),
    (lambda m: setattr(m.opt, "integrator", 0), "the integrator RK4"),
    (lambda m: m.actuator_ctrlrange.__setitem__(0, (-2.0, 2.0)), "commands within"),
    (lambda m: m.jnt_axis.__setitem__(1, (1.0, 0.0, 0.0)), "hinges about y"),
)
def test_a_model_of_another_structure_is_refused(change, expected):
    env = gymnasium.make(MUJOCO[1]).unwrapped
    change(env.model)
    with pytest.raises(EnvironmentMismatchError, match=f"The twin expects .*{expected}"):
        twins.from_env(env)


def test_pendulum_follows_gymnasium(x64):
    env = gymnasium.make("Pendulum-v1", g=9.81).unwrapped
    twin, rng = twins.from_env(env), np.random.default_rng(0)
    simulate = simulator(twin)
    assert twin.values["gravity"] == 9.81

    for seed in range(3):
        env.reset(seed=seed)
        state = state_of(env.state[:1], env.state[1:])
        for _ in range(N_STEPS):
            torque = rng.uniform(-2.5, 2.5, 1)  # beyond the clip, too
            reward = env.step(torque)[1]
            state, _, twin_reward, terminated = simulate(state, jnp.asarray(torque))
            # Rounding of 1e-16, grown by the upper equilibrium over 10 s.
            np.testing.assert_allclose(np.r_[state.q, state.v], env.state, rtol=0.0, atol=1e-11)
            assert twin_reward == pytest.approx(reward, abs=1e-9) and not terminated


def test_mountain_car_follows_gymnasium(x64):
    """From the environment's own state at each step, for it stores that in single precision."""
    env = gymnasium.make("MountainCarContinuous-v0", goal_velocity=0.01).unwrapped
    twin, rng = twins.from_env(env), np.random.default_rng(0)
    simulate, n_terminated, n_walls = simulator(twin), 0, 0
    assert twin.goal_velocity == 0.01

    for seed in range(5):
        env.reset(seed=seed)
        for _ in range(N_STEPS):
            before = state_of(env.state[:1], env.state[1:])
            push = np.array([1.2 * np.sign(before.v[0])]) + rng.uniform(-1.0, 1.0, 1)
            _, reward, terminated, *_ = env.step(push)
            after, _, twin_reward, twin_terminated = simulate(before, jnp.asarray(push))
            # Half a unit in the last place of a float32 up to 1.2 and 0.07; the environment also
            # computes the sums in single precision where it clips.
            np.testing.assert_allclose(after.q, env.state[:1], rtol=0.0, atol=2e-7)
            np.testing.assert_allclose(after.v, env.state[1:], rtol=0.0, atol=1e-8)
            assert terminated == twin_terminated and twin_reward == pytest.approx(reward, rel=1e-12)
            n_terminated += terminated
            n_walls += after.q[0] == -1.2
            if terminated:
                env.reset()
    assert n_terminated >= 3 and n_walls >= 1


def test_acrobot_follows_gymnasium(x64):
    env, twin = gymnasium.make("Acrobot-v1").unwrapped, twins.make("Acrobot")
    rng, simulate = np.random.default_rng(0), simulator(twin)
    n_clipped = n_terminated = 0
    env.reset(seed=0)
    state = state_of(env.state[:2], env.state[2:])

    for k in range(2 * N_STEPS):
        if k >= N_STEPS:  # then single steps from anywhere: at clips, and high up
            highest = np.array([math.pi, math.pi, env.MAX_VEL_1, env.MAX_VEL_2])
            env.state = rng.uniform(-highest, highest)
            state = state_of(env.state[:2], env.state[2:])
        choice = rng.integers(3)
        obs, reward, terminated, *_ = env.step(choice)
        state, twin_obs, twin_reward, twin_ended = simulate(state, jnp.array([choice - 1.0]))
        angles = (state.q - env.state[:2] + math.pi) % (2.0 * math.pi) - math.pi
        # Rounding of 1e-16, grown by chaotic motion over 40 s.
        np.testing.assert_allclose(angles, 0.0, rtol=0.0, atol=1e-10)
        np.testing.assert_allclose(state.v, env.state[2:], rtol=0.0, atol=1e-10)
        np.testing.assert_allclose(twin_obs, obs, rtol=1e-6, atol=1e-6)  # reported in float32
        assert (twin_reward, twin_ended) == (reward, terminated)
        n_clipped += np.abs(state.v[1]) == env.MAX_VEL_2
        n_terminated += terminated
    assert n_clipped > 5 and n_terminated > 5


def test_cart_pole_follows_gymnasium(x64):
    env, twin = gymnasium.make("CartPole-v1").unwrapped, twins.make("CartPole")
    env.kinematics_integrator = "semi-implicit"
    rng, simulate = np.random.default_rng(0), simulator(twin)

    for seed in range(3):
        env.reset(seed=seed)
        env.state, env.steps_beyond_terminated = rng.normal(size=4), 1
        state = state_of(env.state[[0, 2]], env.state[[1, 3]])
        for _ in range(N_STEPS):
            env.force_mag = rng.uniform(-10.0, 10.0)
            env.step(1)
            state, *_ = simulate(state, jnp.array([env.force_mag]))
            # Rounding of 1e-16, grown by the upper equilibrium over 4 s.
            ours = np.r_[state.q, state.v]
            np.testing.assert_allclose(ours, env.state[[0, 2, 1, 3]], rtol=0.0, atol=1e-11)


def payload_in_cartesian_coordinates(twin):
    """Handle and payload as two points kept apart by a rod, whose tension is a multiplier."""
    g, m, d = (twin.values[name] for name in ("gravity", "mass", "damping"))

    def derivative(_, y, command):
        handle_v, rod, rod_v = y[2:4], y[4:6] - y[0:2], y[6:8] - y[2:4]
        handle_a = (command - handle_v) / 0.05
        normal = np.array([-rod[1], rod[0]])
        rate = normal @ rod_v / (rod @ rod)
        free = np.array([0.0, -g]) - d * rate * normal / (rod @ rod) / m
        # The second derivative of |rod|^2 vanishes.
        tension = -((free - handle_a) @ rod + rod_v @ rod_v) / (rod @ rod)
        return np.concatenate([handle_v, handle_a, y[6:8], free + tension * rod])

    return derivative


def test_payload_pendulum_follows_an_independent_integration(x64):
    # RK4: the servo's error per sub-step is (h / 0.05 s)^5 / 120, 1e-12 of a change of up to 4 m/s.
    twin = twins.make("PayloadPendulum", mass=0.7, length=0.8, damping=0.1, substeps=100)
    rng, simulate = np.random.default_rng(0), simulator(twin)
    state = twin.initial(jax.random.key(1), twin.params)

    def points(state):
        (x, z, swing), (vx, vz, rate) = np.asarray(state.q), np.asarray(state.v)
        rod = 0.8 * np.array([math.sin(swing), -math.cos(swing)])
        rod_v = 0.8 * rate * np.array([math.cos(swing), math.sin(swing)])
        return np.array([x, z, vx, vz, x + rod[0], z + rod[1], vx + rod_v[0], vz + rod_v[1]])

    reference, derivative = points(state), payload_in_cartesian_coordinates(twin)
    for _ in range(40):
        command = rng.uniform(-2.0, 2.0, 2)
        state, *_ = simulate(state, jnp.asarray(command))
        reference = solve_ivp(
            derivative, (0.0, 0.05), reference, "DOP853", args=(command,), rtol=1e-12, atol=1e-13
        ).y[:, -1]
        where = [0, 1, 4, 5]
        np.testing.assert_allclose(points(state)[where], reference[where], 0.0, 1e-9)


def reset_states(env, n):
    for seed in range(n):
        env.reset(seed=seed)
        mujoco_data = getattr(env, "data", None)
        yield np.concatenate([mujoco_data.qpos, mujoco_data.qvel]) if mujoco_data else env.state


@pytest.mark.parametrize("env_id", [*MUJOCO, *CLASSIC, "Acrobot-v1"])
def test_episodes_start_as_the_environments_do(env_id, x64):
    settings = {"reset_noise_scale": 0.05} if env_id in MUJOCO else {}
    env = gymnasium.make(env_id, **settings).unwrapped
    twin = twins.make("Acrobot") if env_id == "Acrobot-v1" else twins.from_env(env)

    theirs = np.stack(list(reset_states(env, 300)))
    keys = jax.random.split(jax.random.key(0), 4000)
    ours = np.concatenate(jax.vmap(twin.initial, (0, None))(keys, twin.params)[:2], axis=1)

    for column in range(theirs.shape[1]):
        # Kolmogorov and Smirnov; chance gives 1 in 1000, and the seeds are fixed.
        assert ks_2samp(theirs[:, column], ours[:, column]).pvalue > 1e-3


@pytest.mark.parametrize("env_id", twins.all_ids())
def test_spaces_and_time_limits_are_the_environments(env_id):
    envs.register_environments()
    env, twin = gymnasium.make(env_id), twins.get(env_id)()

    assert type(envs.twin_of(env)) is type(twin)
    actions, observations = env.action_space, env.observation_space
    np.testing.assert_array_equal(actions.low, np.float32([a.low for a in twin.actuators]))
    np.testing.assert_array_equal(actions.high, np.float32([a.high for a in twin.actuators]))
    np.testing.assert_array_equal(observations.low, np.float32([c.low for c in twin.channels]))
    np.testing.assert_array_equal(observations.high, np.float32([c.high for c in twin.channels]))
    assert env.spec.max_episode_steps == twin.max_episode_steps
