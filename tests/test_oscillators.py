"""Oscillators: exact where there is a formula, else close to a fine reference."""

import math

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from sb3_hds.core import oscillators
from sb3_hds.core.oscillators import AmplitudeState, Gait, Hopf, HopfState

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

    phases = [oscillators.phase_at(gait(), k * cycle) for k in range(4)]

    assert float(oscillators.period(*gait()[3:])) == pytest.approx(cycle)
    assert max(apart(phase, gait().phase).max() for phase in phases) < 1e-9
    # Half of it passes at the speed of the swing, which begins at 0.
    swung = oscillators.advance_phase(jnp.zeros(1), 0.5 / 3.865, *gait()[3:])
    assert swung[0] == pytest.approx(math.pi)


def hopf(name: str, coupling: float = 2.0) -> Hopf:
    offsets = oscillators.coupling_offsets(jnp.array(oscillators.LEADS[name]))
    return Hopf(TAU * 3.0, TAU * 2.0, offsets, coupling)


def start() -> HopfState:
    return HopfState(jnp.array([0.3, 1.4, 0.8, 1.0]), jnp.array([0.1, 1.0, 4.0, 2.5]))


def test_coupled_oscillators_are_as_close_to_a_fine_reference_as_their_docstring_says():
    swing, stance, until = TAU * 2.0, TAU * 6.0, 0.3
    trot = hopf("trot")._replace(omega_swing=swing, omega_stance=stance)
    offsets = np.array(trot.offsets)

    def rate(_, y):
        radius, phase = y[:4], y[4:]
        pull = np.sin(phase[None, :] - phase[:, None] - offsets) @ radius
        omega = np.where(np.sin(phase) > 0.0, swing, stance)
        return np.r_[trot.alpha * (trot.mu - radius**2) * radius, omega + trot.coupling * pull]

    begun = np.concatenate([start().radius, start().phase])
    # The right-hand side jumps: steps are limited rather than trusted.
    expected = solve_ivp(rate, (0.0, until), begun, rtol=1e-8, max_step=1e-3).y[:, -1]
    found = oscillators.advance_hopf(start(), trot, until, 300)

    np.testing.assert_allclose(found.radius, expected[:4], atol=1e-3)
    # Two change-overs in each cycle of half a swing and half a stance, and one that is begun.
    changes = 2.0 * until / (math.pi / swing + math.pi / stance) + 1.0
    assert apart(found.phase, expected[4:]).max() < changes * 1e-3 * abs(swing - stance) + 1e-3


def test_weights_are_those_of_each_leg_on_each_leg():
    row = np.zeros((4, 4))
    row[1, 0] = 3.0  # the first leg leads the second; nobody pulls at the others
    led = hopf("trot")._replace(omega_swing=TAU * 2.0, coupling=jnp.array(row))
    begun = start()._replace(radius=jnp.ones(4))

    found = oscillators.advance_hopf(begun, led, 0.7, 1_000)

    assert apart(found.phase, begun.phase + 0.7 * TAU * 2.0)[[0, 2, 3]].max() < 1e-9
    # How far the second is from half a turn behind: d' = -w sin d.
    behind = float(begun.phase[1] - begun.phase[0]) + math.pi
    expected = 2.0 * math.atan(math.tan(0.5 * behind) * math.exp(-3.0 * 0.7))
    assert apart(found.phase[1] - found.phase[0] + math.pi, expected) < 1e-6


def test_commanded_amplitudes_follow_their_equation():
    begun = AmplitudeState(jnp.array([0.2, 1.5]), jnp.array([3.0, -1.0]), jnp.array([0.0, 6.0]))
    mu, omega, gain = np.array([1.0, 2.0]), np.array([9.0, 20.0]), 50.0

    def rate(_, y):
        return np.concatenate([y[2:], gain * (gain / 4.0 * (mu - y[:2]) - y[2:])])

    solved = solve_ivp(rate, (0.0, 0.08), [0.2, 1.5, 3.0, -1.0], rtol=1e-10, atol=1e-12).y[:, -1]
    found = oscillators.advance_amplitude(begun, jnp.array(mu), jnp.array(omega), 0.08, gain)

    np.testing.assert_allclose([*found.radius, *found.speed], solved, rtol=1e-7)
    assert apart(found.phase, np.array(begun.phase) + 0.08 * omega).max() < 1e-12
