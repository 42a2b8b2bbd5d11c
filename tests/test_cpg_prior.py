"""CPGPrior: a rhythm under a policy, in every mode; and the other wrappers around joints."""

import gymnasium
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from cases import each
from gymnasium.utils.env_checker import check_env as gymnasium_check
from moving_joints import MovingJoints

from sb3_hds.core import Actuator, Channel, Signals
from sb3_hds.core.transforms.oscillators import advance_phase
from sb3_hds.envs import TwinEnv, twin_of
from sb3_hds.errors import EnvironmentMismatchError, ParameterError
from sb3_hds.wrappers import ActionRateLimit, CPGPrior, Perturb, ShowJoints
from sb3_hds.wrappers.actuated_joints import commands_positions, refuse_servos

TAU = 2.0 * np.pi
#: two motors, and what Swimmer-v5 observes
BELOW = Signals(
    tuple(Actuator(name, "1", -1.0, 1.0) for name in "ab"),
    tuple(Channel(f"obs[{i}]", "1") for i in range(8)),
)
SETTINGS = {"omega_swing": TAU * 0.6, "omega_stance": TAU * 0.9, "kp": 10.0, "kd": 0.5}
SETTINGS |= {"amplitude": [0.8, 1.2], "phase": [0.3, 4.0], "offset": [0.1, -0.1]}


def swimmer(mode: str = "offset", **changes) -> CPGPrior:
    return CPGPrior(gymnasium.make("Swimmer-v5"), mode=mode, **(SETTINGS | changes))


def pendulum(mode: str = "offset", **changes) -> CPGPrior:
    settings = {"omega_swing": 4.0, "omega_stance": 6.0, "amplitude": 1.5, "phase": 0.4} | changes
    return CPGPrior(gymnasium.make("Pendulum-v1"), mode=mode, **settings)


def inverted(**settings) -> CPGPrior:
    return CPGPrior(gymnasium.make("InvertedPendulum-v5"), **settings)


def wave(time: float, joint: int) -> float:
    """Where a joint aims at, from the definition."""
    phase = np.array([SETTINGS["phase"][joint]])
    moved = advance_phase(phase, time, SETTINGS["omega_swing"], SETTINGS["omega_stance"])
    return SETTINGS["amplitude"][joint] * np.sin(moved[0]) + SETTINGS["offset"][joint]


def test_without_an_action_joints_aim_at_the_middle_of_each_step():
    env = swimmer()
    env.reset(seed=0)

    for k in range(100):
        *_, info = env.step(np.zeros(2))
        expected = [wave((k + 0.5) * 0.04, joint) for joint in range(2)]
        np.testing.assert_allclose(info["target"], expected, atol=1e-9)


def test_an_offset_moves_the_target_and_a_residual_the_command():
    for mode, name in (("offset", "target"), ("residual", "command")):
        plain, moved = (swimmer(mode, action_range=0.2, kp=0.1, kd=0.0) for _ in range(2))
        plain.reset(seed=0)
        moved.reset(seed=0)

        *_, before = plain.step(np.zeros(2))
        *_, after = moved.step(np.array([1.0, -0.5]))

        change = after[name] - before[name]
        np.testing.assert_allclose(change, [0.2, -0.1], atol=1e-6)


def test_in_the_third_mode_actions_are_amplitudes_and_the_frequency():
    env = swimmer("parameters", amplitude_factor=(0.0, 2.0), frequency_factor=(0.5, 1.5))
    env.reset(seed=0)
    faster = np.array([0.5, -1.0, 1.0])

    for _ in range(100):
        obs, *_, info = env.step(faster)

    # Long settled: 1.5 times the first amplitude, none of the second.
    np.testing.assert_allclose(obs[-4:-2], [1.5, 0.0], atol=1e-3)
    np.testing.assert_allclose(obs[-2:], 0.0, atol=1e-3)
    cycle = np.pi / SETTINGS["omega_swing"] + np.pi / SETTINGS["omega_stance"]
    turned = TAU * (1.5 * 100 * 0.04 / cycle)
    np.testing.assert_allclose(obs[-6:-4], [np.sin(turned), np.cos(turned)], atol=1e-6)
    assert info["target"][1] == pytest.approx(SETTINGS["offset"][1], abs=1e-3)


@pytest.mark.parametrize("mode", ["offset", "parameters"])
def test_targets_are_differentiable_in_jax_and_the_same_in_numpy(mode, x64):
    # A while after the start: where the clock turns over, the phase has a corner.
    rhythm = swimmer(mode, dt=0.13).rhythm
    action = np.linspace(-0.4, 0.6, rhythm.n_actions)
    _, memory = rhythm.target(action, rhythm.start(np.zeros(8), BELOW))
    steps = 1e-6 * np.eye(rhythm.n_actions)

    def aim(a):
        return rhythm.target(a, jnp.asarray(memory))[0]

    expected, _ = rhythm.target(action, memory)
    np.testing.assert_allclose(aim(jnp.asarray(action)), expected, atol=1e-12)
    ends = [[rhythm.target(action + s * step, memory)[0] for step in steps] for s in (1, -1)]
    slope = jax.jacfwd(aim)(jnp.asarray(action))
    np.testing.assert_allclose(slope, np.subtract(*ends).T / 2e-6, atol=1e-6)
    assert np.abs(slope).max() > 0.0


def test_learners_store_what_they_chose_whatever_a_layer_below_would_have():
    limited = ActionRateLimit(MovingJoints(2), max_rate=20.0, store="executed")
    env = CPGPrior(limited, omega_swing=4.0, amplitude=0.3)
    env.reset(seed=0)
    action = np.array([1.0, -0.5], np.float32)

    *_, info = env.step(action)

    # Commands below are in other units, and no action stands for them.
    assert "stored_action" not in info
    np.testing.assert_array_equal(info["raw_action"], action)
    np.testing.assert_array_equal(info["executed_action"], action)
    np.testing.assert_array_equal(info["safe_action"], env.unwrapped.told)


def test_joints_are_tracked_where_the_observation_shows_them():
    settings = {"kp": 2.0, "kd": 0.1, "amplitude": 0.4, "omega_swing": 3.0}
    seen, read = (
        inverted(**settings, **entries)
        for entries in ({"position": [0], "velocity": [2]}, {"control": "track"})
    )
    seen.reset(seed=1)
    obs, _ = read.reset(seed=1)

    for _ in range(10):
        expected = 2.0 * (0.0 - obs[0]) - 0.1 * obs[2]
        obs, *_, info = read.step(np.zeros(1))
        np.testing.assert_array_equal(seen.step(np.zeros(1))[0], obs)
        assert info["command"] == pytest.approx(expected + 2.0 * info["target"], rel=1e-5)


def test_a_twin_tracks_the_joints_that_the_observation_shows(x64):
    seen = {"position": [0], "velocity": [2]}
    env = inverted(omega_swing=3.0, amplitude=0.1, kp=2.0, kd=0.3, **seen)
    twin = twin_of(env)
    obs, _ = env.reset(seed=0)
    state, step = twin.infer(jnp.asarray(obs), twin.params), jax.jit(twin.step)

    for _ in range(20):
        obs, *_, info = env.step(np.array([0.5]))
        state = step(state, jnp.array([0.5]), twin.params)
        assert abs(info["command"][0]) < 3.0
        # MuJoCo and the twin integrate alike to 1e-8; twenty steps of an unstable pole magnify it.
        np.testing.assert_allclose(twin.observe(state, twin.params), obs, atol=1e-5)


def test_show_joints_appends_what_the_actuators_drive():
    env = ShowJoints(gymnasium.make("Ant-v5"))
    obs, _ = env.reset(seed=0)
    inner = env.unwrapped

    names = [f"{part}_{leg}" for leg in (4, 1, 2, 3) for part in ("hip", "ankle")]
    joints = [inner.model.joint(name) for name in names]
    np.testing.assert_array_equal(obs[-16:-8], [inner.data.qpos[j.qposadr[0]] for j in joints])
    np.testing.assert_array_equal(obs[-8:], [inner.data.qvel[j.dofadr[0]] for j in joints])
    gymnasium_check(ShowJoints(gymnasium.make("Reacher-v5")), skip_render_check=True)


def perturbed(**settings) -> gymnasium.Env:
    return Perturb(gymnasium.make("Swimmer-v5", max_episode_steps=400), **settings)


def observations(env: gymnasium.Env, n: int = 400) -> np.ndarray:
    seen = [env.reset(seed=1)[0]]
    return np.stack(seen + [env.step(np.zeros(2))[0] for _ in range(n)])


def test_noise_has_the_deviation_that_was_asked_for_and_rewards_have_none():
    noisy = observations(perturbed(noise=0.25))
    seen = noisy - observations(perturbed())

    # 400 samples of each of eight entries: the deviation is known to 1.3 %.
    assert seen.std() == pytest.approx(0.25, rel=0.05) and abs(seen.mean()) < 0.02
    np.testing.assert_array_equal(observations(perturbed(noise=0.25)), noisy)


@pytest.mark.parametrize(("failing", "shown"), [("zero", 0.0), ("constant", 5.0)])
def test_a_failed_sensor_shows_one_value_and_the_others_what_they_measure(failing, shown):
    seen, true = observations(perturbed(failing=failing, sensor=3)), observations(perturbed())
    env = perturbed(failing=failing)
    drawn = {np.flatnonzero(env.reset(seed=seed)[0] == shown)[0] for seed in range(12)}

    assert (seen[:, 3] == shown).all()
    np.testing.assert_array_equal(np.delete(seen, 3, axis=1), np.delete(true, 3, axis=1))
    assert len(drawn) > 2


def test_a_push_is_a_force_on_the_torso_in_some_steps_only():
    env = perturbed(push=5.0, push_probability=0.25)
    env.reset(seed=0)
    forces = []
    for _ in range(400):
        env.step(np.zeros(2))
        forces.append(np.linalg.norm(env.unwrapped.data.xfrc_applied[1, :3]))

    pushed = np.array(forces) > 0.0
    np.testing.assert_allclose(np.array(forces)[pushed], 5.0)
    # Three standard deviations of 400 draws.
    assert abs(pushed.mean() - 0.25) < 3.0 * np.sqrt(0.25 * 0.75 / 400)


def test_an_environment_says_whether_its_actions_are_positions():
    servos, motors = (
        gymnasium.make("sb3_hds/ElasticQuadruped-v0", control=control)
        for control in ("position", "torque")
    )

    assert CPGPrior(servos, omega_swing=6.0)._joints is None
    assert CPGPrior(motors, omega_swing=6.0)._joints is not None
    with pytest.raises(EnvironmentMismatchError, match="second loop"):
        CPGPrior(servos, omega_swing=6.0, control="track")
    # A model may tell by its actuators.
    model = motors.unwrapped.model
    assert not commands_positions(model)
    model.actuator_biastype[0], model.actuator_biasprm[0, 1] = mujoco.mjtBias.mjBIAS_AFFINE, -20.0
    with pytest.raises(EnvironmentMismatchError, match="control='direct'"):
        refuse_servos(model, None)


@each(
    (swimmer, {"mode": "offsets"}, "mode must be one of 'offset'"),
    (swimmer, {"omega_swing": 0.0}, "omega_swing must be above 0"),
    (swimmer, {"amplitude": [1.0, 2.0, 3.0]}, "3 values of amplitude"),
    (swimmer, {"kp": np.nan}, "kp must be finite"),
    (swimmer, {"frequency_factor": (0.0, 1.0)}, "0 < smallest < largest"),
    (pendulum, {"control": "track"}, "needs an environment of MuJoCo"),
    (pendulum, {"control": "direct", "position": [0], "velocity": [2]}, "tracks no joints"),
    (pendulum, {"position": [0]}, "as many as positions"),
    (pendulum, {"position": [0], "velocity": [3]}, "an observation has 3"),
    (perturbed, {"noise": np.nan}, "noise=nan"),
    # Joints are read from MuJoCo, which no twin sees.
    (lambda: twin_of(inverted(omega_swing=3.0)), {}, "CPGPrior may change"),
)
def test_what_makes_no_sense_is_refused(make, settings, says):
    with pytest.raises((ParameterError, EnvironmentMismatchError), match=says):
        make(**settings)


def test_intervals_are_those_of_the_twin_before_those_of_the_drawing():
    assert CPGPrior(TwinEnv("Pendulum", dt=0.03), omega_swing=4.0).rhythm.dt == 0.03
    car = gymnasium.make("MountainCarContinuous-v0")
    with pytest.warns(UserWarning, match="Pass dt=SECONDS"):
        assert CPGPrior(car, omega_swing=4.0).rhythm.dt == pytest.approx(1.0 / 30.0)
