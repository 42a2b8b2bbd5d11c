"""Velocities that were computed late are moved back before a diagnosis, and not named a delay."""

import numpy as np
import pytest
from measuring import measured

from sb3_hds import Trajectories, twins
from sb3_hds.sysid.timing import in_step

pytestmark = pytest.mark.usefixtures("quick_compilation")


def axis_data(dt=0.01, noise=1e-4):
    """Positions of an axis with the noise of an encoder, and their backward differences."""
    twin = twins.make("LinearAxis", mass=2.0, dt=dt)
    rng = np.random.default_rng(0)
    force = 5.0 * np.sin(0.2 * rng.standard_normal((6, 200, 1)).cumsum(1))
    clean = measured(twin, n=6, n_steps=200, commands=force)
    q = clean.obs[..., 0] + noise * rng.standard_normal((6, 201))
    obs = np.stack([q[:, 1:], np.diff(q, axis=1) / dt], -1)
    return twin, Trajectories.from_arrays(obs, list(clean.actions[:, 1:]), dt=dt)


def test_a_backward_difference_is_moved_by_half_a_sample_and_said():
    twin, data = axis_data()

    moved, words = in_step(twin, data)

    assert words == (
        "axis_velocity is the backward difference of axis_position, and so 5 ms (0.5 samples) "
        "late; it was moved back. No sensor delays it.",
    )
    central = np.gradient(moved.obs[..., 0], 0.01, axis=1)[:, 1:-1]
    np.testing.assert_allclose(moved.obs[:, 1:-1, 1], central, atol=5e-3)


def test_a_velocity_that_the_twin_computes_in_the_same_way_stays():
    twin = twins.make("CartPole")
    data = measured(twin, n_steps=200)

    assert in_step(twin, data) == (data, ())
