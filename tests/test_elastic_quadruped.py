"""A quadruped with springs between motors and joints: its mechanics, its task, its controls."""

import gymnasium
import numpy as np
import pytest
from cases import each
from gymnasium.utils.env_checker import check_env as check_gymnasium
from stable_baselines3.common.env_checker import check_env as check_sb3
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_hds.algos.open_loop.robot import robot_of
from sb3_hds.envs import ElasticQuadruped
from sb3_hds.wrappers import CPGPrior

ID = "sb3_hds/ElasticQuadruped-v0"
SPRINGS = slice(25, 33)
#: one after the other: phases of the legs of a trot
TROT = np.array([0.0, np.pi, np.pi, 0.0])


def stand(env, n_steps=150):
    obs, _ = env.reset(seed=0)
    for _ in range(n_steps):
        obs, _, fallen, _, _ = env.step(np.zeros(8))
        assert not fallen
    return obs


def trot(step, frequency=4.0):
    phase = 2.0 * np.pi * frequency * 0.02 * step + TROT
    action = np.empty(8)
    action[0::2], action[1::2] = 0.5 * np.sin(phase), 0.6 * np.cos(phase)
    return action


def test_both_checkers_accept_it():
    env = gymnasium.make(ID, control="torque").unwrapped
    check_gymnasium(env, skip_render_check=True)
    check_sb3(env)


def test_springs_carry_its_weight_and_softer_ones_give_way():
    env = ElasticQuadruped()
    springs = stand(env)[SPRINGS]

    motors = 2.5 * env.data.actuator_force
    np.testing.assert_allclose(springs, motors, atol=0.03)
    # A foot that stands below its hip bends the knee by the weight on it times the lever.
    weight = 9.81 * env.model.body_mass.sum() / 4.0
    assert np.mean(springs[1::2]) == pytest.approx(weight * 0.08 * np.sin(0.6), rel=0.25)
    softer = ElasticQuadruped(stiffness=2.0)
    stand(softer)
    assert softer.data.qpos[2] < env.data.qpos[2]


def test_a_spring_passes_on_the_force_that_is_asked_for():
    env = ElasticQuadruped(control="force")
    env.reset(seed=0)
    # In the air, joints go to their ends and stay there.
    env.model.opt.gravity[:] = 0.0
    for _ in range(100):
        env.data.qpos[:3], env.data.qvel[:6] = (0.0, 0.0, 1.0), 0.0
        obs, *_ = env.step(np.tile([0.3, -0.2], 4))
    np.testing.assert_allclose(obs[SPRINGS], np.tile([0.6, -0.4], 4), atol=0.05)


def test_a_plain_trot_walks_and_the_reward_is_what_it_says():
    env = ElasticQuadruped()
    env.reset(seed=0)
    total = 0.0
    for step in range(250):
        x, y = env.data.qpos[:2].copy()
        _, reward, fallen, _, info = env.step(trot(step))
        total += reward
    assert not fallen and env.data.qpos[0] > 2.0 and total > 70.0
    speed, drift = (env.data.qpos[0] - x) / 0.02, (env.data.qpos[1] - y) / 0.02
    assert info["x_velocity"] == pytest.approx(speed)
    lost = 0.2 * abs(drift) + 0.1 * abs(env.data.qvel[5]) + 0.005 * info["power"]
    assert reward == pytest.approx(speed - lost)


def test_a_fall_ends_the_episode():
    env = ElasticQuadruped(control="torque")
    env.reset(seed=0)
    fallen = [env.step(np.zeros(8))[2] for _ in range(60)]
    assert fallen[-1] and not fallen[0]


def test_rhythms_find_its_motors():
    env = gymnasium.make(ID, control="torque")
    robot = robot_of(DummyVecEnv([lambda: env]), "auto", "auto", None)
    assert robot.control == "track" and robot.dt == pytest.approx(0.02)
    assert robot.names[:3] == ("FL_hip_motor", "FL_knee_motor", "FR_hip_motor")
    assert robot.rest == (0.0,) * 8

    walking = CPGPrior(env, omega_swing=25.0, amplitude=0.3, kp=6.0, kd=0.14)
    obs, _ = walking.reset(seed=0)
    for _ in range(20):
        obs, *_ = walking.step(np.zeros(8))
    assert walking.observation_space.contains(obs)


@each(
    ({"control": "speed"}, "one of"),
    ({"stiffness": 0}, "stiff"),
    ({"noise": np.nan}, "noise"),
)
def test_what_makes_no_sense_is_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        ElasticQuadruped(**changes)
    with pytest.raises(ValueError, match="8 finite"):
        env = ElasticQuadruped()
        env.reset()
        env.step(np.full(8, np.nan))
