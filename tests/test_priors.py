"""What is believed of a parameter that data refit."""

import numpy as np
import pytest

from sb3_hds.core import Channel, Parameter
from sb3_hds.errors import CalibrationError
from sb3_hds.sysid.checks.adequacy import distances, far_in_words
from sb3_hds.sysid.estimation.parameters import at_limit, prior_of
from sb3_hds.sysid.measurements import white_noise

MASS = Parameter(null=1.0, scale=0.1, unit="kg", lower=1e-6)
DAMPING = Parameter(null=0.0, scale=0.1, unit="N s/m", lower=0.0)


def test_a_prior_is_as_wide_as_the_scale_in_proportion_to_the_value_and_ends_at_twenty_times_it():
    assert prior_of("mass", MASS, 8.0).deviation == pytest.approx(1.6)
    assert prior_of("mass", MASS, 0.1).deviation == pytest.approx(0.1)
    assert prior_of("damping", DAMPING, 200.0).deviation == pytest.approx(40.0)
    assert prior_of("mass", MASS, 1.0, belief=3.0).deviation == pytest.approx(0.6)
    assert prior_of("mass", MASS, 2.0)[1:] == pytest.approx((0.1, 40.0))
    assert prior_of("mass", MASS, 2.0, belief=(1.0, 3.0))[1:] == (1.0, 3.0)
    assert prior_of("damping", DAMPING, 0.0)[1:] == (0.0, np.inf)
    # A bound where the value was believed to be is no news.
    assert at_limit(40.0, 0.1, 40.0, believed=2.0) and not at_limit(0.0, 0.0, np.inf, believed=0.0)
    assert not at_limit(2.1, 0.1, 40.0, believed=2.0)


@pytest.mark.parametrize("belief", [0.0, True, "much", (3.0, 4.0), (1.0,)])
def test_what_is_no_belief_is_refused(belief):
    with pytest.raises(CalibrationError, match="mass"):
        prior_of("mass", MASS, 2.0, belief=belief)


def test_noise_is_distinguished_from_a_smooth_motion():
    rng, t = np.random.default_rng(0), 0.01 * np.arange(2001)
    obs = np.stack([np.sin(3.0 * t), 3.0 * np.cos(3.0 * t)], 1)
    noisy = obs + rng.standard_normal(obs.shape) * [1e-3, 0.05]

    assert white_noise([noisy]) == pytest.approx([1e-3, 0.05], rel=0.1)


def test_large_deviations_are_reported_in_the_unit_of_the_channel_and_as_shares():
    channels = Channel("angle", "rad"), Channel("speed", "rad/s")
    residual = np.broadcast_to([0.5, 0.02], (4, 10, 2))
    found = distances(channels, residual, np.array([0.01, 0.01]), np.array([1.0, 1.0]))

    assert [one.near for one in found] == [False, True]
    assert "angle by 0.5 rad, 50% of its standard deviation" in far_in_words(found)
    assert far_in_words(found[1:]) == ""


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_deviations_are_as_large_whatever_the_unit(unit):
    channels = (Channel("angle", "rad"),)
    residual = np.full((4, 10, 1), 0.5)
    residual[0, 5] = np.nan
    (found,) = distances(channels, unit * residual, unit * np.array([0.01]), unit * np.array([1.0]))

    assert found.error == pytest.approx(unit * np.sqrt((39 * 0.25 + 1e6) / 40))
