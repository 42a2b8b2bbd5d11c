"""What is left unexplained: how surely something is, among many things it may go with."""

import numpy as np
import pytest

from sb3_hds.sysid.comparison import unexplained
from sb3_hds.sysid.comparison.held_out import Split
from sb3_hds.sysid.comparison.unexplained import _by_chance, _predicted

N_SETS, N_UNITS = 11, 8


def agreements(rng, n_units=N_UNITS, n_windows=1):
    """Of sets of quantities that share most of what they predict; windows share some, too."""
    shape = (n_units, n_windows)
    shared, own = rng.standard_normal((1, *shape)), rng.standard_normal((N_SETS, *shape))
    common = rng.standard_normal((1, n_units, 1))
    found = 0.4 * common + np.sqrt(1.0 - 0.4**2) * (0.8 * shared + 0.6 * own)
    return found.reshape(N_SETS, -1), np.repeat(np.arange(n_units), n_windows)


@pytest.mark.parametrize(("n_units", "n_windows"), [(N_UNITS, 1), (N_UNITS, 16), (20, 1)])
def test_chance_is_that_of_the_best_among_all_sets(n_units, n_windows):
    rng = np.random.default_rng(0)
    best = [_by_chance(*agreements(rng, n_units, n_windows)).min() for _ in range(200)]
    # 200 draws at a level of 5 %: 10 are expected, more than 20 come once in 1000.
    assert np.sum(np.array(best) < 0.05) <= 20


def test_eight_recordings_are_enough_for_what_agrees_in_all_of_them():
    found, unit = agreements(np.random.default_rng(1))
    found *= 0.1
    found[3] = 1.0 + found[3]

    chance = _by_chance(found, unit)

    assert chance[3] == pytest.approx(2.0**-N_UNITS) and np.delete(chance, 3).min() > 0.05


def test_what_is_met_in_few_recordings_is_seen_in_their_windows():
    rng = np.random.default_rng(2)
    found, unit = rng.standard_normal((N_SETS, 8 * 20)), np.repeat(np.arange(8), 20)
    found[5, :60] += 3.0
    assert _by_chance(found, unit)[5] < 0.01


def test_of_many_windows_those_that_teach_come_from_all_recordings(monkeypatch):
    """The first recordings stay at one side, of which the force of the other is not learned."""
    monkeypatch.setattr(unexplained, "_MOST_WINDOWS", 40)
    position = np.linspace(-2.0, 2.0, 400)
    parts = Split(np.arange(400) // 10, np.arange(400) // 10 % 2 > 0)

    found = _predicted([position[:, None]], 3.0 * np.sin(3.0 * position), parts)

    assert found.gain > 0.6
