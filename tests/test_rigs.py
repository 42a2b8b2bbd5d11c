"""Rigs follow the physics of other simulators: MuJoCo's engine, and SciPy's integrators."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import small_robots as robots
from cases import each
from scipy.integrate import solve_ivp

from sb3_hds import twins
from sb3_hds.core import State, rollout
from sb3_hds.errors import ParameterError

DOUBLE_PENDULUM = robots.robot(
    "double_pendulum",
    """<body>
      <joint name="joint1" axis="0 -1 0" damping="0.01"/>
      <inertial pos="0 0 -0.25" mass="0.5" diaginertia="0.01 0.02 0.01"/>
      <body pos="0 0 -0.3">
        <joint name="joint2" axis="0 -1 0" damping="0.02"/>
        <inertial pos="0 0 -0.15" mass="0.6" diaginertia="0.01 0.015 0.01"/>{tip}
      </body>
    </body>""",
    '<motor joint="joint1"/><motor joint="joint2"/>',
)
# The pendulum is slender along its rod (z), and swings about the arm (x).
FURUTA = robots.robot(
    "furuta",
    """<body>
      <joint name="arm" axis="0 0 1" damping="0.001"/>
      <inertial pos="0 0 0" mass="0.1" diaginertia="6e-4 6e-4 6e-4"/>
      <body pos="0.1 0 0">
        <joint name="pendulum" axis="1 0 0" damping="0.0001"/>
        <inertial pos="0 0 -0.07" mass="0.03" diaginertia="4e-5 4e-5 1e-12"/>{tip}
      </body>
    </body>""",
    '<motor joint="arm"/>',
)
TIP = """<body pos="0 0 -{}">
  <inertial pos="0 0 0" mass="{}" diaginertia="1e-9 1e-9 1e-9"/></body>"""
S, C = 9.81 * np.sin(0.2), 9.81 * np.cos(0.2)


# Where the inertia is that about the joint: about the centre of mass, and Steiner's share.
DOUBLE = {"mass1": 0.5, "mass2": 0.6, "length1": 0.3, "com1": 0.25, "com2": 0.15, "tilt": 0.2}
DOUBLE |= {"inertia1": 0.02 + 0.5 * 0.25**2, "inertia2": 0.015 + 0.6 * 0.15**2}
DOUBLE |= {"damping1": 0.01, "damping2": 0.02, "tip_payload": 0.15, "tip": 0.25}
ROTARY = {"arm_inertia": 6e-4, "arm_length": 0.1, "mass": 0.03, "com": 0.07, "inertia": 4e-5}
ROTARY |= {"arm_damping": 1e-3, "pendulum_damping": 1e-4, "tilt_x": 0.2, "tilt_y": -0.1}
ROTARY |= {"tip_payload": 0.01, "tip": 0.12}


@each(
    ("DoublePendulum", DOUBLE_PENDULUM, 0.5, (-S, 0.0, -C), DOUBLE),
    ("Furuta", FURUTA, 0.01, (S, C * np.sin(-0.1), -C * np.cos(-0.1)), ROTARY),
)
def test_two_joints_move_as_in_mujoco(name, xml, size, gravity, parameters, x64):
    twin, start = twins.make(name, **parameters), np.array([0.3, 1.0])
    actions = torques(100, len(twin.actuators), size)
    xml = xml.replace("{tip}", TIP.format(parameters["tip"], parameters["tip_payload"]))
    model = robots.compiled(xml, gravity=gravity, timestep=0.0005, integrator=1)
    data = mujoco.MjData(model)
    data.qpos[:] = start

    found = replayed(twin, start, actions)

    for torque, seen in zip(actions, found[1:], strict=True):
        data.ctrl[:] = torque
        mujoco.mj_step(model, data, round(twin.dt / 0.0005))
        # Both integrate by Runge-Kutta; the twin's steps are ten times as long.
        np.testing.assert_allclose(seen, np.r_[data.qpos, data.qvel], atol=2e-4)


def replayed(twin, start, actions):
    obs = jnp.concatenate([jnp.asarray(start, float), jnp.zeros(len(start))])
    states = rollout(twin, twin.params, twin.infer(obs, twin.params), jnp.asarray(actions)).states
    return np.asarray(jax.vmap(lambda s: twin.observe(s, twin.params))(states))


def torques(n_steps, n, size):
    rng = np.random.default_rng(0)
    return size * np.sin(0.2 * rng.standard_normal((n_steps, n)).cumsum(0))


def test_one_motor_leaves_the_other_joint_alone(x64):
    actions = torques(20, 1, 0.5)
    for driven, column in (("first", 0), ("second", 1)):
        pair = np.zeros((20, 2))
        pair[:, column] = actions[:, 0]
        one = replayed(twins.make("DoublePendulum", driven=driven), [0.1, 0.2], actions)
        np.testing.assert_array_equal(one, replayed(twins.make("DoublePendulum"), [0.1, 0.2], pair))


SPRING = {"mass": 0.5, "damping": 0.1, "stiffness": -1.0, "cubic_stiffness": 3.0}
ROD = {"mass": 0.2, "com": 0.2, "inertia": 1e-3}
UP = ROD | {"damping": 1e-3, "zero": "up"}
TILTED = ROD | {"tilt": 0.3, "tip_payload": 0.1, "tip": 0.4}
LOGGED = {"commands": "goal, enable, gain"}
MOTOR = {"torque_constant": 0.5, "resistance": 2.0}


def servo(q, v, u):
    """Its current is what its voltage drives against the voltage that its motion induces."""
    drive = 0.5 / 2.0 * (6.0 * np.clip(200.0 * 2.877e-3 * (u - q), -1.0, 1.0) - 0.5 * v)
    return (drive - 0.5 * 9.81 * 0.1 * np.sin(q - 0.2)) / (0.5 * 0.1**2 + 0.002)


@each(
    ("LinearAxis", {"mass": 2.0, "damping": 0.3}, lambda q, v, u: (u - 0.3 * v) / 2.0),
    ("Duffing", SPRING, lambda q, v, u: (u - 0.1 * v + q - 3.0 * q**3) / 0.5),
    ("FreePendulum", UP, lambda q, v, u: (0.04 * 9.81 * np.sin(q) - 1e-3 * v) / (1e-3 + 0.2**3)),
    ("FreePendulum", TILTED, lambda q, v, u: -0.08 * 9.81 * np.sin(q + 0.3) / (0.009 + 0.1 * 0.16)),
    ("ServoPendulum", MOTOR | {"kp": 200.0, "voltage": 6.0, "tilt": -0.2}, servo),
)
def test_one_joint_moves_as_its_equation_says(name, settings, acceleration, x64):
    twin = twins.make(name, **settings)
    actions = torques(60, len(twin.actuators), 2.0)
    expected = [(0.4, 0.0)]
    for step in range(60):
        u = actions[step, 0] if twin.actuators else 0.0
        moves = lambda _, x, u=u: (x[1], acceleration(x[0], x[1], u))  # noqa: E731
        solved = solve_ivp(moves, (0.0, twin.dt), expected[-1], rtol=1e-10, atol=1e-12)
        expected.append(tuple(solved.y[:, -1]))

    np.testing.assert_allclose(replayed(twin, [0.4], actions), expected, rtol=1e-4, atol=1e-4)


def test_a_servo_is_switched_off_by_a_command_and_its_gain_may_be_another(x64):
    logged, plain = (twins.make("ServoPendulum", **how) for how in (LOGGED, {"kp": 123.0}))
    free = twins.make("FreePendulum", mass=0.5, com=0.1, inertia=0.002, dt=plain.dt)
    goals, ones = torques(40, 1, 1.0), np.ones((40, 1))

    on, off = (replayed(logged, [0.5], np.c_[goals, on * ones, 123.0 * ones]) for on in (1, 0))

    np.testing.assert_allclose(on, replayed(plain, [0.5], goals), rtol=1e-9)
    np.testing.assert_allclose(off, replayed(free, [0.5], np.zeros((40, 0))), rtol=1e-9)
    assert "kp" in plain.parameters and "kp" not in logged.parameters


@pytest.mark.parametrize("name", ["Furuta", "CartPole"])
def test_encoders_report_positions_and_if_wanted_velocities(name):
    alone, both = (twins.make(name, observe=observe) for observe in ("q", "qv"))
    state = both.initial(jax.random.key(0), both.params)._replace(v=jnp.ones(len(both.joints)))

    np.testing.assert_array_equal(alone.observe(state, alone.params), state.q)
    np.testing.assert_array_equal(both.observe(state, both.params), np.r_[state.q, state.v])
    assert alone != both and len(both.channels) == 2 * len(alone.channels)
    assert twins.from_spec(alone.to_spec()).channels == alone.channels


def test_a_rig_is_pushed_as_hard_as_it_was():
    rig = twins.make("CartPole", observe="qv")
    state = State(jnp.zeros(2), jnp.zeros(2), {})
    weak, strong = (rig.step(state, jnp.array([force]), rig.params).v[0] for force in (10.0, 30.0))
    assert float(strong) == pytest.approx(3.0 * float(weak), rel=0.05)


@each(
    ("LinearAxis", {"observe": "v"}, "can observe 'q' or 'qv', got 'v'"),
    ("CartPole", {"observe": "v"}, "'task' or 'q' or 'qv'"),
    ("FreePendulum", {"zero": "left"}, "'down', 'up'"),
    ("FreePendulum", {"tip": 0.0}, "tip of FreePendulum must be a length above 0 m, got 0"),
    ("DoublePendulum", {"driven": "none"}, "'both', 'first', 'second'"),
    ("ServoPendulum", {"commands": "torque"}, "'goal', 'goal, enable'"),
)
def test_a_rig_that_does_not_exist_is_refused(name, setting, message):
    with pytest.raises(ParameterError, match=message):
        twins.make(name, **setting)
