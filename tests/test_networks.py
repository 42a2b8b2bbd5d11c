"""Networks, their settings, and pytrees as tensors."""

from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.utils import FloatSchedule

from sb3_hds.algos import TwinPolicy
from sb3_hds.algos import networks as nets
from sb3_hds.algos.networks import ACTIVATIONS, Actor, Value, activation, value_of
from sb3_hds.algos.persistence import from_state_dict, to_state_dict

pytestmark = pytest.mark.usefixtures("quick_compilation")

ROOTS = 9


class Pair(NamedTuple):
    first: dict
    second: jax.Array


class Scales(NamedTuple):
    mean: jax.Array
    scale: jax.Array


def tree(fill: float) -> Pair:
    return Pair({"kernel": jnp.full((2, 3), fill), "count": jnp.int32(7)}, jnp.full((), fill))


def policy(low: float = -1.0, high: float = 1.0, **kwargs) -> TwinPolicy:
    return TwinPolicy(
        spaces.Box(-1.0, 1.0, (3,)), spaces.Box(low, high, (2,)), FloatSchedule(1e-3), **kwargs
    )


def widths(weights) -> list[int]:
    layers = weights["params"].values()
    return [layer["bias"].shape[0] for layer in layers if "bias" in layer]


@pytest.mark.parametrize(
    "module",
    [
        th.nn.ReLU,
        th.nn.GELU,
        lambda: th.nn.GELU(approximate="tanh"),
        lambda: th.nn.functional.gelu,
        th.nn.Mish,
        th.nn.Hardsigmoid,
        lambda: th.sigmoid,
    ],
)
def test_a_torch_module_stands_for_the_same_function(module):
    x = np.linspace(-8.0, 8.0, 33, dtype=np.float32)

    ours = activation(module if isinstance(module, type) else module())(jnp.asarray(x))

    # Single precision, and torch's own approximations.
    np.testing.assert_allclose(ours, module()(th.as_tensor(x)).numpy(), atol=1e-6)


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


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ("sigmoids", "must be one of tanh, relu"),
        (th.nn.Conv1d, "must be one of tanh, relu"),
        (np.tanh, "no JAX function"),
        (th.sin, "no JAX function"),
        (jnp.sum, "must keep the shape"),
        (lambda x: None, "must keep the shape"),
        (th.nn.ELU(alpha=0.5), "settings of its own"),
        (type("ReLU", (th.nn.ReLU,), {}), "settings of its own"),
    ],
)
def test_what_is_no_activation_is_refused(wrong, message):
    with pytest.raises(ValueError, match=message):
        activation(wrong)


def test_the_actor_starts_near_zero_and_stays_within_one():
    actor = Actor(2, (16,), nn.tanh)
    obs = jax.random.normal(jax.random.key(0), (100, 3))
    weights = actor.init(jax.random.key(1), obs[0])

    controls = actor.apply(weights, obs)

    # The last layer's weights have standard deviation 0.01 / 4, times 16 inputs of at most 1.
    assert controls.shape == (100, 2) and jnp.abs(controls).max() < 0.1
    large = jax.tree.map(lambda leaf: 1e4 * leaf, weights)
    assert jnp.abs(actor.apply(large, obs)).max() <= 1.0


def test_one_value_comes_out_for_each_observation():
    value = Value((4, 5), nn.relu)
    weights = value.init(jax.random.key(0), jnp.zeros(3))

    assert value_of(value.apply(weights, jnp.zeros(3))).shape == ()
    assert value_of(value.apply(weights, jnp.zeros((7, 3)))).shape == (7,)
    assert widths(weights) == [4, 5, ROOTS]


def test_a_value_is_a_signed_root_less_squares():
    # u(2) = 2 * (2 + 0.3), u(-2) the same below zero.
    assert value_of(jnp.array([2.0, 0.0, 0.0])) == pytest.approx(4.6)
    assert value_of(jnp.array([-2.0, 1.0, -3.0])) == pytest.approx(-4.6 - 1.0 - 9.0)
    value = jnp.array([-1e4, -20.0, -1e-3, 0.0, 1.0, 1e4])
    # Single precision.
    np.testing.assert_allclose(nets.unsquash(nets.squash(value)), value, rtol=1e-4, atol=1e-7)
    assert (jnp.diff(nets.squash(value)) > 0.0).all()


@pytest.mark.parametrize("hidden", [(), (8,)])
def test_what_an_actor_computes_does_not_change_with_the_scales_of_its_input(hidden):
    actor, obs = Actor(2, hidden, nn.tanh), jax.random.normal(jax.random.key(0), (9, 3))
    drawn = actor.init(jax.random.key(1), obs[0])
    weights = jax.tree.map(lambda leaf: leaf + 0.3, drawn)
    old = Scales(jnp.array([0.1, 0.0, -2.0]), jnp.array([1.0, 2.0, 0.5]))
    new = Scales(jnp.array([0.4, -1.0, 1.0]), jnp.array([3.0, 0.2, 0.7]))

    moved = nets.with_input_scales(weights, old, new)

    before = actor.apply(weights, (obs - old.mean) / old.scale)
    # Single precision.
    np.testing.assert_allclose(
        actor.apply(moved, (obs - new.mean) / new.scale), before, rtol=1e-4, atol=1e-5
    )


def test_a_linear_path_leads_past_the_hidden_layers_unless_it_is_switched_off():
    obs = jnp.ones(3)
    with_path, without = Actor(1, (4,), nn.tanh), Actor(1, (4,), nn.tanh, linear_path=False)
    drawn = with_path.init(jax.random.key(0), obs)["params"]
    still = jax.tree.map(jnp.zeros_like, drawn) | {"linear": {"kernel": jnp.full((3, 1), 0.1)}}

    assert with_path.apply({"params": still}, obs) == pytest.approx(np.tanh(0.3))
    assert "linear" not in without.init(jax.random.key(0), obs)["params"]
    assert policy().actor_network.linear_path
    assert not policy(linear_path=False).actor_network.linear_path


def test_a_pytree_makes_a_round_trip_through_tensors_of_their_own():
    source = jax.tree.map(np.array, tree(1.5))
    tensors = to_state_dict(source)
    source.first["kernel"][:] = 9.0

    back = from_state_dict(tree(0.0), tensors)

    assert list(tensors) == ["first.count", "first.kernel", "second"]
    assert all(isinstance(tensor, th.Tensor) for tensor in tensors.values())
    for leaf, expected in zip(jax.tree.leaves(back), jax.tree.leaves(tree(1.5)), strict=True):
        np.testing.assert_array_equal(leaf, expected)
        assert leaf.dtype == expected.dtype


def test_tensors_that_do_not_fit_are_refused_and_missing_ones_where_that_is_not_allowed():
    tensors = to_state_dict(tree(1.0))
    tensors["third"] = tensors.pop("second")

    with pytest.raises(RuntimeError, match=r"missing \['second'\], unexpected \['third'\]"):
        from_state_dict(tree(0.0), tensors)
    with pytest.raises(RuntimeError, match=r"'first\.kernel' has shape \(2,\)"):
        from_state_dict(tree(0.0), {"first.kernel": th.zeros(2)}, strict=False)
    back = from_state_dict(tree(0.0), {"second": th.tensor(2.0)}, strict=False)
    assert float(back.second) == 2.0 and float(back.first["kernel"].max()) == 0.0


@pytest.mark.parametrize(
    "net_arch, pi, vf",
    [
        (None, [96, 96, 2], [64, 64, ROOTS]),
        ([], [2], [ROOTS]),
        ({"pi": [4, 3], "vf": [6]}, [4, 3, 2], [6, ROOTS]),
        ({"pi": [4]}, [4, 2], [64, 64, ROOTS]),
    ],
)
def test_net_arch_sets_the_widths_of_both_networks(net_arch, pi, vf):
    networks = policy(net_arch=net_arch).networks

    assert widths(networks.actor) == pi and widths(networks.value) == vf


def test_rounding_does_not_lead_out_of_the_bounds():
    low, high = np.float32(-2.0), np.float32(0.2)
    # What makes this case one: SB3's formula gives more than the upper bound here.
    assert low + np.float32(0.5) * np.float32(2.0) * (high - low) > high

    actions = policy(low, high).unscale_action(np.array([[1.0, -1.0]], np.float32))

    assert actions.tolist() == [[float(high), float(low)]]
