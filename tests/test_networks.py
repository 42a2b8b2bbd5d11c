"""Networks, their settings, and pytrees as tensors."""

from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch as th
from cases import each
from gymnasium import spaces
from stable_baselines3.common.utils import FloatSchedule

from sb3_hds.algos import TwinPolicy
from sb3_hds.algos.nets.options import ACTIVATIONS, activation
from sb3_hds.algos.twin import policy as nets
from sb3_hds.algos.twin.policy import Actor, value_of


class Scales(NamedTuple):
    mean: np.ndarray
    scale: np.ndarray


def policy(low: float = -1.0, high: float = 1.0, **kwargs) -> TwinPolicy:
    seen, done = spaces.Box(-1.0, 1.0, (3,)), spaces.Box(low, high, (2,))
    return TwinPolicy(seen, done, FloatSchedule(1e-3), **kwargs)


def widths(weights) -> list[int]:
    layers = weights["params"].values()
    return [layer["bias"].shape[0] for layer in layers if "bias" in layer]


def test_a_torch_module_stands_for_the_same_function():
    x = np.linspace(-8.0, 8.0, 33, dtype=np.float32)

    for module in (th.nn.GELU, th.nn.GELU(approximate="tanh"), th.nn.Hardsigmoid, th.sigmoid):
        theirs = module() if isinstance(module, type) else module
        # Single precision, and torch's own approximations.
        expected = theirs(th.as_tensor(x)).numpy()
        np.testing.assert_allclose(activation(module)(jnp.asarray(x)), expected, atol=1e-6)


def test_names_in_any_spelling_and_functions_of_jax_are_activations():
    def softplus(x):
        return jnp.log1p(jnp.exp(2.0 * x))

    for name, function in ACTIVATIONS.items():
        assert activation(name.upper()) is activation(name.replace("_", "")) is function
    # A function of one's own may have a known name.
    for own in (nn.silu, jnp.sin, softplus):
        assert activation(own) is own
    assert activation(th.nn.functional.softplus) is nn.softplus
    assert activation(th.nn.ReLU()) is nn.relu


@each(
    ("sigmoids", "must be one of tanh, relu"),
    (np.tanh, "no JAX function"),
    (jnp.sum, "must keep the shape"),
    (th.nn.ELU(alpha=0.5), "settings of its own"),
    (type("ReLU", (th.nn.ReLU,), {}), "settings of its own"),
)
def test_what_is_no_activation_is_refused(wrong, message):
    with pytest.raises(ValueError, match=message):
        activation(wrong)


def test_a_value_is_a_signed_root_less_squares():
    # u(2) = 2 * (2 + 0.3), u(-2) the same below zero.
    assert value_of(jnp.array([2.0, 0.0, 0.0])) == pytest.approx(4.6)
    assert value_of(jnp.array([-2.0, 1.0, -3.0])) == pytest.approx(-4.6 - 1.0 - 9.0)
    value = jnp.array([-1e4, -20.0, -1e-3, 0.0, 1.0, 1e4])
    # Single precision.
    np.testing.assert_allclose(
        nets.value_of_root(nets.root_of_value(value)), value, rtol=1e-4, atol=1e-7
    )
    assert (jnp.diff(nets.root_of_value(value)) > 0.0).all()


def test_what_an_actor_computes_does_not_change_with_the_scales_of_its_input():
    actor, obs = Actor(2, (8,), nn.tanh), jax.random.normal(jax.random.key(0), (9, 3))
    drawn = actor.init(jax.random.key(1), obs[0])
    weights = jax.tree.map(lambda leaf: leaf + 0.3, drawn)
    old = Scales(np.array([0.1, 0.0, -2.0]), np.array([1.0, 2.0, 0.5]))
    new = Scales(np.array([0.4, -1.0, 1.0]), np.array([3.0, 0.2, 0.7]))

    moved = nets.with_input_scales(weights, old, new)

    before = actor.apply(weights, (obs - old.mean) / old.scale)
    # Single precision.
    after = actor.apply(moved, (obs - new.mean) / new.scale)
    np.testing.assert_allclose(after, before, rtol=1e-4, atol=1e-5)


def test_a_linear_path_leads_past_the_hidden_layers_unless_it_is_switched_off():
    actor, obs = Actor(1, (4,), nn.tanh), jnp.ones(3)
    drawn = actor.init(jax.random.key(0), obs)
    # The last layer's weights have standard deviation 0.01 / 2.
    assert abs(float(actor.apply(drawn, obs)[0])) < 0.1

    still = jax.tree.map(jnp.zeros_like, drawn["params"])
    still |= {"linear": {"kernel": jnp.full((3, 1), 0.1)}}
    assert actor.apply({"params": still}, obs) == pytest.approx(np.tanh(0.3))
    assert policy().actor_network.linear_path
    assert "linear" not in policy(linear_path=False).networks.actor["params"]


def test_net_arch_sets_the_widths_of_both_networks():
    for net_arch, pi, vf in (([], [2], [9]), ({"pi": [4, 3]}, [4, 3, 2], [64, 64, 9])):
        networks = policy(net_arch=net_arch).networks
        assert widths(networks.actor) == pi and widths(networks.value) == vf


def test_rounding_does_not_lead_out_of_the_bounds():
    low, high = np.float32(-2.0), np.float32(0.2)
    # What makes this case one: SB3's formula gives more than the upper bound here.
    assert low + np.float32(0.5) * np.float32(2.0) * (high - low) > high

    actions = policy(low, high).unscale_action(np.array([[1.0, -1.0]], np.float32))

    assert actions.tolist() == [[float(high), float(low)]]
