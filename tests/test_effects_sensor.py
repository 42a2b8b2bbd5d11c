"""What sensors report: too much, in another unit, late, the wrong way round."""

import jax.numpy as jnp
import numpy as np
import pytest
from cases import each
from free_mass import Mass, moved

from sb3_hds import twins
from sb3_hds.effects import SensorBias, SensorDelay, SensorScale, SignFlip, reversed_joint
from sb3_hds.errors import EffectError


@each(
    (SensorBias(bias=-0.3), lambda true: true - 0.3),
    (SensorScale(scale=1.2), lambda true: 1.2 * true),
    (SignFlip(flipped=1.0), lambda true: -true),
)
def test_a_channel_reports_this_and_the_others_the_truth(effect, reported, x64):
    twin = Mass().extend(effect.at("position"))
    pushes = np.random.default_rng(0).uniform(-1.0, 1.0, 20)
    start = twin.base.infer(jnp.array([0.5, 1.0]), twin.params)
    true = moved(Mass(), pushes, 0.5, 1.0).states

    # A mass that is inferred from a report stands where it truly is.
    inferred = twin.infer(twin.base.observe(start, {}), twin.params)
    result = moved(twin, pushes, float(reported(0.5)), 1.0)

    assert float(twin.observe(inferred, twin.params)[0]) == pytest.approx(0.5, rel=1e-14)
    np.testing.assert_allclose(result.states.q, true.q, rtol=1e-12)
    np.testing.assert_allclose(result.obs[:, 0], reported(true.q[:, 0]), rtol=1e-12)
    np.testing.assert_allclose(result.obs[:, 1], true.v[:, 0], rtol=1e-12)


@pytest.mark.parametrize("delay", [0.03, 0.2])
def test_a_late_sensor_reports_the_signal_shifted(x64, delay):
    # A uniform motion is linear between samples, so interpolation is exact.
    twin = Mass(dt=0.05).extend(SensorDelay("position", delay=delay))

    obs = moved(twin, np.zeros(30), position=4.0, speed=2.0).obs

    past = np.maximum(0.05 * np.arange(31) - delay, 0.0)
    np.testing.assert_allclose(obs[:, 0], 4.0 + 2.0 * past, rtol=1e-12)
    np.testing.assert_allclose(obs[:, 1], 2.0)


@each(
    ("CartPole", "track", ["position", "speed"]),
    ("Acrobot", "elbow", ["sin2", "rate2"]),
    (twins.make("Pendulum").extend(SensorBias("cos", bias=0.1)), 0, ["sin", "speed"]),
)
def test_a_joint_the_wrong_way_round_turns_what_is_odd_in_it(twin, joint, channels):
    flips = reversed_joint(twins.make(twin) if isinstance(twin, str) else twin, joint)
    assert all(isinstance(flip, SignFlip) and flip.values == {"flipped": 1.0} for flip in flips)
    assert [flip.where for flip in flips] == channels


def test_what_flips_cannot_say_is_refused():
    class Slope(Mass):
        """Its position is reported from another origin."""

        name = "Slope"

        def observe(self, state, params):
            return jnp.concatenate([state.q + 1.0, state.v])

    with pytest.raises(EffectError, match="Reversing rail changes more than the sign of: position"):
        reversed_joint(Slope(), "rail")
    with pytest.raises(EffectError, match=r"no joint 'hinge'. It has: rail"):
        reversed_joint(Mass(), "hinge")
