"""What happens to commands: late, slow, weak, cut off."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import each
from free_mass import Mass, moved

from sb3_hds.core import rollout
from sb3_hds.effects import (
    ActionDelay,
    DeadZone,
    DirectionalGain,
    MotorLag,
    Saturation,
    TorqueGain,
)

COMMANDS = np.array([-5.0, -1.0, -0.2, 0.0, 0.2, 1.0, 5.0])


def carried_out(effect, differentiate=lambda f: f):
    """:return: what a drive without memory does for each of ``COMMANDS``"""
    curve = differentiate(lambda u: effect.act(u, (), 0.1, effect.values)[0])
    return jax.vmap(curve)(jnp.asarray(COMMANDS))


ONES = np.ones(7)


@each(
    (TorqueGain(gain=0.8), 0.8 * COMMANDS, 0.8 * ONES),
    (DirectionalGain(gain_pos=2.0, gain_neg=0.5), [-2.5, -0.5, -0.1, 0, 0.4, 2, 10], None),
    # The zone is from -0.5 to 0.5.
    (DeadZone(width=1.0), [-4.5, -0.5, 0, 0, 0, 0.5, 4.5], [1, 1, 0, 0, 0, 1, 1]),
    (Saturation(limit=0.9), [-0.9, -0.9, -0.2, 0, 0.2, 0.9, 0.9], [0, 0, 1, 1, 1, 0, 0]),
    # At null, where plans begin.
    (DirectionalGain(), COMMANDS, ONES),
)
def test_a_drive_without_memory_has_this_curve_and_its_slope(effect, expected, slopes, x64):
    np.testing.assert_allclose(carried_out(effect), expected, rtol=1e-14, atol=1e-15)
    if slopes is not None:
        np.testing.assert_array_equal(carried_out(effect, jax.grad), slopes)


def test_a_lagging_drive_follows_exponentially_at_any_sub_step(x64):
    # The mean of 1 - exp(-t / T) over each interval is what accelerates the mass.
    for substeps in (1, 7):
        twin = Mass(substeps=substeps).extend(MotorLag(time_constant=0.25))

        states = moved(twin, np.ones(20)).states

        time = 0.1 * np.arange(21)
        reached = time - 0.25 * (1.0 - np.exp(-time / 0.25))
        np.testing.assert_allclose(states.v[:, 0], reached, rtol=1e-12)


@each((MotorLag(), "time_constant", [0.0]), (ActionDelay(), "delay", [0.0, 0.05, 0.1]))
def test_a_lag_or_a_delay_takes_as_much_impulse_from_a_step(effect, name, at, x64):
    # With a command of one from rest, speed is t - T once the lag is over; to first order in T.
    twin = Mass().extend(effect)

    def final_speed(late):
        params = twin.params | {f"{effect.name}.push.{name}": late}
        start = twin.infer(jnp.zeros(2), params)
        return rollout(twin, params, start, jnp.ones((5, 1))).states.v[-1, 0]

    slopes = jax.jit(jax.vmap(jax.grad(final_speed)))(jnp.array(at))
    np.testing.assert_allclose(slopes, -1.0, rtol=1e-12)
    speeds = jax.jit(jax.vmap(final_speed))(jnp.array([0.0, 1e-12, 1e-6, 1e-3]))
    np.testing.assert_allclose(speeds[0] - speeds[1:], [1e-12, 1e-6, 1e-3], rtol=1e-3)


@pytest.mark.parametrize("substeps", [1, 4])
def test_a_late_command_is_the_same_command_shifted(x64, substeps):
    pushes = np.random.default_rng(0).uniform(-1.0, 1.0, 30)
    twin = Mass(substeps=substeps).extend(ActionDelay())

    @jax.jit
    @jax.vmap
    def speeds(delay):
        params = twin.params | {"action_delay.push.delay": delay}
        start = twin.infer(jnp.zeros(2), params)
        return rollout(twin, params, start, jnp.asarray(pushes)[:, None]).states.v[:, 0]

    # The impulse until t is that of the commands, each held for 0.1 s, until t - delay.
    time, delays = 0.1 * np.arange(31), np.array([0.0, 0.03, 0.1, 0.125, 0.2])
    impulse = np.concatenate([[0.0], 0.1 * np.cumsum(pushes)])
    expected = [np.interp(np.maximum(time - delay, 0.0), time, impulse) for delay in delays]
    np.testing.assert_allclose(speeds(jnp.asarray(delays)), expected, rtol=1e-12, atol=1e-13)
