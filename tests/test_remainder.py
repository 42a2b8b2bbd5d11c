"""What is left unexplained: how surely something is, among many things it may go with."""

import numpy as np
import pytest

from sb3_hds.sysid.remainder import _by_chance

N_SETS, N_UNITS = 11, 8


def agreements(rng, n_units=N_UNITS):
    """Of sets of quantities that share most of what they predict."""
    shared = rng.standard_normal((1, n_units))
    return 0.8 * shared + 0.6 * rng.standard_normal((N_SETS, n_units))


@pytest.mark.parametrize("n_units", [N_UNITS, 20])
def test_chance_is_that_of_the_best_among_all_sets(n_units):
    rng = np.random.default_rng(0)
    best = [_by_chance(agreements(rng, n_units)).min() for _ in range(400)]
    # 400 draws at a level of 5 %: 20 are expected, more than 33 come once in 500.
    assert np.sum(np.array(best) < 0.05) <= 33


def test_eight_recordings_are_enough_for_what_agrees_in_all_of_them():
    found = 0.1 * agreements(np.random.default_rng(1))
    found[3] = 1.0 + 0.1 * found[3]

    chance = _by_chance(found)

    assert chance[3] == pytest.approx(2.0**-N_UNITS)
    assert np.delete(chance, 3).min() > 0.05
