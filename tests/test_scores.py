"""Confirming a cause by the side to which errors lean, and how sure few recordings make a fit."""

from types import SimpleNamespace

import numpy as np
import pytest

from sb3_hds.sysid.comparison.halves import Half
from sb3_hds.sysid.comparison.held_out import by_scores, t_test
from sb3_hds.sysid.comparison.inference import standard_errors
from sb3_hds.sysid.estimation.evidence import Point, Slopes

N_UNITS, N_WINDOWS, N_ROWS = 4, 3, 50
UNIT = np.repeat(np.arange(N_UNITS), N_WINDOWS)


def coloured(rng, shape, colour):
    noise = rng.standard_normal(shape)
    for row in range(1, shape[1]):
        noise[:, row] += colour * noise[:, row - 1]
    return noise


def errors(rng, effect, colour=0.0, common=0.0, guess=0.3, excited=1.0):
    """What a model without an effect leaves of windows, and one that has guessed its size."""
    shape = (N_UNITS * N_WINDOWS, N_ROWS, 1)
    noise = coloured(rng, shape, colour)
    noise += common * coloured(rng, (N_UNITS, N_ROWS, 1), colour)[UNIT]
    shown = np.broadcast_to(np.asarray(excited, float), shape[:1])[:, None, None]
    reach = shown * np.linspace(0.0, 1.0, N_ROWS)[:, None]
    return noise - (effect - guess) * reach, noise - effect * reach, UNIT


@pytest.mark.parametrize(("colour", "common"), [(0.0, 0.0), (0.9, 0.0), (0.9, 1.0)])
def test_a_model_that_is_right_is_beaten_as_rarely_as_the_level_says(colour, common):
    rng = np.random.default_rng(0)
    alarms = sum(by_scores(*errors(rng, 0.0, colour, common)) < 0.025 for _ in range(400))
    # Binomial(400, 0.025) is above 20 once in 1000 cases.
    assert alarms <= 20


def test_an_effect_that_recordings_show_unevenly_is_confirmed():
    """Gains between a tenth and nine tenths scatter, but they are no chance."""
    excited = np.repeat([0.6, 1.0, 6.0, 4.0], N_WINDOWS)
    new, old, unit = errors(np.random.default_rng(1), 1.0, guess=0.9, excited=excited)
    by_gain = t_test(*(np.mean(r**2, (1, 2)) for r in (new, old)), unit)
    assert by_gain.gain > 0.3 and by_gain.p_value > 0.025 and by_scores(new, old, unit) < 0.01


def test_a_wrong_direction_equal_models_and_a_single_recording_confirm_nothing():
    new, old, unit = errors(np.random.default_rng(2), 1.0, guess=-1.0)
    assert by_scores(new, old, unit) > 0.5 and by_scores(old, old, unit) == 1.0
    assert by_scores(0.5 * old, old, np.zeros_like(unit)) == 1.0


def test_standard_errors_are_as_large_as_estimates_scatter():
    """Of a mean, in units whose noise is common to their windows; the sandwich is a tenth less."""
    rng, scale, n_units = np.random.default_rng(4), 2.0, 6
    unit = np.repeat(np.arange(n_units), 3)
    reported, estimates = [], []
    for _ in range(2000):
        measured = rng.standard_normal(n_units)[unit] + 0.3 * rng.standard_normal(len(unit))
        scores = (measured.mean() - measured)[:, None] * scale
        curvature = np.full((len(unit), 1, 1), scale**2)
        evidence = SimpleNamespace(
            slopes=lambda point, free, s=scores, c=curvature: Slopes(c, s),
            hypotheses=SimpleNamespace(scale=np.array([scale])),
        )
        point = Point(np.zeros(1), np.zeros((1, 1)), np.zeros((1, 1, 1)), 0.0)
        reported.append(standard_errors(Half(evidence, unit, np.zeros(1)), point, [0])[0])
        estimates.append(measured.mean())
    # Both are known to about 2 %.
    assert np.sqrt(np.mean(np.square(reported))) == pytest.approx(np.std(estimates), rel=0.06)
