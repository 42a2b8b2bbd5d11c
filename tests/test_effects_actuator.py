"""What happens to commands: late, slow, weak, cut off."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from free_mass import Mass, moved

from sb3_hds import twins
from sb3_hds.core import rollout
from sb3_hds.effects import (
    ActionDelay,
    ConstantForce,
    CoulombFriction,
    DeadZone,
    DirectionalGain,
    MotorLag,
    Saturation,
    SensorDelay,
    TorqueGain,
)

pytestmark = pytest.mark.usefixtures("quick_compilation")

COMMANDS = np.array([-5.0, -1.0, -0.2, 0.0, 0.2, 1.0, 5.0])


def carried_out(effect):
    """:return: what a drive without memory does for each of ``COMMANDS``"""
    return [float(effect.act(jnp.asarray(u), (), 0.1, effect.values)[0]) for u in COMMANDS]


@pytest.mark.parametrize(
    ("effect", "expected"),
    [
        (TorqueGain(gain=0.8), 0.8 * COMMANDS),
        (DirectionalGain(gain_pos=2.0, gain_neg=0.5), [-2.5, -0.5, -0.1, 0.0, 0.4, 2.0, 10.0]),
        # The zone is from -0.5 to 0.5.
        (DeadZone(width=1.0), [-4.5, -0.5, 0.0, 0.0, 0.0, 0.5, 4.5]),
        (Saturation(limit=0.9), [-0.9, -0.9, -0.2, 0.0, 0.2, 0.9, 0.9]),
        (Saturation(), COMMANDS),
    ],
)
def test_a_drive_without_memory_has_this_curve(x64, effect, expected):
    np.testing.assert_allclose(carried_out(effect), expected, rtol=1e-14, atol=1e-15)


@pytest.mark.parametrize(
    ("effect", "slopes"),
    [
        (DirectionalGain(), np.ones(7)),
        (DeadZone(), np.ones(7)),
        (DeadZone(width=1.0), [1, 1, 0, 0, 0, 1, 1]),
        (Saturation(), np.ones(7)),
        (Saturation(limit=0.9), [0, 0, 1, 1, 1, 0, 0]),
    ],
)
def test_planning_feels_the_slope_of_that_curve(x64, effect, slopes):
    """Also at zero, where plans begin."""
    slope = jax.grad(lambda u: effect.act(u, (), 0.1, effect.values)[0])

    np.testing.assert_array_equal([float(slope(u)) for u in COMMANDS], slopes)


def test_a_lagging_drive_follows_exponentially_at_any_sub_step(x64):
    # The mean of 1 - exp(-t / T) over each interval is what accelerates the mass.
    for substeps in (1, 7):
        twin = Mass(substeps=substeps).extend(MotorLag(time_constant=0.25))

        states = moved(twin, np.ones(20)).states

        time = 0.1 * np.arange(21)
        reached = time - 0.25 * (1.0 - np.exp(-time / 0.25))
        np.testing.assert_allclose(states.v[:, 0], reached, rtol=1e-12)


def test_a_lag_that_begins_shifts_a_command_by_as_much(x64):
    # To first order in T, a step of one loses T of its impulse.
    twin = Mass(mass=1.0).extend(MotorLag())
    name = "motor_lag.push.time_constant"

    def final_speed(lag):
        params = twin.params | {name: lag}
        start = twin.infer(jnp.zeros(2), params)
        return rollout(twin, params, start, jnp.ones((5, 1))).states.v[-1, 0]

    assert float(jax.grad(final_speed)(0.0)) == pytest.approx(-1.0, rel=1e-12)
    for lag in (1e-12, 1e-6, 1e-3):
        assert float(final_speed(lag) - final_speed(0.0)) == pytest.approx(-lag, rel=1e-3)


@pytest.mark.parametrize("substeps", [1, 4])
@pytest.mark.parametrize("delay", [0.0, 0.03, 0.1, 0.125, 0.2])
def test_a_late_command_is_the_same_command_shifted(x64, delay, substeps):
    pushes = np.random.default_rng(0).uniform(-1.0, 1.0, 30)
    twin = Mass(substeps=substeps).extend(ActionDelay(delay=delay))

    speeds = moved(twin, pushes).states.v[:, 0]

    # The impulse until t is that of the commands, each held for 0.1 s, until t - delay.
    time = 0.1 * np.arange(31)
    impulse = np.concatenate([[0.0], 0.1 * np.cumsum(pushes)])
    expected = np.interp(np.maximum(time - delay, 0.0), time, impulse)
    np.testing.assert_allclose(speeds, expected, rtol=1e-12, atol=1e-13)


def test_a_delay_that_begins_takes_impulse_away_at_once(x64):
    # With a command of one from rest, speed is t - delay.
    twin = Mass().extend(ActionDelay())

    def final_speed(delay):
        params = twin.params | {"action_delay.push.delay": delay}
        start = twin.infer(jnp.zeros(2), params)
        return rollout(twin, params, start, jnp.ones((5, 1))).states.v[-1, 0]

    for delay in (0.0, 0.05, 0.1):
        assert float(jax.grad(final_speed)(delay)) == pytest.approx(-1.0, rel=1e-12)


# --- what cannot be told apart


def pendulum(**parameters):
    return twins.make("PendulumReal", **parameters)


def observed(twin, actions, obs=(-1.0, 0.0, 0.0)):
    start = twin.infer(jnp.asarray(obs), twin.params)
    return rollout(twin, twin.params, start, jnp.asarray(actions)[:, None]).obs


def test_a_weaker_drive_is_a_heavier_pendulum(x64):
    actions = np.random.default_rng(0).uniform(-0.8, 0.8, 50)

    weak, heavy = pendulum().extend(TorqueGain(gain=0.8)), pendulum(mass=1.0 / 0.8)

    np.testing.assert_allclose(observed(weak, actions), observed(heavy, actions), atol=1e-12)


def test_while_commands_keep_their_sign_a_directional_gain_is_a_gain(x64):
    actions = np.random.default_rng(0).uniform(0.1, 0.8, 50)

    one = pendulum().extend(DirectionalGain(gain_pos=0.8, gain_neg=1.3))
    other = pendulum().extend(TorqueGain(gain=0.8))

    np.testing.assert_array_equal(observed(one, actions), observed(other, actions))


def test_while_it_moves_the_way_it_is_driven_a_dead_zone_is_dry_friction(x64):
    pushes = np.random.default_rng(0).uniform(0.5, 1.0, 50)
    dead, dry = Mass().extend(DeadZone(width=0.4)), Mass().extend(CoulombFriction(tau_c=0.2))

    # Ten times as fast as the width over which dry friction is smoothed.
    both = [moved(twin, pushes, speed=1.0).obs for twin in (dead, dry)]

    np.testing.assert_allclose(*both, rtol=1e-12)


def test_if_every_channel_is_as_late_a_late_sensor_is_a_late_command(x64):
    # From rest in balance, where nothing happened before.
    actions = np.random.default_rng(0).uniform(-0.5, 0.5, 40)
    late_command = pendulum().extend(ActionDelay(delay=0.1))
    late_sensors = pendulum().extend(*(SensorDelay(i, delay=0.1) for i in range(3)))

    both = [observed(twin, actions) for twin in (late_command, late_sensors)]

    np.testing.assert_allclose(*both, atol=1e-12)


def test_while_it_moves_one_way_dry_friction_is_a_constant_force(x64):
    pushes = np.random.default_rng(0).uniform(0.5, 1.0, 50)
    dry, offset = (
        Mass().extend(CoulombFriction(tau_c=0.2)),
        Mass().extend(ConstantForce(tau_0=-0.2)),
    )

    np.testing.assert_allclose(
        *(moved(twin, pushes, speed=1.0).obs for twin in (dry, offset)), rtol=1e-12
    )
