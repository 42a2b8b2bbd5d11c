"""The policy of PODS and HDS: its networks, with their training state, and the class for SB3."""

import dataclasses
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple, cast

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax
from gymnasium import spaces
from jaxtyping import Array, Float, PRNGKeyArray

from sb3_hds.algos.base.config import takes
from sb3_hds.algos.base.policy import PolicyConfig, TensorPolicy
from sb3_hds.algos.nets.optimizers import finite_leaves
from sb3_hds.algos.nets.options import Activation, activation, widths
from sb3_hds.core import Obs
from sb3_hds.core.numerics.compilation import GENERATOR, QUICKEST_COMPILATION
from sb3_hds.deploy.policy_function import PolicyFunction

# Scale of the value below which its root is linear, in units of the scaled reward.
_NEAR_ZERO = 0.3
# Number of squares in the value.
_N_SQUARES = 8
# Uniform rather than normal saves half a second of compilation. Small in last layers, so that
# networks start near zero.
_HIDDEN = nn.initializers.variance_scaling(1.0, "fan_in", "uniform")
_SMALL = nn.initializers.variance_scaling(1e-4, "fan_in", "uniform")
_WIDTHS = {"pi": (96, 96), "vf": (64, 64)}


class Actor(nn.Module):
    """
    Map an observation to a control in (-1, 1), near zero at first.

    :param n_act: number of controls
    :param net_arch: widths of the hidden layers
    :param activation_fn: between the layers
    :param linear_path: whether a linear map from input to output is added: near a balance, the best
        control is linear in the state, which hidden layers learn slowly
    """

    n_act: int
    net_arch: Sequence[int]
    activation_fn: Activation
    linear_path: bool = True

    @nn.compact
    def __call__(self, obs: Float[Array, "*batch obs"]) -> Float[Array, "*batch act"]:
        hidden = _mlp(obs, self.net_arch, self.activation_fn)
        control = nn.Dense(self.n_act, kernel_init=_SMALL, name="last")(hidden)
        if self.linear_path:
            control += nn.Dense(self.n_act, False, kernel_init=_SMALL, name="linear")(obs)
        return jnp.tanh(control)


class Value(nn.Module):
    r"""
    Map an observation to roots :math:`\rho` of the value, see :func:`value_of`.

    :param net_arch: widths of the hidden layers
    :param activation_fn: between the layers
    """

    net_arch: Sequence[int]
    activation_fn: Activation

    @nn.compact
    def __call__(self, obs: Float[Array, "*batch obs"]) -> Float[Array, "*batch roots"]:
        hidden = _mlp(obs, self.net_arch, self.activation_fn)
        return nn.Dense(1 + _N_SQUARES, kernel_init=_SMALL)(hidden)


def output(network: Actor | Value, weights: Mapping[str, Any], obs: jax.Array) -> jax.Array:
    """:return: output of a network for one observation or a batch"""
    return cast(jax.Array, network.apply(weights, obs))


def with_input_scales(weights: Mapping[str, Any], old: Any, new: Any) -> Mapping[str, Any]:
    """
    :param weights: of an ``Actor`` or ``Value`` whose input is ``(obs - old.mean) / old.scale``
    :param new: mean and scale of the new input, each of shape ``(n_obs,)``
    :return: weights of the same function of the input ``(obs - new.mean) / new.scale``
    """
    layers = dict(weights["params"])
    first = "Dense_0" if "Dense_0" in layers else "last"
    kernel, bias = layers[first]["kernel"], layers[first]["bias"]
    layers[first] = {
        "kernel": kernel * (new.scale / old.scale)[:, None],
        "bias": bias + ((new.mean - old.mean) / old.scale) @ kernel,
    }
    if "linear" in layers:
        slope, last = layers["linear"]["kernel"], layers["last"]
        layers["linear"] = {"kernel": slope * (new.scale / old.scale)[:, None]}
        bias = last["bias"] + ((new.mean - old.mean) / old.scale) @ slope
        layers["last"] = {"kernel": last["kernel"], "bias": bias}
    return {**weights, "params": layers}


def value_of(roots: Float[Array, "*batch roots"]) -> Float[Array, "*batch"]:
    r"""
    :math:`V = u(\rho_0) - \sum_{i \geq 1} \rho_i^2`, with :func:`value_of_root` for :math:`u`.

    Near a goal the value is minus a quadratic form. Squares represent it exactly, and their slopes
    give its curvature.
    """
    return value_of_root(roots[..., 0]) - jnp.sum(roots[..., 1:] ** 2, -1)


def root_of_value(value: jax.Array) -> jax.Array:
    r"""
    The root :math:`y` that the value network learns: :math:`y\,(|y| + 0.3) = V`.

    The error of a network is a share of its range. For V itself, that exceeds the remaining gain
    near the goal; the root has relative precision there.
    """
    return jnp.sign(value) * (jnp.sqrt(_NEAR_ZERO**2 + 4.0 * jnp.abs(value)) - _NEAR_ZERO) / 2.0


def value_of_root(root: jax.Array) -> jax.Array:
    """:return: the value of a root; the inverse of :func:`root_of_value`"""
    return root * (jnp.abs(root) + _NEAR_ZERO)


def _mlp(x: jax.Array, net_arch: Sequence[int], activation_fn: Activation) -> jax.Array:
    for width in net_arch:
        x = activation_fn(nn.Dense(width, kernel_init=_HIDDEN)(x))
    return x


class Normalization(NamedTuple):
    """
    An affine map with clipping, as ``VecNormalize`` applies to observations.

    :param mean: shape ``(n_obs,)``
    :param scale: shape ``(n_obs,)``
    :param clip: largest absolute value of the result
    """

    mean: Float[Array, " obs"]
    scale: Float[Array, " obs"]
    clip: Any

    def __call__(self, obs: Obs) -> Obs:
        return jnp.clip((obs - self.mean) / self.scale, -self.clip, self.clip)


class Networks(NamedTuple):
    """
    Learned networks, saved with a model.

    :param actor: parameters of the policy in training
    :param average: moving average of ``actor``
    :param value: parameters of the value network
    :param inside: the networks' own normalisation of their input
    :param acting: parameters of the policy that acts: the best average in comparisons so far
    :param acting_inside: normalisation of the input of ``acting``
    """

    actor: Mapping[str, Any]
    average: Mapping[str, Any]
    value: Mapping[str, Any]
    inside: Normalization
    acting: Mapping[str, Any]
    acting_inside: Normalization


class TrainingState(NamedTuple):
    """
    Training state besides the networks, saved with a model.

    :param actor_optimizer: state of Adam
    :param value_optimizer: state of Adam
    :param reward_scale: factor from rewards to the objective
    :param reward_offset: reward that counts as zero
    :param control_scale: geometric mean of the size of the plans' controls, shape ``(n_act,)``
    :param gain: mean gain of the last epoch's plans, in units of the objective
    :param n_epochs: number of epochs so far
    :param key: random key, as integers
    """

    actor_optimizer: Any
    value_optimizer: Any
    reward_scale: jax.Array
    reward_offset: jax.Array
    control_scale: jax.Array
    gain: jax.Array
    n_epochs: jax.Array
    key: jax.Array


@partial(jax.jit, static_argnums=(0, 1, 2, 3), compiler_options=QUICKEST_COMPILATION)
def fresh_networks(
    actor: Actor, value: Value, n_obs: int, max_grad_norm: float, key: PRNGKeyArray
) -> tuple[Networks, TrainingState]:
    """:return: networks and training state before the first epoch, with scales of one"""
    k_actor, k_value, k_next = jax.random.split(key, 3)
    obs = jnp.zeros(n_obs)
    weights, value_weights = actor.init(k_actor, obs), value.init(k_value, obs)
    inside = Normalization(jnp.zeros(n_obs), jnp.ones(n_obs), unclipped())
    adam = clipped_adam(max_grad_norm)
    zero = jnp.zeros(())
    progress = TrainingState(
        actor_optimizer=adam.init(weights),
        value_optimizer=adam.init(value_weights),
        reward_scale=jnp.ones(()),
        reward_offset=zero,
        control_scale=jnp.ones(actor.n_act),
        gain=zero,
        n_epochs=jnp.zeros((), jnp.int32),
        key=jax.random.key_data(k_next),
    )
    networks = Networks(
        actor=weights,
        average=weights,
        value=value_weights,
        inside=inside,
        acting=weights,
        acting_inside=inside,
    )
    return networks, progress


def clipped_adam(max_grad_norm: float) -> optax.GradientTransformation:
    """Adam with clipped gradients, without its learning rate, which is a hyperparameter."""
    return optax.chain(optax.clip_by_global_norm(max_grad_norm), optax.scale_by_adam(0.9, 0.99))


def unclipped() -> jax.Array:
    """Infinity with an explicit dtype: with a weak one, a loaded model would compile again."""
    return jnp.full((), jnp.inf, jnp.float32)


@dataclasses.dataclass(frozen=True, eq=False)
class TwinPolicyConfig(PolicyConfig):
    """
    Arguments of the policy of PODS and HDS.

    :param observation_space: a Box of one dimension
    :param action_space: a bounded Box of one dimension
    :param net_arch: hidden widths of both networks, or ``{"pi": [...], "vf": [...]}``; default
        96, 96 for the policy and 64, 64 for the value
    :param activation_fn: name, JAX function or torch module class
    :param linear_path: whether a linear map from input to output is added to the hidden layers of
        the policy (the paper: no)
    :param max_grad_norm: gradients of both networks are clipped to this norm
    :param use_sde: passed by SB3; the policy is deterministic
    """

    net_arch: Sequence[int] | dict[str, Sequence[int]] | None = None
    activation_fn: str | Activation | type = "tanh"
    linear_path: bool = True
    max_grad_norm: float = 1.0
    use_sde: bool = False

    def __post_init__(self) -> None:
        """:raises ValueError: for arguments out of range"""
        if not self.max_grad_norm > 0.0:
            raise ValueError(f"max_grad_norm must be above 0, got {self.max_grad_norm!r}.")


class TwinPolicy(TensorPolicy):
    """A policy network and a value network, with their own normalisation of inputs."""

    @takes(TwinPolicyConfig)
    def __init__(self, config: TwinPolicyConfig) -> None:
        super().__init__(config.observation_space, config.action_space, squash_output=True)
        self.arguments = config.arguments()
        del self.arguments["use_sde"]
        pi, vf = widths(config.net_arch, "vf", _WIDTHS)
        function, n_act = activation(config.activation_fn), int(np.prod(config.action_space.shape))
        self.actor_network = Actor(n_act, pi, function, config.linear_path)
        self.value_network = Value(vf, function)
        self.max_grad_norm = config.max_grad_norm
        self.networks: Networks
        self.progress: TrainingState
        self.build(jax.random.key(0, impl=GENERATOR), jax.devices()[0])

    def build(self, key: jax.Array, device: Any) -> None:
        """Initialise the networks by a key of the generator ``unsafe_rbg``."""
        n_obs = spaces.flatdim(self.observation_space)
        networks, progress = fresh_networks(
            self.actor_network, self.value_network, n_obs, self.max_grad_norm, key
        )
        self.networks, self.progress = jax.device_put((networks, progress), device)

    def move_to(self, device: Any) -> None:
        self.networks, self.progress = jax.device_put((self.networks, self.progress), device)

    @property
    def weights(self) -> Networks:
        return self.networks

    @weights.setter
    def weights(self, tree: Networks) -> None:
        self.networks = tree

    @property
    def training_state(self) -> TrainingState:
        """Random keys are stored as 64-bit integers, which torch can hold."""
        return self.progress._replace(key=np.asarray(self.progress.key, np.int64))

    @training_state.setter
    def training_state(self, tree: TrainingState) -> None:
        key = jnp.asarray(np.asarray(tree.key).astype(np.uint32))
        placed = jax.device_put(key, self.progress.key.sharding)
        self.progress = tree._replace(key=placed)

    def _predict(self, observation: np.ndarray, deterministic: bool = True) -> np.ndarray:  # type: ignore[override]
        flat = observation.reshape(observation.shape[0], -1)
        return np.asarray(_act(self.actor_network, self.networks, flat))

    def policy_function(self) -> PolicyFunction:
        """:return: the policy, to be exported"""
        inside = self.networks.acting_inside
        return PolicyFunction.without_memory(
            partial(_act, self.actor_network, self.networks),
            squashed=True,
            scales=(np.asarray(inside.mean), np.asarray(inside.scale)),
        )


@partial(jax.jit, static_argnums=0)
def _act(actor: Actor, networks: Networks, obs: Any) -> Any:
    """Controls of the acting policy for a batch of observations."""
    return actor.apply(networks.acting, networks.acting_inside(jnp.asarray(obs, jnp.float32)))


def all_finite(networks: Networks) -> bool:
    """:return: whether all weights are finite"""
    return finite_leaves((networks.actor, networks.average, networks.value, networks.acting))
