"""
The policy of TD7: embeddings of states and actions, and actor and critics on top of them.

Source: Fujimoto et al., *For SALE: State-Action Representation Learning for Deep Reinforcement
Learning*, NeurIPS 2023.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from sb3_hds.algos.base.config import check_count, takes
from sb3_hds.algos.base.policy import LearningPolicy, PolicyConfig
from sb3_hds.algos.model_free.td7.update import (
    Checkpoint,
    TD7State,
    UpdateConfig,
    act,
    embed,
    init_state,
    q_values,
)
from sb3_hds.algos.nets.optimizers import optimizer_of
from sb3_hds.algos.nets.options import Activation, activation
from sb3_hds.core.numerics.compilation import GENERATOR
from sb3_hds.deploy.policy_function import PolicyFunction

_EPSILON = 1e-8
# Uniform, of variance 1 / (3 n) with n inputs.
_KERNELS = nn.initializers.variance_scaling(1.0 / 3.0, "fan_in", "uniform")


def average_l1_norm(x: Float[Array, "*batch n"]) -> Float[Array, "*batch n"]:
    """:return: ``x``, scaled to a mean absolute value of 1 (section 4.1 of the paper)"""
    return x / jnp.maximum(jnp.mean(jnp.abs(x), -1, keepdims=True), _EPSILON)


class Encoder(nn.Module):
    """
    Map the state to its embedding :math:`z^s`, and :math:`z^s` and the action to :math:`z^{sa}`, a
    prediction of the next state's embedding.

    :param n: size of the embeddings
    :param net_arch: hidden widths
    :param activation_fn: between the layers
    """

    n: int
    net_arch: Sequence[int]
    activation_fn: Activation

    def setup(self) -> None:
        # Flax derives initial weights from these names: a seed's networks depend on them.
        self.of_state = _Dense((*self.net_arch, self.n), self.activation_fn)
        self.of_both = _Dense((*self.net_arch, self.n), self.activation_fn)

    def __call__(self, obs: Array, action: Array) -> tuple[Array, Array]:
        zs = average_l1_norm(self.of_state(obs))
        return zs, self.of_both(jnp.concatenate([zs, action], -1))


class Actor(nn.Module):
    """
    Map an observation and its embedding to an action.

    :param n_act: number of actions
    :param net_arch: hidden widths; the embedding is concatenated after the first layer
    :param activation_fn: between the layers
    """

    n_act: int
    net_arch: Sequence[int]
    activation_fn: Activation

    @nn.compact
    def __call__(
        self, obs: Float[Array, "*batch obs"], zs: Float[Array, "*batch z"]
    ) -> Float[Array, "*batch act"]:
        own = average_l1_norm(_first(obs, self.net_arch))
        hidden = _Dense((*self.net_arch, self.n_act), self.activation_fn)
        return jnp.tanh(hidden(jnp.concatenate([own, zs], -1)))


class Critic(nn.Module):
    """
    Map observation, action and both embeddings to a value.

    :param net_arch: hidden widths; the embeddings are concatenated after the first layer
    :param activation_fn: between the layers
    """

    net_arch: Sequence[int]
    activation_fn: Activation

    @nn.compact
    def __call__(
        self,
        obs: Float[Array, "*batch obs"],
        action: Float[Array, "*batch act"],
        zsa: Float[Array, "*batch z"],
        zs: Float[Array, "*batch z"],
    ) -> Float[Array, "*batch"]:
        own = _first(jnp.concatenate([obs, action], -1), self.net_arch)
        hidden = _Dense((*self.net_arch, 1), self.activation_fn)
        return hidden(jnp.concatenate([average_l1_norm(own), zsa, zs], -1))[..., 0]


def _first(x: Array, net_arch: Sequence[int]) -> Array:
    """A layer of the first width; the identity without hidden layers."""
    return _linear(x, net_arch[0]) if net_arch else x


class _Dense(nn.Module):
    """Layers of these widths, the last one linear."""

    sizes: Sequence[int]
    activation_fn: Activation

    @nn.compact
    def __call__(self, x: Array) -> Array:
        for size in self.sizes[:-1]:
            x = self.activation_fn(_linear(x, size))
        return _linear(x, self.sizes[-1])


def _linear(x: Array, size: int) -> Array:
    r"""
    A layer with the initial values of torch's ``Linear``: weights and biases uniform within
    :math:`\pm 1 / \sqrt{n}` for :math:`n` inputs.
    """
    limit = 1.0 / math.sqrt(x.shape[-1])

    def biases(key: PRNGKeyArray, shape: Sequence[int], dtype: Any) -> Array:
        return jax.random.uniform(key, shape, dtype, -limit, limit)

    return nn.Dense(size, kernel_init=_KERNELS, bias_init=biases)(x)


@dataclasses.dataclass(frozen=True, eq=False)
class TD7PolicyConfig(PolicyConfig):
    """
    Arguments of TD7's policy.

    :param observation_space: a Box, or choices, which become one-hot
    :param action_space: a bounded Box of any shape
    :param net_arch: hidden widths of all networks, or ``{"pi": [...], "qf": [...]}``
    :param embedding_size: of states, and of pairs of state and action
    :param activation_fn: of the actor: name, JAX function or torch module class
    :param qf_activation_fn: of encoder and critics
    :param n_critics: number of critics
    :param optimizer_class: name or function of optax, with its defaults, or torch class, with
        torch's defaults
    :param optimizer_kwargs: besides the learning rate
    :param use_sde: passed by SB3; the policy is deterministic
    """

    net_arch: Sequence[int] | Mapping[str, Sequence[int]] = (256, 256)
    embedding_size: int = 256
    activation_fn: str | Activation | type = "relu"
    qf_activation_fn: str | Activation | type = "elu"
    n_critics: int = 2
    optimizer_class: str | Callable[..., Any] = "adam"
    optimizer_kwargs: Mapping[str, Any] | None = None
    use_sde: bool = False

    def __post_init__(self) -> None:
        """:raises ValueError: for arguments out of range"""
        check_count("n_critics", self.n_critics)
        check_count("embedding_size", self.embedding_size)


class TD7Policy(LearningPolicy):
    """
    ``"MlpPolicy"`` of TD7: encoder, actor and two critics. Deterministic actions are those of the
    checkpoint, if there is one.
    """

    saved_with_weights = ("copies", "checkpoint")
    state: TD7State

    @takes(TD7PolicyConfig)
    def __init__(self, config: TD7PolicyConfig) -> None:
        super().__init__(config)
        del self.arguments["use_sde"]
        pi, qf = self.widths
        of_values = activation(config.qf_activation_fn)
        optimizer = optimizer_of(config.optimizer_class, config.optimizer_kwargs or {})
        self.parts: dict[str, Any] = {
            "encoder": Encoder(config.embedding_size, qf, of_values),
            "actor": Actor(self.n_act, pi, activation(config.activation_fn)),
            "critic": Critic(qf, of_values),
            "n_critics": config.n_critics,
            "optimizer": optimizer,
            "qf_optimizer": optimizer,
        }

    def build_default(self) -> None:
        """Initialise networks for the paper's update."""
        self.build(UpdateConfig(**self.parts), 0, jax.devices()[0])

    def build(self, config: UpdateConfig, seed: int, device: Any) -> None:
        """Initialise the networks; the policy keeps the algorithm's config as ``update_config``."""
        self.update_config = config
        key = jax.random.key(seed, impl=GENERATOR)
        self.agent_state = jax.device_put(init_state(config, self.n_obs, self.n_act, key), device)

    @property
    def has_checkpoint(self) -> bool:
        """Whether there is a checkpoint, which then provides deterministic actions."""
        return float(self.agent_state.checkpoint.kept) > 0.0

    def keep_checkpoint(self) -> None:
        """Copy the current policy into the checkpoint."""
        state = self.agent_state
        checkpoint = Checkpoint(state.copies.encoder, state.actor.weights, jnp.ones(()))
        self.agent_state = state._replace(checkpoint=checkpoint)

    def drop_checkpoint(self) -> None:
        """Let the current policy provide deterministic actions again."""
        checkpoint = self.agent_state.checkpoint._replace(kept=jnp.zeros(()))
        self.agent_state = self.agent_state._replace(checkpoint=checkpoint)

    def policy_function(self) -> PolicyFunction:
        """:return: the deterministic policy, to be exported"""
        act = partial(_act, self.update_config, *self._acting(deterministic=True))
        return PolicyFunction.without_memory(act, squashed=True)

    def _predict(self, observation: Any, deterministic: bool = False) -> np.ndarray:  # type: ignore[override]
        weights = self._acting(deterministic)
        return np.asarray(_act(self.update_config, *weights, self.flatten(observation)))

    def _acting(self, deterministic: bool) -> tuple[Any, Any]:
        """:return: weights of the encoder and of the actor that act"""
        state = self.agent_state
        if deterministic and self.has_checkpoint:
            return state.checkpoint.encoder, state.checkpoint.actor
        return state.copies.encoder, state.actor.weights

    def critic(self, obs: Any, actions: Any) -> tuple[np.ndarray, ...]:
        state, flat = self.agent_state, self.flatten(obs)
        taken = np.asarray(actions, np.float32).reshape(len(flat), -1)
        values = _q_values(
            self.update_config, state.copies.encoder, state.critic.weights, flat, taken
        )
        return tuple(np.asarray(values)[..., None])


@partial(jax.jit, static_argnums=0)
def _q_values(config: UpdateConfig, encoder: Any, critic: Any, obs: Any, actions: Any) -> jax.Array:
    return q_values(config, critic, obs, actions, *embed(config, encoder, obs, actions))


_act = jax.jit(act, static_argnums=0)
