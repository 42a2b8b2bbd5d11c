"""The best of a catalogue by chance, and intervals where the likelihood is no parabola."""

from types import SimpleNamespace

import numpy as np
import pytest

from sb3_hds.sysid.comparison.inference import family_p_value, profiled
from sb3_hds.sysid.estimation.evidence import Point, Slopes

N_WINDOWS, N_ROWS, N_CANDIDATES = 30, 40, 25


def linear(rng, effect=0.0, colour=0.95):
    """Slopes of coloured windows at the best candidate's fit, and what that gains."""
    by_theta = rng.standard_normal((N_WINDOWS, N_ROWS, 1 + N_CANDIDATES)).cumsum(1) / 5.0
    noise = rng.standard_normal((N_WINDOWS, N_ROWS))
    for row in range(1, N_ROWS):
        noise[:, row] += colour * noise[:, row - 1]
    error = noise - effect * by_theta[..., 1]
    curvature = np.einsum("nri,nrj->nij", by_theta, by_theta)

    def best_with(index):
        theta = np.zeros(1 + N_CANDIDATES)
        total = curvature.sum(0)[np.ix_(index, index)]
        theta[index] = -np.linalg.solve(total, np.einsum("nri,nr->i", by_theta[..., index], error))
        left = error + by_theta @ theta
        return 0.5 * np.sum(left**2), np.einsum("nri,nr->ni", by_theta, left)

    without, _ = best_with([0])
    every = [best_with([0, 1 + c]) for c in range(N_CANDIDATES)]
    cost, scores = min(every, key=lambda found: found[0])
    return Slopes(curvature, scores), without - cost


def chance(slopes, gain):
    return family_p_value(slopes, [[1 + c] for c in range(N_CANDIDATES)], [0], [0, 1], gain)


@pytest.mark.parametrize("colour", [0.0, 0.95])
def test_the_best_of_many_candidates_passes_on_null_data_at_the_nominal_rate(colour):
    rng = np.random.default_rng(0)
    alarms = sum(chance(*linear(rng, colour=colour)) < 0.05 for _ in range(100))
    # Binomial(100, 0.05) is above 12 once in 500 cases. A chi-square test of the best candidate
    # that takes the noise for white would alarm nearly always under the coloured one.
    assert alarms <= 12


def test_a_cause_is_beyond_chance():
    rng = np.random.default_rng(1)
    assert chance(*linear(rng, effect=5.0)) == pytest.approx(0.001)


class Curve:
    """Evidence whose cost, as a function of one parameter and a nuisance, is written down."""

    def __init__(self, cost, lower=-np.inf, upper=np.inf):
        self.cost = cost
        self.hypotheses = SimpleNamespace(
            scale=np.array([2.0, 0.5]),
            lower=np.array([lower, -np.inf]),
            upper=np.array([upper, np.inf]),
        )

    def fit(self, theta, free, offsets, n_steps):
        assert list(free) == [1]
        # The nuisance takes half of what the parameter does.
        theta = np.array([theta[0], -0.5 * theta[0]])
        return Point(theta, offsets, np.zeros((1, 1, 1)), self.cost(theta[0]))

    def slopes(self, point, index):
        # Curvature 4 along the profile, in units of the parameter: cost = 2 x^2.
        whole = np.array([[4.0 + 0.25 * 8.0, 0.5 * 8.0], [0.5 * 8.0, 8.0]])
        order = list(index)
        scale = self.hypotheses.scale[order]
        return Slopes((whole[np.ix_(order, order)] * np.outer(scale, scale))[None], None)


def interval(cost, **bounds):
    best = Point(np.zeros(2), np.zeros((1, 1)), np.zeros((1, 1, 1)), cost(0.0))
    return profiled(Curve(cost, **bounds), best, [0, 1], 0, reach=0.3)


def test_the_interval_of_a_parabola_is_symmetric():
    np.testing.assert_allclose(interval(lambda x: 7.0 + 2.0 * x**2), (-0.3, 0.3))


def test_a_likelihood_that_falls_slower_on_one_side_makes_the_interval_longer_there():
    low, high = interval(lambda x: 2.0 * x**2 if x < 0.0 else 0.125 * x**2)
    assert low == pytest.approx(-0.3, rel=0.1) and high == pytest.approx(1.2, rel=0.1)


def test_where_the_data_do_not_mind_the_interval_ends_at_the_bound():
    low, high = interval(lambda x: 2.0 * max(x, 0.0) ** 2, lower=-1.5)
    assert low == -1.5 and high == pytest.approx(0.3, rel=0.1)
