"""Oscillators: their formulas, against integration and against sines."""

import math

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from sb3_hds.core.transforms import oscillators
from sb3_hds.core.transforms.oscillators import Gait

pytestmark = pytest.mark.usefixtures("x64")
TAU = 2.0 * math.pi


def gait(**changes) -> Gait:
    """The legs of HalfCheetah in the gait that the authors of the open-loop paper published."""
    given = {
        "amplitude": jnp.array([1.123, -1.910, -1.204]),
        "offset": jnp.array([-0.114, 0.075, 0.002]),
        "phase": TAU * jnp.array([0.0, 0.789, 0.316]),
        "omega_swing": jnp.asarray(TAU * 3.865),
        "omega_stance": jnp.asarray(TAU * 4.622),
    }
    return Gait(**(given | changes))


def apart(one, other) -> np.ndarray:
    """The angle between two phases, from 0 to pi."""
    return np.abs(np.angle(np.exp(1j * (np.asarray(one) - np.asarray(other)))))


def test_with_one_frequency_a_joint_follows_a_sine():
    omega, time = 3.0, 123.4
    one = gait(omega_swing=jnp.asarray(omega), omega_stance=jnp.asarray(omega))
    expected = one.amplitude * jnp.sin(omega * time + one.phase) + one.offset
    np.testing.assert_allclose(oscillators.target_at(one, time), expected, atol=1e-10)


def test_a_cycle_takes_half_a_turn_at_each_frequency():
    cycle = 0.5 / 3.865 + 0.5 / 4.622

    omegas = gait()[3:]
    phases = [oscillators.advance_phase(gait().phase, k * cycle, *omegas) for k in range(4)]

    assert float(oscillators.period(*omegas)) == pytest.approx(cycle)
    assert max(apart(phase, gait().phase).max() for phase in phases) < 1e-9
    # Half of it passes at the speed of the swing, which begins at 0.
    swung = oscillators.advance_phase(jnp.zeros(1), 0.5 / 3.865, *gait()[3:])
    assert swung[0] == pytest.approx(math.pi)


def test_commanded_amplitudes_follow_their_equation():
    radius, speed = jnp.array([0.2, 1.5]), jnp.array([3.0, -1.0])
    mu, gain = np.array([1.0, 2.0]), 50.0

    def rate(_, y):
        return np.concatenate([y[2:], gain * (gain / 4.0 * (mu - y[:2]) - y[2:])])

    solved = solve_ivp(rate, (0.0, 0.08), [0.2, 1.5, 3.0, -1.0], rtol=1e-10, atol=1e-12).y[:, -1]
    found = oscillators.advance_amplitude(radius, speed, jnp.array(mu), 0.08, gain)

    np.testing.assert_allclose(np.concatenate(found), solved, rtol=1e-7)
