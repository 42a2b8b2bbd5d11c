"""Oscillators: exact where there is a formula, else close to a fine reference; differentiable."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from sb3_hds.core import oscillators
from sb3_hds.core.oscillators import AmplitudeState, Gait, Hopf, HopfState

pytestmark = pytest.mark.usefixtures("x64", "quick_compilation")
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


def euler_phases(gait: Gait, until: float, h: float) -> np.ndarray:
    """The phases by explicit Euler steps, as the published scripts integrate them."""
    phase = np.array(gait.phase)
    swing, stance = float(gait.omega_swing), float(gait.omega_stance)
    for _ in range(round(until / h)):
        phase = phase + h * np.where(np.sin(phase) > 0.0, swing, stance)
    return phase


def apart(one, other) -> np.ndarray:
    """The angle between two phases, from 0 to pi."""
    return np.abs(np.angle(np.exp(1j * (np.asarray(one) - np.asarray(other)))))


def central_difference(function, x: float, h: float = 1e-6) -> np.ndarray:
    return (np.asarray(function(x + h)) - np.asarray(function(x - h))) / (2.0 * h)


def test_with_one_frequency_a_joint_follows_a_sine():
    omega = 3.0
    one = gait(omega_swing=jnp.asarray(omega), omega_stance=jnp.asarray(omega))

    for time in (0.0, 0.1, 7.3, 123.4):
        expected = one.amplitude * jnp.sin(omega * time + one.phase) + one.offset
        np.testing.assert_allclose(oscillators.target_at(one, time), expected, atol=1e-10)


def test_a_cycle_takes_half_a_turn_at_each_frequency():
    cycle = 0.5 / 3.865 + 0.5 / 4.622

    phases = [oscillators.phase_at(gait(), k * cycle) for k in range(4)]

    assert float(oscillators.period(gait().omega_swing, gait().omega_stance)) == pytest.approx(
        cycle
    )
    assert max(apart(phase, gait().phase).max() for phase in phases) < 1e-9
    # Half of it passes at the speed of the swing, which begins at 0.
    swung = oscillators.advance_phase(jnp.zeros(1), 0.5 / 3.865, *gait()[3:])
    assert swung[0] == pytest.approx(math.pi)


def test_euler_steps_converge_to_the_exact_phase_at_first_order():
    exact, steps = oscillators.phase_at(gait(), 1.0), (1e-2, 1e-3, 1e-4)

    errors = [apart(euler_phases(gait(), 1.0, h), exact).max() for h in steps]

    # An Euler step changes over late by up to itself, nine times in a second.
    late = 9 * abs(TAU * (4.622 - 3.865))
    assert all(error <= h * late for error, h in zip(errors, steps, strict=True))
    assert errors[2] < 0.1 * errors[0]


@pytest.mark.parametrize("field", ["offset", "phase", "omega_swing"])
def test_targets_have_the_derivatives_that_finite_differences_give(field):
    # A joint that starts exactly at a change-over has no derivative by its phase.
    phase = TAU * jnp.array([0.1, 0.789, 0.316])

    def targets(shift):
        changed = gait(**({"phase": phase} | {field: getattr(gait(phase=phase), field) + shift}))
        return oscillators.target_at(changed, 1.7)

    forward = jax.jacfwd(targets)(0.0)

    np.testing.assert_allclose(forward, central_difference(targets, 0.0), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(jax.jacrev(targets)(0.0), forward, rtol=1e-9, atol=1e-12)
    assert np.abs(forward).max() > 0.1


def hopf(name: str, coupling: float = 2.0) -> Hopf:
    offsets = oscillators.coupling_offsets(jnp.array(oscillators.LEADS[name]))
    return Hopf(TAU * 3.0, TAU * 2.0, offsets, coupling)


def reference(state: HopfState, hopf: Hopf, until: float) -> tuple[np.ndarray, np.ndarray]:
    """
    Radii and phases by explicit Euler steps of 5 microseconds, whose error is below 1e-3 rad.

    An adaptive method of high order would be no better: the right-hand side jumps.
    """
    radius, phase = np.array(state.radius), np.array(state.phase)
    offsets, h = np.array(hopf.offsets), 5e-6
    for _ in range(round(until / h)):
        ahead = np.sin(phase[None, :] - phase[:, None] - offsets)
        pull = (hopf.coupling * ahead * radius[None, :]).sum(1)
        omega = np.where(np.sin(phase) > 0.0, hopf.omega_swing, hopf.omega_stance)
        radius = radius + h * hopf.alpha * (hopf.mu - radius**2) * radius
        phase = phase + h * (omega + pull)
    return radius, phase


def start() -> HopfState:
    return HopfState(jnp.array([0.3, 1.4, 0.8, 1.0]), jnp.array([0.1, 1.0, 4.0, 2.5]))


def test_coupled_oscillators_are_as_close_to_a_fine_reference_as_their_docstring_says():
    swing, stance = TAU * 2.0, TAU * 6.0
    trot = hopf("trot")._replace(omega_swing=swing, omega_stance=stance)
    radius, phase = reference(start(), trot, 0.3)

    coarse, fine = (oscillators.advance_hopf(start(), trot, 0.3, n) for n in (300, 3000))

    np.testing.assert_allclose(coarse.radius, radius, atol=1e-3)
    # Two change-overs in each cycle of half a swing and half a stance, and one that is begun.
    changes = 2.0 * 0.3 / (math.pi / swing + math.pi / stance) + 1.0
    for found, h in ((coarse, 1e-3), (fine, 1e-4)):
        # The reference itself is 5e-6 s late at each of them, and errs by 1e-3 rad.
        late = changes * (h + 5e-6) * abs(swing - stance)
        assert apart(found.phase, phase).max() < late + 1e-3


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


def test_an_uncoupled_amplitude_follows_the_solution_of_its_equation():
    # With mu = 1, the logistic equation in r squared: r(t)^2 = 1 / (1 + (1/r0^2 - 1) e^(-2 a t)).
    free = hopf("trot", coupling=0.0)._replace(alpha=5.0)
    time, radius = 0.3, np.array(start().radius)

    found = oscillators.advance_hopf(start(), free, time, substeps=100)

    expected = 1.0 / np.sqrt(1.0 + (radius**-2 - 1.0) * np.exp(-10.0 * time))
    np.testing.assert_allclose(found.radius, expected, atol=1e-7)


@pytest.mark.parametrize("name", ["walk", "trot"])
def test_coupling_leads_every_leg_into_the_gait(name):
    lead = np.array(oscillators.LEADS[name])
    same = hopf(name)._replace(omega_swing=TAU * 2.0)
    # Near the gait: from a perfect antiphase, in balance, nothing would move.
    disturbed = HopfState(jnp.ones(4), jnp.array(lead + np.array([0.3, -0.4, 0.2, 0.5])))

    found = oscillators.advance_hopf(disturbed, same, 5.0, substeps=2_000)

    assert apart(found.phase - found.phase[0], lead - lead[0]).max() < 1e-3
    # One leg after the other in a walk, diagonal legs together in a trot.
    expected = TAU * np.arange(4) / 4 if name == "walk" else [0.0, 0.0, math.pi, math.pi]
    np.testing.assert_allclose(np.sort(lead), expected)
    assert name == "walk" or lead[0] == lead[3]


def test_coupled_oscillators_have_the_derivatives_that_finite_differences_give():
    # With one frequency: a jump of the frequency has no derivative at the jump itself.
    same = hopf("walk")._replace(omega_swing=TAU * 2.0)

    def end(coupling):
        return oscillators.advance_hopf(start(), same._replace(coupling=coupling), 0.2, 40).phase

    expected = central_difference(end, 2.0)
    np.testing.assert_allclose(jax.jacfwd(end)(2.0), expected, rtol=1e-5, atol=1e-7)
    assert np.abs(expected).max() > 1e-2


def test_commanded_amplitudes_follow_their_equation():
    begun = AmplitudeState(jnp.array([0.2, 1.5]), jnp.array([3.0, -1.0]), jnp.array([0.0, 6.0]))
    mu, omega, gain = np.array([1.0, 2.0]), np.array([9.0, 20.0]), 50.0

    def rate(_, y):
        return np.concatenate([y[2:], gain * (gain / 4.0 * (mu - y[:2]) - y[2:])])

    solved = solve_ivp(rate, (0.0, 0.08), [0.2, 1.5, 3.0, -1.0], rtol=1e-10, atol=1e-12).y[:, -1]
    found = oscillators.advance_amplitude(begun, jnp.array(mu), jnp.array(omega), 0.08, gain)

    np.testing.assert_allclose([*found.radius, *found.speed], solved, rtol=1e-7)
    assert apart(found.phase, np.array(begun.phase) + 0.08 * omega).max() < 1e-12


@pytest.mark.parametrize(("name", "at"), [("mu", 1.3), ("gain", 150.0)])
def test_commanded_amplitudes_have_the_derivatives_that_finite_differences_give(name, at):
    begun = AmplitudeState(jnp.array([0.2]), jnp.array([3.0]), jnp.array([0.0]))

    def end(value):
        given = {"mu": 1.3, "omega": 9.0, "dt": 0.02, "gain": 150.0} | {name: value}
        given["mu"] = jnp.array([1.0]) * given["mu"]
        after = oscillators.advance_amplitude(begun, **given)
        return after.radius * jnp.sin(after.phase)

    expected = central_difference(end, at)
    np.testing.assert_allclose(jax.jacfwd(end)(at), expected, rtol=1e-5)
    np.testing.assert_allclose(jax.jacrev(end)(at), expected, rtol=1e-5)
    assert np.abs(expected).max() > 1e-4
