"""Twins on MuJoCo's engine against the tasks of Gymnasium that they mirror."""

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import ks_2samp

from sb3_hds import envs, twins
from sb3_hds.errors import EnvironmentMismatchError

TASKS = [
    "HalfCheetah-v5",
    "Hopper-v5",
    "Walker2d-v5",
    "Ant-v5",
    "Swimmer-v5",
    "Reacher-v5",
    "Pusher-v5",
]
OTHERWISE = {
    "HalfCheetah-v5": {"frame_skip": 3, "ctrl_cost_weight": 0.3, "forward_reward_weight": 2.0},
    "Hopper-v5": {"healthy_z_range": (1.0, 1.6), "healthy_reward": 3.0, "frame_skip": 3},
    "Walker2d-v5": {"healthy_angle_range": (-0.3, 0.3), "terminate_when_unhealthy": False},
    "Ant-v5": {"contact_force_range": (-5.0, 5.0), "main_body": 4, "contact_cost_weight": 1e-3},
    "Swimmer-v5": {"exclude_current_positions_from_observation": False},
    "Reacher-v5": {"reward_dist_weight": 3.0, "reward_control_weight": 0.1},
    "Pusher-v5": {"reward_near_weight": 0.1, "frame_skip": 4},
}
N_STEPS = 200


def state_in(env, twin):
    """The state of an environment that was just reset."""
    return twin.at(jnp.asarray(env.data.qpos.copy()), jnp.asarray(env.data.qvel.copy()))


@pytest.mark.parametrize("settings", [{}, OTHERWISE], ids=["default", "otherwise"])
@pytest.mark.parametrize("env_id", TASKS)
def test_observation_reward_and_termination_are_the_environments(env_id, settings, x64):
    """Step by step, from the environment's own positions and velocities."""
    env = gymnasium.make(env_id, **settings.get(env_id, {})).unwrapped
    twin = twins.from_env(gymnasium.make(env_id, **settings.get(env_id, {})))
    rng, touched = np.random.default_rng(0), 0

    @jax.jit
    def simulate(state, action):
        after = twin.step(state, action, twin.params)
        reward = twin.reward(state, action, after, twin.params)
        obs = twin.observe(after, twin.params)
        again = twin.observe(twin.infer(obs, twin.params), twin.params)
        return after, obs, reward, twin.terminated(after, twin.params), again

    obs, _ = env.reset(seed=0)
    state = state_in(env, twin)
    np.testing.assert_allclose(twin.observe(state, twin.params), obs, rtol=0.0, atol=1e-12)
    for _ in range(N_STEPS):
        action = rng.uniform(env.action_space.low, env.action_space.high).astype(np.float32)
        obs, reward, terminated, *_ = env.step(action)
        after, *seen = simulate(state, jnp.asarray(action, jnp.float64))
        # The environment stops its solver at 1e-8 from its last solution, the twin at 1e-12.
        np.testing.assert_allclose(seen[0], obs, rtol=1e-6, atol=1e-6)
        # Actions are in single precision, and so are sums over them.
        assert seen[1] == pytest.approx(reward, rel=1e-6, abs=1e-6)
        assert seen[2] == terminated
        np.testing.assert_allclose(seen[3], seen[0], rtol=0.0, atol=1e-14)
        q, v = jnp.asarray(env.data.qpos.copy()), jnp.asarray(env.data.qvel.copy())
        state, touched = after._replace(q=q, v=v), touched + (env.data.ncon > 0)
        if terminated:
            env.reset()
            state = state_in(env, twin)
    assert touched > 20 or env_id in ("Swimmer-v5", "Reacher-v5", "Pusher-v5")


@pytest.mark.parametrize("env_id", TASKS)
def test_declared_constants_are_those_of_the_shipped_model(env_id):
    twin = twins.from_env(gymnasium.make(env_id))

    assert twin == twins.make(env_id)
    # The compiler derives masses from shapes; declared to 16 digits.
    assert twin.values == pytest.approx(twins.make(env_id).values, rel=1e-14)


def test_values_are_read_from_the_environment_and_change_the_motion(x64):
    env = gymnasium.make("HalfCheetah-v5").unwrapped
    env.model.body_mass[1] *= 1.3
    env.model.body_inertia[1] *= 1.3
    env.model.geom_friction[:, 0] *= 0.5
    env.model.dof_damping[3] = 9.0
    env.model.actuator_gainprm[2, 0] = 0.7
    env.model.opt.gravity[2] = -5.0

    twin = twins.HalfCheetah.from_env(env)

    usual = twins.make("HalfCheetah").values
    assert {name: x / usual[name] for name, x in twin.values.items() if x != usual[name]} == {
        "torso_mass": pytest.approx(1.3),
        "friction": pytest.approx(0.5),
        "bthigh_damping": pytest.approx(1.5),
        "bfoot_gain": pytest.approx(0.7),
        "gravity": pytest.approx(5.0 / 9.81),
    }
    # The environment's contacts are as soft as with the old mass: `mj_setConst` tells them.
    import mujoco

    mujoco.mj_setConst(env.model, mujoco.MjData(env.model))
    step = jax.jit(twin.step)
    env.reset(seed=0)
    for _ in range(20):
        state = state_in(env, twin)
        action = env.np_random.uniform(-1.0, 1.0, 6)
        env.step(action)
        after = step(state, action, twin.params)
        np.testing.assert_allclose(after.q, env.data.qpos, rtol=1e-7, atol=1e-7)


def test_a_model_that_differs_in_other_fields_is_refused():
    env = gymnasium.make("Hopper-v5").unwrapped
    env.model.jnt_stiffness[3] = 5.0
    with pytest.raises(EnvironmentMismatchError, match=r"differs from hopper.xml in jnt_stiffness"):
        twins.Hopper.from_env(env)
    env = gymnasium.make("Hopper-v5", xml_file="half_cheetah.xml").unwrapped
    with pytest.raises(EnvironmentMismatchError, match=r"no body .thigh.\. It has: world, torso"):
        twins.Hopper.from_env(env)


@pytest.mark.parametrize("env_id", TASKS)
def test_episodes_start_as_the_environments_do(env_id, x64):
    env, twin = gymnasium.make(env_id).unwrapped, twins.make(env_id)
    theirs = []
    for seed in range(200):
        env.reset(seed=seed)
        theirs.append(np.concatenate([env.data.qpos, env.data.qvel]))
    keys = jax.random.split(jax.random.key(0), 2000)
    ours = np.concatenate(jax.vmap(twin.initial, (0, None))(keys, twin.params)[:2], axis=1)

    turned = range(3, 7) if env_id == "Ant-v5" else ()  # normalised in the twin
    for column in sorted(set(range(ours.shape[1])) - set(turned)):
        # Kolmogorov and Smirnov; chance gives 1 in 1000, and the seeds are fixed.
        assert ks_2samp(np.stack(theirs)[:, column], ours[:, column]).pvalue > 1e-3


def test_the_observation_of_the_environment_determines_its_next_one():
    # Observations in double precision; the solver of the environment stops at 1e-8.
    env = gymnasium.make("HalfCheetah-v5")
    assert envs.verify_mirror(env, envs.twin_of(env)) < 1e-6
