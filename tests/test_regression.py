"""Scales that follow the plans."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import linen as nn

from sb3_hds.algos.twin.policy import Actor, Value, fresh_networks
from sb3_hds.algos.twin.regression import rescale
from sb3_hds.algos.twin.state import EpochState, Samples


def learner_after(n_epochs):
    key = jax.random.key(0, impl="unsafe_rbg")
    actor, value = Actor(1, (4,), nn.tanh), Value((4,), nn.tanh)
    networks, progress = fresh_networks(actor, value, 2, 1.0, key)
    return EpochState(networks, progress._replace(n_epochs=jnp.asarray(n_epochs)), None)


def samples(alive):
    obs = jnp.array([[1.0, 5.0], [3.0, 5.0], [100.0, 0.0]])
    control = jnp.array([[0.04], [0.01], [1.0]])
    return Samples(obs, control, jnp.zeros(3), jnp.ones(3), jnp.asarray(alive))


def test_the_first_plans_set_the_scales_and_dead_samples_do_not_count():
    learner = rescale(learner_after(0), samples([1.0, 1.0, 0.0]))

    inside = learner.networks.inside
    np.testing.assert_allclose(inside.mean, [2.0, 5.0], rtol=1e-6)
    # An input that does not move keeps the scale that it had, one.
    np.testing.assert_allclose(inside.scale, [1.0, 1.0], rtol=1e-6)
    # Geometric mean; the floor of 1e-3 is added to each size before.
    expected = np.sqrt(0.041 * 0.011)
    assert float(learner.progress.control_scale[0]) == pytest.approx(expected, rel=1e-5)
    # After three epochs, new plans count one half; an epoch without samples moves nothing.
    later = rescale(learner_after(3), samples([1.0, 1.0, 0.0]))
    np.testing.assert_allclose(later.networks.inside.mean, [1.0, 2.5], rtol=1e-6)
    same = rescale(learner, samples([0.0, 0.0, 0.0]))
    np.testing.assert_array_equal(same.networks.inside.mean, inside.mean)
    np.testing.assert_array_equal(same.progress.control_scale, learner.progress.control_scale)


def test_new_scales_leave_what_the_networks_compute():
    before, obs = learner_after(3), jnp.array([[0.3, -2.0], [4.0, 1.0]])

    after = rescale(before, samples([1.0, 1.0, 0.0]))

    networks = {"actor": Actor(1, (4,), nn.tanh), "value": Value((4,), nn.tanh)}
    for name, network in networks.items():
        old, new = (getattr(learner.networks, name) for learner in (before, after))
        expected = network.apply(old, before.networks.inside(obs))
        inside = after.networks.inside(obs)
        np.testing.assert_allclose(network.apply(new, inside), expected, rtol=1e-4)
        assert not np.allclose(network.apply(old, inside), expected, rtol=1e-2)
