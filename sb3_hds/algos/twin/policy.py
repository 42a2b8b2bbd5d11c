"""The deterministic policy of PODS and HDS."""

import dataclasses
from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces

from sb3_hds.algos.base.config import takes
from sb3_hds.algos.base.policy import PolicyConfig, TensorPolicy
from sb3_hds.algos.nets.options import Activation, activation, finite_leaves, widths
from sb3_hds.algos.twin.networks import Actor, Value
from sb3_hds.algos.twin.state import Networks, Progress, fresh_networks
from sb3_hds.core.numerics.compilation import GENERATOR
from sb3_hds.deploy.policy_function import PolicyFunction

_WIDTHS = {"pi": (96, 96), "vf": (64, 64)}


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
        """
        :raises ValueError: for arguments out of range
        """
        if not self.max_grad_norm > 0.0:
            raise ValueError(f"max_grad_norm must be above 0, got {self.max_grad_norm!r}.")


class TwinPolicy(TensorPolicy):
    """
    A policy network and a value network, with their own normalisation of inputs.
    """

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
        self.progress: Progress
        self.build(jax.random.key(0, impl=GENERATOR), jax.devices()[0])

    def build(self, key: jax.Array, device: Any) -> None:
        """
        Initialise the networks.

        :param key: of the generator ``unsafe_rbg``
        :param device: of JAX
        """
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
    def training_state(self) -> Progress:
        """Random keys are stored as 64-bit integers, which torch can hold."""
        return self.progress._replace(key=np.asarray(self.progress.key, np.int64))

    @training_state.setter
    def training_state(self, tree: Progress) -> None:
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
