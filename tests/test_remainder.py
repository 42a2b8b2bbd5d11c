"""What is left unexplained: how surely something is, among many things it may go with."""

import numpy as np
import pytest

from sb3_hds.core import Joint, Trajectories
from sb3_hds.sysid.comparison import unexplained
from sb3_hds.sysid.comparison.held_out import Split
from sb3_hds.sysid.comparison.unexplained import (
    ResidualForce,
    _by_chance,
    _predicted,
    predictable_force,
)

N_SETS, N_UNITS = 11, 8


def agreements(rng, n_units=N_UNITS, n_windows=1):
    """Of sets of quantities that share most of what they predict; windows share some, too."""
    shape = (n_units, n_windows)
    shared, own = rng.standard_normal((1, *shape)), rng.standard_normal((N_SETS, *shape))
    common = rng.standard_normal((1, n_units, 1))
    found = 0.4 * common + np.sqrt(1.0 - 0.4**2) * (0.8 * shared + 0.6 * own)
    return found.reshape(N_SETS, -1), np.repeat(np.arange(n_units), n_windows)


def chance_of(agreement, unit):
    """:return: p-values of sets at a single joint"""
    return _by_chance(agreement[None], unit)[0]


@pytest.mark.parametrize(
    ("n_units", "n_windows", "n_joints"),
    [(N_UNITS, 1, 1), (N_UNITS, 16, 1), (20, 1, 1), (N_UNITS, 1, 3), (20, 1, 3)],
)
def test_chance_is_that_of_the_best_among_all_sets_and_joints(n_units, n_windows, n_joints):
    rng, best = np.random.default_rng(0), []
    for _ in range(200):
        found, units = zip(
            *(agreements(rng, n_units, n_windows) for _ in range(n_joints)), strict=True
        )
        best.append(_by_chance(np.stack(found), units[0]).min())
    # 200 draws at a level of 5 %: 10 are expected, more than 20 come once in 1000.
    assert np.sum(np.array(best) < 0.05) <= 20


def test_eight_recordings_are_enough_for_what_agrees_in_all_of_them():
    found, unit = agreements(np.random.default_rng(1))
    found *= 0.1
    found[3] = 1.0 + found[3]

    chance = chance_of(found, unit)

    assert chance[3] == pytest.approx(2.0**-N_UNITS) and np.delete(chance, 3).min() > 0.05


def test_what_is_met_in_few_recordings_is_seen_in_their_windows():
    rng = np.random.default_rng(2)
    found, unit = rng.standard_normal((N_SETS, 8 * 20)), np.repeat(np.arange(8), 20)
    found[5, :60] += 3.0
    assert chance_of(found, unit)[5] < 0.01


def test_of_many_windows_those_that_teach_come_from_all_recordings(monkeypatch):
    """The first recordings stay at one side, of which the force of the other is not learned."""
    monkeypatch.setattr(unexplained, "_MOST_WINDOWS", 40)
    position = np.linspace(-2.0, 2.0, 400)
    parts = Split(np.arange(400) // 10, np.arange(400) // 10 % 2 > 0)

    found = _predicted([position[:, None]], 3.0 * np.sin(3.0 * position), parts)

    assert found.gain > 0.6


def test_what_one_of_many_joints_meets_in_few_recordings_is_seen_in_its_windows():
    rng = np.random.default_rng(2)
    found, unit = rng.standard_normal((6, N_SETS, 8 * 20)), np.repeat(np.arange(8), 20)
    found[1, 5, :60] += 3.0
    found[4] *= 100.0

    chance = _by_chance(found, unit)

    assert chance[1, 5] < 0.01 and np.delete(chance, 1, 0).min() > 0.05


def test_the_force_of_one_of_two_joints_in_few_recordings_is_left_over():
    rng, n = np.random.default_rng(4), N_UNITS * 20
    position, velocity = rng.standard_normal((2, n, 2))
    origin, forces = np.repeat(np.arange(N_UNITS), 20), rng.standard_normal((n, 2))
    forces[:, 0] += 3.0 * np.sign(position[:, 0]) * (origin < 3)
    residual = ResidualForce(
        force=forces,
        stderr=np.ones((n, 2)),
        position=position,
        velocity=velocity,
        command=rng.standard_normal((n, 2)),
        time=np.tile(np.arange(20.0), N_UNITS),
        origin=origin,
        numbers=10,
        noise=np.ones(1),
    )
    data = Trajectories.from_arrays(np.zeros((N_UNITS, 21, 1)), np.zeros((N_UNITS, 20, 1)), dt=0.1)

    found = predictable_force(residual, data, [Joint("hip"), Joint("knee")], seed=0)

    assert found is not None and (found.joint, found.goes_with) == ("hip", ("position",))
